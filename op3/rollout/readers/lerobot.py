"""LeRobot datasets, version 3 and 2.1: parquet with `action` and `observation.state`, one recording per episode.

A motor's name without a quantity means its position. All body joints of a dataset have the same unit: degrees, radians,
or -100 to 100 over the joint's range; a gripper has 0 to 100 over its range. The ranges are in LeRobot's
`calibration/.../<robot>.json`, which must be copied into the folder as `calibration.json`. The unit is taken from
names, `info.json` or an old calibration; otherwise it is the unit in which all positions are integer encoder counts.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.finding import ERROR, WARNING, LogFinding
from op3.rollout.guess import guess, guess_all
from op3.rollout.match import step
from op3.rollout.readers.reader import Column, Recording, Stream, needed
from op3.rollout.readers.text import numbers, read_json
from op3.rollout.units import COUNTS, TURN_COUNTS, canonical

_CHECK = "unit of LeRobot"
_NORMAL = 100.5
"""Largest normalised value: 100 with a small margin."""

_ON, _OFF = 0.1, 0.15
"""Distances in grid steps below which numbers are on a grid, and above which they are not; 0.29 by chance."""

_HANDS = ("gripper", "grip", "jaw", "jaws", "claw", "finger", "fingers", "thumb", "hand", "clamp")
"""Endings of words that denote grippers in joint names."""

_WRITES_GAIN = re.compile("so-?10[01]|lekiwi")
"""Position gains that LeRobot writes to the servos of each robot."""

_GAIN = 16.0

_FEATURES = {"observation.state": "", "action": "action "}


class LeRobot:
    """A dataset folder."""

    title = "LeRobot dataset (needs op3[lerobot])"
    paths = "<folder with meta/info.json>"

    def claims(self, path: Path) -> bool:
        """Recognised by the files in the folder."""
        return (path / "meta" / "info.json").is_file()

    def read(self, path: Path) -> list[Recording]:
        """One recording per episode."""
        info = read_json(path / "meta" / "info.json")
        table = _parquet(path, ["timestamp", "episode_index", *_FEATURES])
        time, episode = (numbers(table[name], path / "data", name)[:, 0] for name in ("timestamp", "episode_index"))
        if not len(time):
            raise LogError("the dataset has no rows", "record at least one episode", source=path / "data")
        promised = info.get("total_frames")
        if isinstance(promised, int) and len(time) < promised:
            problem = f"info.json states {promised} frames, but the parquet files have {len(time)}"
            raise LogError(problem, "copy the missing files", source=path / "data")
        columns = {}
        for feature, prefix in _FEATURES.items():
            names = _names(info, feature, path)
            cell = table[feature][0]
            if isinstance(cell, list) and len(cell) != len(names):
                problem = f"there are {len(names)} names, but a row of {feature} has {len(cell)} numbers"
                raise LogError(problem, "name every motor", source=path / "meta" / "info.json", column=feature)
            wide = numbers(table[feature], path / "data", feature, len(names))
            columns |= {prefix + _with_channel(name): wide[:, i] for i, name in enumerate(names)}
        meanings = guess_all(columns)
        doubts = _units(columns, meanings, info, path)
        fps = {"rate": float(info["fps"])} if isinstance(info.get("fps"), int | float) and info["fps"] > 0 else {}
        kind = str(info.get("robot_type"))
        about = fps | dict(robot="real", mount="stand", extra={"lerobot": kind})
        if _WRITES_GAIN.search(kind.lower()):
            about["firmware_gain"] = _GAIN
            problem = f"the gain {_GAIN:g}, which LeRobot writes to the servos of {kind}, is assumed"
            remedy = "write `firmware_gain:` into the YAML if another gain was set"
            doubts.append(LogFinding(WARNING, problem, remedy, "field firmware_gain", check="gain of LeRobot"))
        recordings = []
        for number in np.unique(episode):
            rows = np.flatnonzero(episode == number)
            part = Stream(time[rows], {name: values[rows] for name, values in columns.items()})
            name = f"{path.name}/episode_{number:06.0f}"
            recordings.append(Recording([part], dict(about), meanings, name, doubts=doubts))
        return recordings


def _names(info: dict[str, Any], feature: str, path: Path) -> list[str]:
    """Names along a feature's axis, from a list, a list in a mapping, or motor numbers."""
    features = info.get("features")
    entry = features.get(feature) if isinstance(features, dict) else None
    if not isinstance(entry, dict):
        problem, remedy = f"the dataset has no {feature}", "record a dataset of a robot with motors"
        raise LogError(problem, remedy, source=path / "meta" / "info.json", column=feature)
    names = entry.get("names")
    while isinstance(names, dict) and names:
        names = next(iter(names.values()))
    if isinstance(names, list):
        if twice := next((name for name in names if names.count(name) > 1), None):
            problem, remedy = f"the name {twice!r} appears twice", "give every motor a unique name"
            raise LogError(problem, remedy, source=path / "meta" / "info.json", column=feature)
        return [str(name) for name in names]
    shape = entry.get("shape")
    count = shape[0] if isinstance(shape, list) and shape and isinstance(shape[0], int) else 0
    return [f"motor_{i}.pos" for i in range(min(count, 1000))]


