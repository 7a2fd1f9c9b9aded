"""Guesses the meaning of a column name of another format."""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Iterable, Sequence

from op3.rollout.readers.reader import Column
from op3.rollout.schema import CHANNELS, normal_key, place
from op3.rollout.units import COUNTS, UNITS, canonical

_SPELLINGS: dict[str, str] = {
    "command/position": "target goal command commands commanded cmd desired des ref reference setpoint action actions"
    " ctrl control",
    "joint/velocity": "velocity velocities vel speed speeds qvel dq qd omega dps rpm",
    "joint/current": "current currents cur amps ma",
    "joint/duty": "pwm duty",
    "joint/load": "torque torques effort efforts tau load",
    "joint/voltage": "voltage volt volts mv",
    "joint/temperature": "temperature temperatures temp",
    "command/torque_enable": "enable enabled",
    "command/firmware_gain": "kp",
    "command/d_gain": "kd",
    "joint/position": "position positions pos angle angles q qpos theta state",
}
_WORDS = {word: normal_key(name) for name, words in _SPELLINGS.items() for word in words.split()}
"""Words for the measured quantity; if a name contains several, the first in this list counts."""

_SENSED = ("present", "measured", "meas", "actual", "act", "feedback", "raw")
"""Words for a measured value; without a word for a quantity, the value is a position."""

_NO_POSITIONS = {normal_key(f"joint/{kind}") for kind in ("velocity", "current", "duty", "load", "voltage")}
"""Quantities other than positions, whose targets are not position targets."""

_IMU = {"gyro": "gyro", "gyroscope": "gyro", "angular": "gyro", "acc": "acc", "accel": "acc", "accelerometer": "acc"}
_IMU |= {"linear": "acc", "acceleration": "acc"}
_UNITS = {"deg": "deg", "degrees": "deg", "degree": "deg", "rad": None, "radians": None, "rpm": "rpm", "dps": "deg/s"}
_UNITS |= {"ma": "mA", "mv": "mV", "ms": "ms", "us": "us", "ns": "ns", "percent": "percent", "mrad": "mrad"}
_UNITS |= {"ticks": COUNTS, "counts": COUNTS}
_UNITS |= {"°": "deg", "degs": "deg/s", "radps": None, "rads": None}
_SUFFIXES = {"a": None, "v": None, "c": None, "degc": None, "nm": None, "est": None, "pct": "percent"}
_FILLERS = re.split(" ", "joint joints present measured meas actual act raw motor i s value observation imu of main")
_TIMES = ("time", "timestamp", "t", "stamp", "secs", "seconds", "times", "date", "datetime")


def guess(name: str, joints: Sequence[str] = ()) -> Column | None:
    """The meaning that a column's name suggests; None if there is none.

    Args:
        name: Name in the file.
        joints: Joints of the robot; a nearly equal name is matched to a joint.
    """
    name = _of_path(name)
    ours = place(name)
    if ours and (ours[0].axes != "joint" or not joints or ours[1] in joints):
        return Column(name)
    words = [word for word in re.split(r"[^A-Za-z0-9°]+|(?<=[a-z]{2})(?=[A-Z])", name) if word]
    said = re.search(r"\s*[\[(]([^\])]+)[\])]\s*$", name)
    if said and (found := guess(name[: said.start()], joints)) and found.name and (of := place(found.name)):
        unit = canonical(said[1])
        unit = "deg/s" if unit == "deg" and found.name.endswith("velocity") else unit
        if unit in UNITS.get(of[0].quantity.unit, {}):
            return dataclasses.replace(found, unit=None if unit == of[0].quantity.unit else unit)
    lower = [word.lower() for word in words]
    if len(words) > 2 and lower[-1] in _SUFFIXES and any(word in _WORDS for word in lower[:-1]):
        found = guess(name[: name.rindex(words[-1])].rstrip("_ .-/"), joints)
        if found and found.name and found.name.partition(".")[0] not in ("joint", "servo"):
            return dataclasses.replace(found, unit=found.unit or _fitting(found.name, _SUFFIXES[lower[-1]]))
    unit = next((_UNITS[word] for word in lower if word in _UNITS), None)
    rate = "deg/s" if unit == "deg" else unit
    if lower and lower[0] in _TIMES:
        return Column("time", unit, why=f"{name!r} names a time")
    axis = next((word for word in lower if word in ("x", "y", "z", "roll", "pitch", "yaw")), None)
    sensor = next((_IMU[word] for word in lower if word in _IMU), None)
    if axis in ("x", "y", "z") and sensor:
        return Column(f"imu.{sensor}_{axis}", rate if sensor == "gyro" else unit, why=f"{name!r} names an axis")
    if axis in ("roll", "pitch", "yaw") and not set(lower) - {axis, "imu", "deg", "rad", "orientation", "rpy"}:
        return Column(f"imu.{axis}", unit, why=f"{name!r} names an angle of the trunk")
    meant = {_WORDS[word] for word in lower if word in _WORDS}
    if {"error", "err"} & set(lower) or (meant & {normal_key("command/position")} and meant & _NO_POSITIONS):
        return Column(None, why=f"{name!r} is neither an angle nor an angle's target")
    word = next((word for word in (*_WORDS, *_SENSED) if word in lower), None)
    if word is not None:
        known = {*_WORDS, *_FILLERS, *_UNITS}
        whole = f"_{'_'.join(words).lower()}_"  # the name of a joint may contain such words, for example wrist_angle
        named = max((one for one in joints if f"_{one.lower()}_" in whole), key=len, default=None)
        joint = named or _joint("_".join(w for w in words if w.lower() not in known), joints)
        column = CHANNELS[_WORDS.get(word, normal_key("joint/position"))].column.format(joint=joint)
        unit = _fitting(column, rate if column.endswith("velocity") else unit)
        return Column(column, unit, why=f"{word!r} in {name!r}")
    joint = _joint(name, joints) if joints else ""
    return Column(f"{joint}.position", unit, why=f"{name!r} names a joint") if joint in joints else None


