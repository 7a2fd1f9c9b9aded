"""Logs of a robot by others: its own names, signs, zeros and units, from the robot's file."""

from __future__ import annotations

import difflib

import numpy as np

from op3.robot.robot import Robot
from op3.rollout.errors import LogError
from op3.rollout.rollout import Rollout
from op3.rollout.schema import CHANNELS, Key

ANGLES = (("joint", "position"), ("command", "position"))
"""Channels that have a zero."""

SIGNED = (("joint", "velocity"), ("joint", "current"), ("joint", "duty"))
"""Channels that only have a sign, the velocity in units of the angle per second."""


def as_robot(log: Rollout, robot: Robot) -> Rollout:
    """A log in the terms of a robot: joints named and ordered as in its file, angles in rad from its zeros.

    Args:
        log: as it was recorded, its joints called as here or as the robot's file says that its logs call them.
        robot: that made it.

    Raises:
        LogError: if the log has a joint that the robot has not.
    """
    called = {robot.log_channel(name)[0].name or name: name for name in robot.joints} | {n: n for n in robot.joints}
    for joint in log.joints:
        if joint not in called:
            close = difflib.get_close_matches(joint, called, n=1)
            remedy = f"rename it {close[0]}" if close else f"{robot.name} has {', '.join(robot.joints)}"
            raise LogError("unknown joint", remedy, source=log.metadata.recording, column=joint)
    names = [called[joint] for joint in log.joints]
    order = np.argsort(robot.indices(names))
    joints = tuple(names[column] for column in order)
    arrays = {}
    for key in log.channels:
        values = log.array(key)
        if CHANNELS[key].axes == "joint":
            values = values[..., order]
            for column, joint in enumerate(joints) if key in ANGLES + SIGNED else ():
                values[..., column] = _converted(key, values[..., column], robot, joint)
        arrays[key] = values
    return Rollout.from_arrays(arrays, log.metadata.replace(joints=joints, robot_file=robot.reference))


def _converted(key: Key, values: np.ndarray, robot: Robot, joint: str) -> np.ndarray:
    channel, unit = robot.log_channel(joint)
    if key in ANGLES:
        return channel.sign * (values - channel.zero) * unit
    return channel.sign * values * (channel.velocity_factor * unit if key[1] == "velocity" else 1.0)
