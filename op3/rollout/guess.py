"""What a foreign column name probably means."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence

from op3.rollout.readers.reader import Column
from op3.rollout.schema import CHANNELS, Key, joint_suffixes

_WORDS: tuple[tuple[str, Key], ...] = (
    (
        "target goal command commanded cmd desired des ref reference setpoint action ctrl control",
        ("command", "position"),
    ),
    ("velocity velocities vel speed speeds qvel dq qd", ("joint", "velocity")),
    ("current currents cur amps", ("joint", "current")),
    ("pwm duty", ("joint", "duty")),
    ("torque torques effort efforts tau load", ("joint", "load")),
    ("voltage volt volts", ("joint", "voltage")),
    ("temperature temperatures temp", ("joint", "temperature")),
    ("enable enabled", ("command", "torque_enable")),
    ("kp", ("command", "firmware_gain")),
    ("position positions pos angle angles q qpos theta state", ("joint", "position")),
)
_IMU = {"gyro": "gyro", "gyroscope": "gyro", "angular": "gyro", "acc": "acc", "accel": "acc", "accelerometer": "acc"}
_IMU |= {"linear": "acc", "acceleration": "acc"}
_UNITS = {"deg": "deg", "degrees": "deg", "degree": "deg", "rad": None, "radians": None, "rpm": "rpm", "dps": "deg/s"}
_UNITS |= {"ma": "mA", "mv": "mV", "ms": "ms", "us": "us", "ns": "ns", "percent": "percent", "mrad": "mrad"}
_FILLERS = {
    "joint",
    "joints",
    "present",
    "measured",
    "actual",
    "motor",
    "s",
    "value",
    "observation",
    "imu",
    "of",
    "main",
}
_TIMES = {"time", "timestamp", "t", "stamp", "secs", "seconds", "times"}


def guess(name: str, joints: Sequence[str] = ()) -> Column | None:
    """The meaning of a column by its name; None where nothing speaks for one.

    Args:
        name: In the file.
        joints: Names the robot has; a joint that is nearly one of them is taken for it.
    """
    joint, _, suffix = name.rpartition(".")
    if suffix in joint_suffixes() and joint and (not joints or joint in joints):
        return Column(name)
    if any(name == c.column or name in (c.column.format(axis=a) for a in c.axis_names) for c in _plain_channels()):
        return Column(name)
    words = [word for word in re.split(r"[^A-Za-z0-9]+|(?<=[a-z])(?=[A-Z])", name) if word]
    lower = [word.lower() for word in words]
    units = [_UNITS[word] for word in lower if word in _UNITS]
    unit = next(iter(units), None)
    if lower and lower[0] in _TIMES:
        return Column("time", unit, why=f"{name!r} names a time")
    axis = next((word for word in lower if word in ("x", "y", "z", "roll", "pitch", "yaw")), None)
    sensor = next((_IMU[word] for word in lower if word in _IMU), None)
    if axis in ("x", "y", "z") and sensor:
        spelt = "deg/s" if unit == "deg" and sensor == "gyro" else unit
        return Column(f"imu.{sensor}_{axis}", spelt, why=f"{name!r} names an axis of the {sensor}")
    if axis in ("roll", "pitch", "yaw") and not set(lower) - {axis, "imu", "deg", "rad", "orientation", "rpy"}:
        return Column(f"imu.{axis}", unit, why=f"{name!r} names an angle of the trunk")
    for spellings, key in _WORDS:
        found = [word for word in lower if word in spellings.split()]
        if found:
            known = {word for listed, _ in _WORDS for word in listed.split()} | _FILLERS | set(_UNITS)
            rest = [word for word in words if word.lower() not in known]
            joint = _joint("_".join(rest), joints)
            spelt = "deg/s" if unit == "deg" and key[1] == "velocity" else unit
            column = CHANNELS[key].column.format(joint=joint)
            return Column(column, spelt, why=f"{found[0]!r} in {name!r}") if joint else None
    joint = _joint(name, joints) if joints else ""
    return Column(f"{joint}.position", unit, why=f"{name!r} names a joint") if joint in joints else None


def _plain_channels():
    return [channel for channel in CHANNELS.values() if channel.axes in ("scalar", "imu3")]


def _joint(name: str, joints: Sequence[str]) -> str:
    """The joint that a name means; the only one where the name is empty."""
    if not joints:
        return re.sub(r"[^A-Za-z0-9_-]", "_", name).strip("_") or "servo"
    if name in joints:
        return name
    if not name and len(joints) == 1:
        return joints[0]
    close = difflib.get_close_matches(name.lower(), [joint.lower() for joint in joints], n=1, cutoff=0.75)
    return next((joint for joint in joints if close and joint.lower() == close[0]), name)


def guess_all(names: Iterable[str], joints: Sequence[str] = ()) -> dict[str, Column]:
    """Meanings of columns by name; of two that would mean the same the first counts, the other is left out."""
    meanings: dict[str, Column] = {}
    taken: dict[str, str] = {}
    for name in names:
        column = guess(name, joints)
        if column is None:
            meanings[name] = Column(None, why="nothing in the name says what it is")
        elif column.name in taken:
            meanings[name] = Column(None, why=f"{taken[column.name]!r} means the same already")
        else:
            meanings[name] = column
            taken[str(column.name)] = name
    return meanings
