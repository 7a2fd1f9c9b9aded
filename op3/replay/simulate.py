"""Plays motions in simulation, as logs without noise or as recordings of a robot."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from op3.motions import Motion
from op3.replay.log_replay import Replay
from op3.robot import Robot, load_robot
from op3.rollout import Metadata, Rollout
from op3.servo import RobotModel
from op3.sim import model_for, model_hash

SETTLE = 1.5
"""Time for which the first pose is held before the log starts [s]."""

FALL = float(np.deg2rad(45))
"""A trunk that rolls or pitches further has fallen [rad]."""


def simulate_motion(
    model: RobotModel,
    motion: Motion,
    mount: str | None = None,
    gains: Mapping[str, ArrayLike] | None = None,
) -> Rollout:
    """Play a motion with its gains, or with the firmware's gains if the firmware closes the loop.

    Args:
        motion: motion with one row per tick of the robot's PD loop; other joints stay at home.
        mount: ``floor`` or ``stand``; by default the motion's first one.
        gains: commands that replace the motion's, such as ``p_gain``, broadcastable to ``[row, joint]``.

    Returns:
        A log at the motion's times whose metadata say whether the robot fell.

    Raises:
        ValueError: if the simulation diverges.
    """
    robot = load_robot(motion.robot)
    position = np.tile(robot.home, (len(motion.time), 1))
    position[:, robot.indices(motion.joints)] = motion.position
    commands = {"time": motion.time, "command/position": position}
    for name, gain in {**_gains(motion, robot), **(gains or {})}.items():
        commands[f"command/{name}"] = np.broadcast_to(gain, position.shape)
    metadata = Metadata(
        joints=robot.joints,
        robot="simulated",
        robot_file=robot.reference,
        mount=mount or motion.mounts[0],
        rate=1.0 / float(np.median(np.diff(motion.time))),
        battery=robot.supply and model.bus_voltage,
        servo=robot.servos[0].name,
        motion=motion.name,
        recording=motion.name,
        model_hash=model_hash(model),
    )
    template = Rollout.from_arrays({**commands, "joint/position": position}, metadata)
    predicted = Replay([template], settle=SETTLE).run(model)[0]
    if bool(predicted.failed.any()):
        raise ValueError(f"the simulation of motion {motion.name!r} diverged; check the model's values")
    channels = {key: value[0].numpy() for key, value in predicted.channels.items()}
    if robot.file.imu is None:
        channels = {key: value for key, value in channels.items() if key[0] != "imu"}
    fallen = ("imu", "orientation") in channels and bool((np.abs(channels["imu", "orientation"][:, :2]) > FALL).any())
    return Rollout.from_arrays({**commands, **channels}, metadata.replace(fallen=fallen))


def _gains(motion: Motion, robot: Robot) -> dict[str, ArrayLike]:
    """The gains with which the robot's servos play the motion."""
    if robot.servos[0].loop == "firmware":
        return {"firmware_gain": robot.firmware_gain}
    return {"p_gain": np.reshape(motion.p_gain, (-1, 1)), "d_gain": np.asarray(motion.d_gain)}


class ModelRobot:
    """A robot simulated with a known model: it plays motions as a stand-in does, without hidden parameters.

    Sensors are quantised to register units, with noise of one unit.

    Args:
        robot: a name in `assets/robots`, or the path of a robot file.
        model: a name or file; None: the robot's model.
        mount: ``floor`` or ``stand``.
        seed: seed of the noise; every recording draws from its own stream.
    """

    def __init__(self, robot: str, model: str | None = None, mount: str = "stand", seed: int = 0):
        self.robot = load_robot(robot)
        self.model = model_for(self.robot, model)
        self._mount, self._seed, self._played = mount, seed, 0

    def play(self, motion: Motion, p_gain: ArrayLike, d_gain: ArrayLike, *, recording: str | None = None) -> Rollout:
        """Play a motion and record it; gains as for `op3.stand_in.StandIn.play`, ignored if the firmware closes the
        loop."""
        firmware = self.robot.servos[0].loop == "firmware"
        log = simulate_motion(
            self.model, motion, self._mount, gains={} if firmware else {"p_gain": p_gain, "d_gain": d_gain}
        )
        rng = np.random.default_rng([self._seed, self._played])
        self._played += 1
        arrays = {key: log.array(key) for key in log.channels}
        if any(make.counts.current is None for make in self.robot.servos):
            del arrays["joint", "current"]
        for key in [("joint", name) for name in ("position", "velocity", "current") if ("joint", name) in arrays]:
            arrays[key] = self._read(key[1], arrays[key], rng)
        voltage = self.model.bus_voltage * self.robot.supply_shares
        arrays["joint", "voltage"] = np.broadcast_to(voltage, arrays["joint", "position"].shape)
        metadata = log.metadata.replace(recording=recording, seed=self._seed)
        return Rollout.from_arrays(arrays, metadata)

    def skip(self) -> None:
        """Count a recording that exists already."""
        self._played += 1

    def _read(self, name: str, values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Readings of the registers."""
        units = [make.position_unit if name == "position" else make.unit(name) for make in self.robot.servos]
        return np.round(values / units + rng.standard_normal(values.shape)) * units
