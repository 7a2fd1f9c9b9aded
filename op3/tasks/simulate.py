"""A motion played in simulation, as a log without noise."""

import numpy as np

from op3.robot import Motion
from op3.rollout import Metadata, Rollout
from op3.servo import RobotModel
from op3.sim import model_hash
from op3.tasks.replay import Replay

SETTLE = 1.5
"""How long the first pose is held before the log starts [s]."""

FALL = float(np.deg2rad(45))
"""A trunk that rolls or pitches further has fallen [rad]."""


def simulate_motion(model: RobotModel, motion: Motion, mount: str | None = None, settle: float = SETTLE) -> Rollout:
    """Play a motion of the whole robot with its own gains.

    Args:
        model: of the robot.
        motion: with one row per tick of the robot's PD loop, for all joints.
        mount: ``floor`` or ``stand``; by default the first that the motion is made for.
        settle: how long the first pose is held before the log starts [s].

    Returns:
        A log at the motion's times whose metadata say whether the robot fell.

    Raises:
        ValueError: if the simulation diverges.
    """
    shape = motion.position.shape
    commands = {
        "time": motion.time,
        "command/position": motion.position,
        "command/p_gain": np.broadcast_to(np.reshape(motion.p_gain, (-1, 1)), shape),
        "command/d_gain": np.full(shape, motion.d_gain),
    }
    metadata = Metadata(
        joints=motion.joints,
        robot="simulated",
        mount=mount or motion.mounts[0],
        rate=1.0 / float(np.median(np.diff(motion.time))),
        battery=model.bus_voltage,
        motion=motion.name,
        recording=motion.name,
        model_hash=model_hash(model),
    )
    template = Rollout.from_arrays({**commands, "joint/position": motion.position}, metadata)
    predicted = Replay([template], settle=settle).run(model)[0]
    if bool(predicted.failed.any()):
        raise ValueError(f"the simulation of motion {motion.name!r} diverged; check the model's values")
    channels = {key: value[0].numpy() for key, value in predicted.channels.items()}
    fallen = bool((np.abs(channels["imu", "orientation"][:, :2]) > FALL).any())
    return Rollout.from_arrays({**commands, **channels}, metadata.replace(fallen=fallen))