def _with_channel(name: str) -> str:
    """The name with its quantity appended, by default a position unless it is a trunk sensor."""
    meant = guess(name)
    says = meant is not None and meant.name is not None and (not meant.name.startswith("imu") or "imu" in name.lower())
    return name if says else f"{name}.pos"


def _parquet(path: Path, columns: list[str]) -> dict[str, Any]:
    pyarrow, parquet = (needed(name, "lerobot", path) for name in ("pyarrow", "pyarrow.parquet"))
    try:
        tables = [parquet.ParquetFile(f).read(columns=columns) for f in sorted((path / "data").rglob("*.parquet"))]
        table = pyarrow.concat_tables(tables).to_pydict()
    except (pyarrow.ArrowException, OSError, ValueError, MemoryError) as error:
        said = " ".join(str(error).split())[:120] or "damaged"
        problem = f"the parquet files cannot be read ({said})"
        raise LogError(problem, "copy the dataset again", source=path / "data") from None
    if missing := next((name for name in columns if name not in table), None):
        remedy = "record the dataset again, or convert it to version 2.1 or 3"
        raise LogError("the column is missing in the parquet files", remedy, source=path / "data", column=missing)
    return table


@dataclass(frozen=True)
class _Range:
    """Calibration of a joint.

    Attributes:
        counts: Width of the range in counts; 0 if there is none.
        unit: `deg` or `percent`, if an old file states it.
    """

    counts: float = 0.0
    unit: str = ""


def _calibration(joints: Sequence[str], path: Path) -> dict[str, _Range]:
    """The ranges of these joints from a LeRobot calibration file of either form; empty if there is none."""
    file = next((f for f in (path / "calibration.json", path / "meta" / "calibration.json") if f.is_file()), None)
    if file is None:
        return {}
    content, found = read_json(file), {}
    names = content.get("motor_names")
    for joint in joints:
        try:
            if isinstance(names, list):  # one list per field, the format until mid-2025
                at = names.index(joint)
                unit = "deg" if content["calib_mode"][at] == "DEGREE" else "percent"
                found[joint] = _Range(abs(float(content["end_pos"][at]) - float(content["start_pos"][at])), unit)
            else:
                entry = content[joint]
                found[joint] = _Range(abs(float(entry["range_max"]) - float(entry["range_min"])))
        except (ValueError, KeyError, TypeError, IndexError):
            known = [str(name) for name in (names if isinstance(names, list) else content)]
            if joint not in known:
                problem = f"the calibration does not have this joint; it has {', '.join(known)[:120]}"
                remedy = (
                    "copy this robot's calibration file; for two arms, put the entries into one file under these names"
                )
            else:
                problem, remedy = "the calibration of the joint has no range", "copy LeRobot's calibration file"
            raise LogError(problem, remedy, source=file, column=joint) from None
    return found


def _said(content: Any) -> str | None:
    """The unit of body joints if a text in the description states it."""
    if isinstance(content, dict):
        if isinstance(content.get("use_degrees"), bool):
            return "deg" if content["use_degrees"] else "normalised"
        if (unit := canonical(str(content.get("unit") or content.get("units")).lower())) in ("deg", "rad"):
            return unit
    parts = content.values() if isinstance(content, dict) else content if isinstance(content, list) else ()
    return next((unit for part in parts if (unit := _said(part))), None)