def _fitting(name: str, unit: str | None) -> str | None:
    """The unit, if the quantity of a column can have it: not percent of an angle, or the deg of degC."""
    known = place(name)
    return unit if known and unit in UNITS.get(known[0].quantity.unit, {}) else None


def _of_path(name: str) -> str:
    """Turns a name such as `/arm/commands/elbow/position` into `elbow command position`: the joint and the topic's
    words.

    Names without a topic and names of trunk sensors are unchanged. An index stands for a joint.
    """
    parts = [part for part in name.split("/") if part]
    words = [[word for word in re.split("[^a-z]+", part.lower()) if word] for part in parts]
    said = {word for part in words for word in part}
    if len(parts) < 2 or name[0] != "/" or {*_IMU, "imu", "header"} & said:
        return name
    commands = {word for word, key in _WORDS.items() if key == normal_key("command/position")}
    about = [set(part) <= {*_WORDS, *_SENSED, *_FILLERS, "states"} for part in words]
    kinds = [word for part in words[::-1] for word in part if word in _WORDS and word not in commands]
    if not kinds:
        return name
    index = re.search(r"\d+(?=\]?$)", parts[-1])
    own = next((part for part, is_about in zip(parts[::-1], about[::-1], strict=True) if not is_about), "")
    prefix = "command " if commands & said and not {*_SENSED} & said else "error " if "error" in said else ""
    return f"{index[0] if index and about[-1] else own} {prefix}{kinds[0]}"


def _joint(name: str, joints: Sequence[str]) -> str:
    """The joint that a name means; if the name is empty, the only joint."""
    if not joints:
        name = re.sub(r"[^A-Za-z0-9_-]", "_", name).strip("_") or "servo"
        return f"joint_{name}" if name[0].isdigit() else name
    if not name and len(joints) == 1:
        return joints[0]
    by_lower = {joint.lower(): joint for joint in joints}
    within = [one for one in by_lower if f"_{one}_" in f"_{name.lower()}_"]
    close = within if len(within) == 1 else difflib.get_close_matches(name.lower(), by_lower, n=2, cutoff=0.75)
    if len(close) > 1:  # equally similar to a left and a right joint
        first, second = (difflib.SequenceMatcher(None, one, name.lower()).ratio() for one in close)
        close = close[: first > second]
    return by_lower[close[0]] if close and name not in joints else name


def guess_all(names: Iterable[str], joints: Sequence[str] = ()) -> dict[str, Column]:
    """Meanings of columns by name; if two columns have the same meaning, the second is omitted."""
    meanings: dict[str, Column] = {}
    taken: dict[str | None, str] = {}
    for name in names:
        column = guess(name, joints) or Column(None, why="the name does not indicate a quantity")
        if column.name is not None and taken.setdefault(column.name, name) != name:
            column = Column(None, why=f"{taken[column.name]!r} already has this meaning")
        meanings[name] = column
    measured, asked = (
        {key.rpartition(".")[0] for key in taken if key and key.endswith(end)} for end in (".position", ".target")
    )
    for name in [name for name, column in meanings.items() if column.name is None and " quantity" in column.why]:
        bare = guess(f"pos {name}", joints)  # the name of a joint that has a target is its position
        if bare and bare.name not in taken and str(bare.name).rpartition(".")[0] in asked - measured:
            meanings[name] = dataclasses.replace(bare, why=f"{name!r} names a joint")
            taken[bare.name] = name
    placed = {name: place(column.name) for name, column in meanings.items() if column.name}
    groups = {name: known[1] for name, known in placed.items() if known and known[0].axes == "joint"}
    moved = {joint for name, joint in groups.items() if placed[name][0].required}  # pyright: ignore
    for name, joint in groups.items() if moved else ():
        if joint in moved or not meanings[name].why:
            continue
        # a name without angle and target is not a joint; a single joint may have columns without a joint name
        ours = str(meanings[name].name).replace(joint, next(iter(moved)), 1)
        why = f"no column contains an angle of {joint}"
        lone = len(moved) == 1 and "servo" in moved and ours not in taken
        meanings[name] = dataclasses.replace(meanings[name], name=ours) if lone else Column(None, why=why)
        taken[ours] = name
    if any(str(column.name).endswith(".d_gain") for column in meanings.values()):  # the computer closes the loop
        for name, column in meanings.items():
            if str(column.name).endswith(".firmware_gain") and column.why:
                ours = str(column.name).replace(".firmware_gain", ".p_gain")
                meanings[name] = dataclasses.replace(column, name=ours)
    return meanings
