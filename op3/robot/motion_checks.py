"""Whether a motion is safe to play: soft limits, speeds, self-collision."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from functools import lru_cache

import mujoco
import numpy as np

from op3.robot.motions import Motion
from op3.robot.robot import Robot, exclude_neighbours, load_robot, read_spec

CLEARANCE = 0.005
"""Least distance between two parts of the robot that are not neighbours [m]."""


def motion_faults(motion: Motion, mount: str | None = None) -> list[str]:
    """What is unsafe about a motion, one sentence each; empty where nothing is.

    Args:
        motion: of a robot, which is at home in the joints that it does not name.
        mount: where it is to be played, "floor" or "stand"; None: anywhere it is made for.
    """
    if mount is not None and mount not in motion.mounts:
        places = " or ".join(f"mount={place}" for place in motion.mounts)
        return [f"motion {motion.name!r} is not for the {mount}; choose {places}"]
    robot = load_robot(motion.robot)
    position = np.tile(robot.home, (len(motion.time), 1))
    position[:, robot.indices(motion.joints)] = motion.position
    outside = outside_limits(motion.name, robot.joints, robot.limits, motion.time, position)
    return [*outside, *_speed_faults(motion, robot, position), *_collisions(motion, robot, position)]


def check_motion(motion: Motion, mount: str | None = None) -> None:
    """Refuse an unsafe motion.

    Raises:
        ValueError: with the first fault of `motion_faults`.
    """
    faults = motion_faults(motion, mount)
    if faults:
        raise ValueError(faults[0])


def check_targets(name: str, joints: Sequence[str], limits: np.ndarray, time: np.ndarray, position: np.ndarray) -> None:
    """Refuse what a robot must not be told, see `outside_limits`: servos in current mode enforce no limit."""
    if faults := outside_limits(name, joints, limits, time, position):
        raise ValueError(faults[0])


def outside_limits(
    name: str, joints: Sequence[str], limits: np.ndarray, time: np.ndarray, position: np.ndarray
) -> list[str]:
    """Joints that a motion asks for more than their limits [joint, 2], where first, one sentence each."""
    outside = (position < limits[:, 0]) | (position > limits[:, 1])
    faults = []
    for joint in np.flatnonzero(outside.any(0)).tolist():
        row, (low, high) = int(np.argmax(outside[:, joint])), limits[joint]
        faults.append(
            f"motion {name!r} asks {joints[joint]} for {position[row, joint]:.3f} rad at {time[row]:.3f} s;"
            f" it may go from {low:.3f} to {high:.3f} rad"
        )
    return faults


def _speed_faults(motion: Motion, robot: Robot, position: np.ndarray) -> list[str]:
    if len(position) < 2:
        return []
    speed = np.abs(np.diff(position, axis=0)) / np.diff(motion.time)[:, None]
    row, joint = np.unravel_index(np.argmax(speed / robot.speed_limits), speed.shape)
    if speed[row, joint] <= robot.speed_limits[joint]:
        return []
    return [
        f"motion {motion.name!r} moves {robot.joints[joint]} at {speed[row, joint]:.2f} rad/s at"
        f" {motion.time[row]:.3f} s; the limit is {robot.speed_limits[joint]:.1f} rad/s"
    ]


def _collisions(motion: Motion, robot: Robot, position: np.ndarray) -> list[str]:
    model = _colliding_model(robot)
    data = mujoco.MjData(model)
    usual = {pair for pair, _ in _near(model, data, robot.home)}  # parts that touch at home are made to
    for row in range(len(position)):
        for pair, distance in _near(model, data, position[row]):
            if pair not in usual:
                parts = [
                    model.geom(geom).name or f"a part of {model.body(model.geom_bodyid[geom]).name}" for geom in pair
                ]
                return [
                    f"motion {motion.name!r} brings {parts[0]} within {distance * 1000:.1f} mm of {parts[1]} at"
                    f" {motion.time[row]:.3f} s; at least {CLEARANCE * 1000:.0f} mm must be left:"
                    " move less, or elsewhere (motion.joints, motion.offset)"
                ]
    return []


def _near(model: mujoco.MjModel, data: mujoco.MjData, position: np.ndarray) -> list[tuple[tuple[int, int], float]]:
    """Pairs of geoms that are closer than `CLEARANCE`, and how far they are apart [m]."""
    data.qpos[:] = position
    mujoco.mj_fwdPosition(model, data)
    return [((int(c.geom1), int(c.geom2)), float(c.dist)) for c in data.contact if c.dist < CLEARANCE]


@lru_cache(maxsize=4)
def _colliding_model(robot: Robot) -> mujoco.MjModel:
    """The bare robot whose parts, but for neighbours, feel each other from `CLEARANCE` on."""
    # before compiling: MuJoCo sums up what each body may touch at that moment
    spec = read_spec(robot.model_path, robot.file.base)
    for geom in spec.geoms:
        if geom.conaffinity:
            geom.contype = 1
            geom.margin = CLEARANCE
    return exclude_neighbours(spec).compile()
