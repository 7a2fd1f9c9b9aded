"""LeRobot datasets, version 3 and 2.1: parquet with `action` and `observation.state`, an episode per recording.

A motor's bare name means its position. Positions are in the unit that names say; else in degrees, in radians where
hardly a joint tells as much as a turn, or normalised to a joint's range, which the calibration file tells: LeRobot's
`calibration/.../<robot>.json`, copied into the folder as `calibration.json`.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.guess import guess, guess_all
from op3.rollout.health.finding import WARNING, Finding
from op3.rollout.health.match import step
from op3.rollout.readers.reader import Column, Recording, Stream, needed
from op3.rollout.readers.text import numbers, read_json
from op3.rollout.units import canonical

_STEP = 2 * math.pi / 4096
_NORMAL = 100.5
"""Normalised numbers go to 100, and hardly beyond."""

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
        promised = info.get("total_frames")
        if isinstance(promised, int) and len(time) < promised:
            problem = f"info.json says {promised} frames, and the parquet files hold {len(time)}"
            raise LogError(problem, "copy the missing files", source=path / "data")
        columns = {}
        for feature, prefix in _FEATURES.items():
            names = _names(info, feature, path)
            cell = table[feature][0]
            if isinstance(cell, list) and len(cell) != len(names):
                problem = f"{len(names)} names stand there, and a row of {feature} has {len(cell)} numbers"
                raise LogError(problem, "name every motor", source=path / "meta" / "info.json", column=feature)
            wide = numbers(table[feature], path / "data", feature, len(names))
            columns |= {prefix + _told(name): wide[:, i] for i, name in enumerate(names)}
        meanings = guess_all(columns)
        doubts = _units(columns, meanings, path)
        fps = {"rate": float(info["fps"])} if isinstance(info.get("fps"), int | float) and info["fps"] > 0 else {}
        about = fps | dict(robot="real", mount="stand", extra={"lerobot": str(info.get("robot_type"))})
        recordings = []
        for number in np.unique(episode):
            rows = np.flatnonzero(episode == number)
            part = Stream(time[rows], {name: values[rows] for name, values in columns.items()})
            name = f"{path.name}/episode_{number:06.0f}"
            recordings.append(Recording([part], dict(about), meanings, name, doubts=doubts))
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


def _told(name: str) -> str:
    """The name with what is measured in it: a position where it says nothing, and no sensor of the trunk."""
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
        remedy = "record the dataset anew, or convert it to version 2.1 or 3"
        raise LogError("the column is missing in the parquet files", remedy, source=path / "data", column=missing)
    return table


def _units(columns: dict[str, np.ndarray], meanings: dict[str, Column], path: Path) -> list[Finding]:
    """Give positions and targets their unit: normalised where the calibration says so, else degrees or radians.

    Without a calibration, degrees and normalised numbers cannot be told apart, which is handed back.
    """
    file = next((f for f in (path / "calibration.json", path / "meta" / "calibration.json") if f.is_file()), None)
    calibration = read_json(file) if file else {}
    angles = {n: c for n, c in meanings.items() if str(c.name).rpartition(".")[2] in ("position", "target")}
    most = np.array([np.abs(columns[name]).max() for name in angles] or [0.0])
    unit, why = "deg", "degrees, as no calibration.json is there; numbers of -100 to 100 may be normalised to a range"
    if np.quantile(most, 0.75) < 2 * math.pi and most.max() < 8 * math.pi:
        unit, why = "rad", "hardly a number is as large as a turn in radians"
    for name, column in meanings.items():
        if unit == "deg" and column.unit is None and str(column.name).endswith(".velocity"):
            meanings[name] = Column(column.name, "deg/s", why=why)
    for name, column in angles.items():
        joint, words = str(column.name).rpartition(".")[0], set(re.split("[^a-z]+", name.lower()))
        named = next((unit for unit in map(canonical, words) if unit in ("deg", "rad")), None)
        meanings[name] = Column(column.name, named or unit, why=f"the name says {named}" if named else why)
        entry = calibration.get(joint)
        if calibration and entry is None and not named:
            problem, remedy = "the calibration lacks the joint", "copy the calibration file of this robot"
            raise LogError(problem, remedy, source=file, column=joint)
        if entry is not None:
            try:
                span = abs(float(entry["range_max"]) - float(entry["range_min"])) * _STEP
            except (KeyError, TypeError, ValueError):
                problem, remedy = "the calibration of the joint has no range", "copy LeRobot's calibration file"
                raise LogError(problem, remedy, source=file, column=joint) from None
            # a gripper runs from 0 to 100 over its range, every other joint from -100 to 100
            size = span / 100 if joint == "gripper" else span / 200
            if 0 < size < math.inf and float(np.abs(columns[name]).max()) <= _NORMAL:
                meanings[name] = Column(column.name, size, why="normalised to the calibrated range")
    guessed = [name for name in angles if meanings[name].why == why]
    if not guessed or unit == "rad" or calibration or most.max() > _NORMAL:
        return []
    if hands := [name for name in guessed if str(meanings[name].name).startswith("gripper.")]:
        low, high = min(columns[n].min() for n in hands), max(columns[n].max() for n in hands)
        if low >= 0 and high - low > 5:
            problem = f"a gripper's numbers of {low:.4g} to {high:.4g} are read as degrees; LeRobot's run from 0 to 100"
            remedy = "copy LeRobot's calibration file there as calibration.json, or give the unit under `columns:`"
            return [Finding(WARNING, problem, remedy, hands[0], check="unit of LeRobot")]
    grids = np.deg2rad(step(np.stack([columns[name] for name in guessed], axis=1)))
    if np.isclose(grids[grids > 0], _STEP, rtol=0.01).any():  # a range's hundredths have steps of their own
        return []
    problem = f"numbers of up to {most.max():.4g} have no unit and are read as degrees, but normalised ones look alike"
    remedy = "copy LeRobot's calibration file there as calibration.json, or say `unit: deg` under `columns:` in a YAML"
    return [Finding(WARNING, problem, remedy, guessed[0], check="unit of LeRobot")]