def _apart(values: np.ndarray, step: float) -> float:
    """Distance of numbers from a grid through the first number, in grid steps; NaN if they span few steps."""
    if not 0 < step < np.ptp(values) / 5:
        return math.nan
    steps = (values - values[0]) / step
    return float(np.sqrt(((steps - np.round(steps)) ** 2).mean()))


def _grids(unit: str, counts: float) -> tuple[float, ...]:
    """Size of an encoder count in a unit; LeRobot divides a turn by one count less."""
    turn = {"deg": 360.0, "rad": 2 * math.pi}.get(unit)
    if turn is not None:
        return turn / (TURN_COUNTS - 1), turn / TURN_COUNTS
    return ({"normalised": 200.0, "percent": 100.0}[unit] / counts,) if counts and unit != COUNTS else ()


def _misfit(unit: str, joints: Mapping[str, np.ndarray], ranges: Mapping[str, _Range]) -> float:
    """Distance of the joints' numbers from the grid of a unit, in grid steps; NaN if no joint allows a decision."""
    every = [
        [_apart(values, grid) for grid in _grids(unit, ranges.get(joint, _Range()).counts)]
        for joint, values in joints.items()
    ]
    tried = [np.array(one)[~np.isnan(one)] for one in zip(*filter(None, every), strict=True)]
    return min((float(np.sqrt((one**2).mean())) for one in tried if len(one)), default=math.nan)


def _body_unit(
    joints: Mapping[str, np.ndarray], ranges: Mapping[str, _Range], said: str | None
) -> tuple[str, str, LogFinding | None]:
    """The unit of the body joints, the evidence for it, and the remaining doubt."""
    if said is not None:
        return said, "info.json states it", None
    if {known.unit for joint, known in ranges.items() if joint in joints} - {""}:
        return "deg", "the calibration states it", None
    most = np.array([np.abs(values).max() for values in joints.values()] or [0.0])
    if most.max() > 360 and not any((values % 1).any() for values in joints.values()):
        why = f"whole numbers of up to {most.max():g}"
        problem = f"{why} are assumed to be {COUNTS}"
        return COUNTS, why, LogFinding(WARNING, problem, "write `unit:` if the servo's unit differs", check=_CHECK)
    units = ["deg"]
    if np.quantile(most, 0.75) < 2 * math.pi and most.max() < 8 * math.pi:
        units.append("rad")
    if most.max() <= _NORMAL and any(known.counts for known in ranges.values()):
        units.append("normalised")
    apart = {unit: _misfit(unit, joints, ranges) for unit in units}
    on = [unit for unit in units if apart[unit] < _ON]
    if on:
        unit = min(on, key=apart.__getitem__)
        return unit, f"all joints lie on the grid of encoder counts, {apart[unit]:.2g} steps off", None
    beyond = [joint for joint, known in ranges.items() if joint in joints and known.counts]
    beyond = [j for j in beyond if np.abs(joints[j]).max() > 1.05 * 180 * ranges[j].counts / TURN_COUNTS]
    if beyond and "normalised" in units:
        return "normalised", f"in degrees {beyond[0]} would exceed its range", None
    if most.max() > _NORMAL:
        return "deg", "values exceed 100", None
    steps = step(np.stack(list(joints.values()), axis=1)) if joints else np.zeros(0)
    steps = steps[(steps > 0.03) & (steps < 1)]
    if len(steps) > 1 and not ranges and apart["deg"] > _OFF and np.ptp(steps) > 0.03 * steps.max():
        problem = (
            f"the numbers come in steps of {', '.join(f'{one:.3g}' for one in steps[:4])}, different for each joint: "
        )
        problem += "they are normalised to the joints' ranges, which are unknown"
        remedy = "copy LeRobot's calibration file there as calibration.json"
        return "deg", "there is no other evidence", LogFinding(ERROR, problem, remedy, check=_CHECK)
    if "rad" in units:
        return "rad", "few values exceed a turn in radians", None
    problem = f"numbers of up to {most.max():.4g} without a unit are read as degrees, but could be normalised values"
    remedy = "write `unit: deg`, or the size of the unit, under `columns:` in a YAML"
    if not ranges:
        remedy = f"copy LeRobot's calibration file there as calibration.json, or {remedy}"
    why = "degrees are assumed, since no unit is given; numbers of -100 to 100 may be normalised to a range"
    return "deg", why, LogFinding(WARNING, problem, remedy, check=_CHECK)


