"""The robot of a log, and conversion of external logs to the conventions of a robot file."""

from __future__ import annotations

import numpy as np

from op3.robot.robot import Robot
from op3.rollout.errors import LogError, rename
from op3.rollout.rollout import Rollout
from op3.rollout.schema import CHANNELS


def called(robot: Robot) -> dict[str, str]:
    """The robot's joints, by their names in external logs and by their names in the robot file."""
    return {robot.log_channel(name)[0].name or name: name for name in robot.joints} | {n: n for n in robot.joints}


def in_its_terms(robot: Robot, joint: str, kind: str) -> tuple[int, float, float]:
    """Sign, size of the unit and offset that convert a column of a robot's logs to SI units.

    Args:
        robot: robot that made the log.
        joint: name of the joint.
        kind: quantity in the column name of the wide CSV, after the joint.
    """
    channel, unit = robot.log_channel(joint)
    if kind in ("position", "target"):
        return channel.sign, unit, -channel.sign * channel.zero * unit + 0.0
    if kind == "velocity":
        return channel.sign, unit * channel.velocity_factor, 0.0
    return (channel.sign if kind in ("current", "duty", "load") else 1), 1.0, 0.0


def as_robot(log: Rollout, robot: Robot) -> Rollout:
    """A log in the conventions of a robot: joint names and order from its file, angles in rad from its zeros.

    Args:
        log: the recorded log, with the robot file's joint names or its names for external logs.
        robot: robot that made the log.

    Raises:
        LogError: if the log has a joint that the robot does not have.
    """
    known = called(robot)
    for joint in log.joints:
        if joint not in known:
            remedy = rename(joint, known, f"rename it, or name its robot=; {robot.name} has {', '.join(robot.joints)}")
            raise LogError("unknown joint", remedy, source=log.metadata.recording, column=joint)
    names = [known[joint] for joint in log.joints]
    order = np.argsort(robot.indices(names))
    joints = tuple(names[column] for column in order)
    arrays = {}
    for key in log.channels:
        arrays[key] = log.array(key)
        if CHANNELS[key].axes == "joint":
            kind = CHANNELS[key].column.rpartition(".")[2]
            sign, size, offset = (
                np.array(x) for x in zip(*(in_its_terms(robot, j, kind) for j in joints), strict=True)
            )
            arrays[key] = sign * size * arrays[key][..., order] + offset
    return Rollout.from_arrays(arrays, log.metadata.replace(joints=joints, robot_file=robot.reference))


def stand_tilt(log: Rollout) -> tuple[float, float] | None:
    """Roll and pitch of the stand [rad], rounded to 0.01: from the IMU, otherwise ``tilt`` in the metadata's ``extra``.

    Returns:
        None if neither exists.
    """
    if "imu/orientation" in log:
        roll, pitch = log.array("imu/orientation")[:, :2].mean(0)
    elif "tilt" in log.metadata.extra:
        roll, pitch = log.metadata.extra["tilt"]
    else:
        return None
    return round(float(roll), 2) + 0.0, round(float(pitch), 2) + 0.0
