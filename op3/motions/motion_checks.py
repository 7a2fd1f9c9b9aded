"""Safety checks of a motion: soft limits, speeds, self-collision."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from op3.motions.motion import Motion
from op3.robot.robot import Robot, load_robot
from op3.robot.self_collision import CLEARANCE, SelfCollision


def motion_faults(motion: Motion, mount: str | None = None) -> list[str]:
    """Reasons why a motion is unsafe, one sentence each; empty if it is safe.

    Args:
        motion: of a robot, which is at home in the joints that it does not name.
        mount: "floor" or "stand"; None: any mount of the motion.
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
    """Raise an error for an unsafe motion.

    Raises:
        ValueError: the first fault of `motion_faults`.
    """
    faults = motion_faults(motion, mount)
    if faults:
        raise ValueError(faults[0])


def check_targets(name: str, joints: Sequence[str], limits: np.ndarray, time: np.ndarray, position: np.ndarray) -> None:
    """Raise an error for targets outside the limits, see `outside_limits`; servos in current mode enforce no limits."""
    if faults := outside_limits(name, joints, limits, time, position):
        raise ValueError(faults[0])


def outside_limits(
    name: str, joints: Sequence[str], limits: np.ndarray, time: np.ndarray, position: np.ndarray
) -> list[str]:
    """One sentence for each joint that a motion moves outside its limits [joint, 2], with the first time."""
    outside = (position < limits[:, 0]) | (position > limits[:, 1])
    faults = []
    for joint in np.flatnonzero(outside.any(0)).tolist():
        row, (low, high) = int(np.argmax(outside[:, joint])), limits[joint]
        faults.append(
            f"motion {name!r} commands {joints[joint]} to {position[row, joint]:.3f} rad at {time[row]:.3f} s;"
            f" its limits are {low:.3f} and {high:.3f} rad"
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
    parts = _self_collision(robot)
    for row, angles in enumerate(position):
        if gap := parts.nearest(angles):
            return [
                f"motion {motion.name!r} brings {gap} at {motion.time[row]:.3f} s; at least"
                f" {CLEARANCE * 1000:.0f} mm are required: reduce or shift the motion (motion.joints, motion.offset)"
            ]
    return []


_self_collision = lru_cache(maxsize=4)(SelfCollision)
