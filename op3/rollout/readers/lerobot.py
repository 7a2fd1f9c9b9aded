"""LeRobot datasets, version 3 and 2.1: parquet with `action` and `observation.state`, an episode per recording.

Positions are in degrees, in radians where no number is as large as a turn, or normalised to a joint's range, which the
calibration file tells: LeRobot's `calibration/.../<robot>.json`, copied into the folder as `calibration.json`.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.guess import guess_all
from op3.rollout.readers.reader import Column, Recording, Stream, needed
from op3.rollout.readers.text import numbers, read_json

_STEP = 2 * math.pi / 4096
_FEATURES = {"observation.state": "", "action": "action "}


class LeRobot:
    """A dataset folder."""

    title = "LeRobot dataset (needs op3[lerobot])"
    paths = "<folder with meta/info.json>"

    def claims(self, path: Path) -> bool:
        """By what lies in the folder."""
        return (path / "meta" / "info.json").is_file()

    def read(self, path: Path) -> list[Recording]:
        """One recording per episode."""
        info = read_json(path / "meta" / "info.json")
        table = _parquet(path, ["timestamp", "episode_index", *_FEATURES])
        time, episode = (numbers(table[name], path / "data", name)[:, 0] for name in ("timestamp", "episode_index"))
        if not len(time):
            raise LogError("the dataset has no row", "record at least one episode", source=path / "data")
        columns = {}
        for feature, prefix in _FEATURES.items():
            names = _names(info, feature, path)
            wide = numbers(table[feature], path / "data", feature, len(names))
            columns |= {prefix + name: wide[:, i] for i, name in enumerate(names)}
        meanings = guess_all(columns)
        _units(columns, meanings, path)
        about = dict(robot="real", mount="stand", extra={"lerobot": str(info.get("robot_type"))})
        recordings = []
        for number in np.unique(episode):
            rows = np.flatnonzero(episode == number)
            part = Stream(time[rows], {name: values[rows] for name, values in columns.items()})
            recordings.append(Recording([part], dict(about), meanings, f"{path.name}/episode_{number:06.0f}"))
        return recordings


def _names(info: dict[str, Any], feature: str, path: Path) -> list[str]:
    """Names along a feature's axis: a list, a list in a mapping, or motors by number."""
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
            problem, remedy = f"the name {twice!r} is there twice", "name every motor once"
            raise LogError(problem, remedy, source=path / "meta" / "info.json", column=feature)
        return [str(name) for name in names]
    shape = entry.get("shape")
    count = shape[0] if isinstance(shape, list) and shape and isinstance(shape[0], int) else 0
    return [f"motor_{i}.pos" for i in range(min(count, 1000))]


def _parquet(path: Path, columns: list[str]) -> dict[str, Any]:
    pyarrow, parquet = (needed(name, "lerobot", path) for name in ("pyarrow", "pyarrow.parquet"))
    try:
        tables = [parquet.ParquetFile(f).read(columns=columns) for f in sorted((path / "data").rglob("*.parquet"))]
        table = pyarrow.concat_tables(tables).to_pydict()
        return {name: table[name] for name in columns}
    except (pyarrow.ArrowException, OSError, KeyError, ValueError, MemoryError) as error:
        said = " ".join(str(error).split())[:120] or "damaged"
        problem = f"the parquet files cannot be read ({said})"
        raise LogError(problem, "copy the dataset again", source=path / "data") from None


def _units(columns: dict[str, np.ndarray], meanings: dict[str, Column], path: Path) -> None:
    """Give positions and targets their unit: normalised where the calibration says so, else degrees or radians."""
    file = next((f for f in (path / "calibration.json", path / "meta" / "calibration.json") if f.is_file()), None)
    calibration = read_json(file) if file else {}
    unit, why = "deg", "LeRobot writes degrees where no calibration is beside it"
    if max(float(np.abs(values).max()) for values in columns.values()) < 2 * math.pi:
        unit, why = "rad", "no number is as large as a turn in radians"
    for name, column in meanings.items():
        joint, _, kind = str(column.name).rpartition(".")
        if kind not in ("position", "target"):
            continue
        meanings[name] = Column(column.name, unit, why=why)
        entry = calibration.get(joint)
        if entry is not None:
            try:
                span = abs(float(entry["range_max"]) - float(entry["range_min"])) * _STEP
            except (KeyError, TypeError, ValueError):
                problem, remedy = "the calibration of the joint has no range", "copy LeRobot's calibration file"
                raise LogError(problem, remedy, source=file, column=joint) from None
            # a gripper runs from 0 to 100 over its range, every other joint from -100 to 100
            size = span / 100 if joint == "gripper" else span / 200
            if 0 < size < math.inf and float(np.abs(columns[name]).max()) <= 100.5:
                meanings[name] = Column(column.name, size, why="normalised to the calibrated range")