def _units(
    columns: dict[str, np.ndarray], meanings: dict[str, Column], info: dict[str, Any], path: Path
) -> list[LogFinding]:
    """Set the unit of positions and targets; return the remaining doubts."""
    angles = {n: c for n, c in meanings.items() if str(c.name).rpartition(".")[2] in ("position", "target")}
    named = {name: next((u for u in map(canonical, _words(name)) if u in ("deg", "rad")), None) for name in angles}
    joint_of = {name: str(column.name).rpartition(".")[0] for name, column in angles.items()}
    free = {j for name, j in joint_of.items() if named[name] is None}
    ranges = _calibration(sorted(free), path)
    read = {joint_of[name]: columns[name] for name in angles if str(angles[name].name).endswith(".position")}
    read = {joint: values for joint, values in read.items() if joint in free}
    hands = {joint for joint, values in read.items() if _opens(joint, values, ranges)}
    body = {joint: values for joint, values in read.items() if joint not in hands}
    said = _said(info) or next((unit for unit in named.values() if unit), None)
    unit, why, doubt = _body_unit(body, ranges, said)
    for joint in sorted(hands):  # a gripper with the unit of the body
        own = {joint: read[joint]}
        fits = unit != "normalised" and _misfit(unit, own, ranges) < _ON and not _misfit("percent", own, ranges) < _ON
        if fits or (unit == "rad" and np.abs(read[joint]).max() < 2 * math.pi):
            hands.remove(joint)
    for name, column in meanings.items():
        if unit == "deg" and column.unit is None and str(column.name).endswith(".velocity"):
            meanings[name] = Column(column.name, "deg/s", why="positions are in degrees")
    column = next((name for name, joint in joint_of.items() if joint in body), None)
    doubts = [replace(doubt, column=column)] if doubt else []
    for name, column in angles.items():
        joint = joint_of[name]
        span = 2 * math.pi / TURN_COUNTS * ranges.get(joint, _Range()).counts
        if named[name] is not None:
            meanings[name] = Column(column.name, named[name], why=f"the name states {named[name]}")
        elif joint in hands and span:
            meanings[name] = Column(column.name, span / 100, why="0 to 100 over the range of a gripper")
        elif joint in hands:
            low, high = float(columns[name].min()), float(columns[name].max())
            meanings[name] = Column(column.name, "deg", why="the range of the gripper is not given")
            if high < 1.5:
                meanings[name] = Column(None, why="normalised from 0 to 1 by an unknown range")
            elif low >= 0 and high - low > 5 and not any("gripper values" in one.problem for one in doubts):
                problem = f"gripper values from {low:.4g} to {high:.4g} are read as degrees; LeRobot's go from 0 to"
                problem += " 100 over its range"
                remedy = "copy LeRobot's calibration file there as calibration.json, or give the unit under `columns:`"
                doubts.insert(0, LogFinding(WARNING, problem, remedy, name, check=_CHECK))
        elif unit == "normalised" and not span:
            problem = "the numbers are normalised to the joint's range, which is unknown"
            raise LogError(
                problem, "copy LeRobot's calibration file there as calibration.json", source=path, column=name
            )
        elif unit == "normalised":
            meanings[name] = Column(column.name, span / 200, why=f"-100 to 100 over the calibrated range: {why}")
        else:
            meanings[name] = Column(column.name, unit, why=f"{unit}: {why}")
    return doubts


def _words(name: str) -> set[str]:
    return set(re.split("[^a-z]+", name.lower()))


def _opens(joint: str, values: np.ndarray, ranges: Mapping[str, _Range]) -> bool:
    """Whether a joint has values from 0 to 100 over its range: they fit, and its name or their grid confirms it."""
    if values.min() < 100 - _NORMAL or values.max() > _NORMAL:
        return False
    if ranges.get(joint, _Range()).unit == "percent" or any(word.endswith(_HANDS) for word in _words(joint)):
        return True
    fits = {unit: _misfit(unit, {joint: values}, ranges) for unit in ("percent", "normalised", "deg", "rad")}
    return fits.pop("percent") < _ON and all(not apart < _OFF for apart in fits.values())
