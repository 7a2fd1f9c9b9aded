"""Numpy archives: arrays by name, and the time series of `mujoco.sysid`."""

from __future__ import annotations

import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.guess import guess_all
from op3.rollout.readers.reader import Column, Recording, Stream

_TIMES, _JOINTS = ("time", "times", "t", "timestamp"), ("joints", "joint_names", "names")
_STATE_POSITION, _STATE_VELOCITY, _CONTROL = 2, 3, 5
"""Kinds of signal in `mujoco.sysid`, its `SignalType`."""


class Npz:
    """An archive of numbers [time] or [time, joint] and a time; joint names in `joints`."""

    title = "npz, also of mujoco.sysid"
    paths = "<name>.npz, or a folder of sysid's control and state files"

    def claims(self, path: Path) -> bool:
        """By the ending, or a folder of time series that make one recording."""
        if path.is_dir():
            files = sorted(path.glob("*.npz"))
            return 1 < len(files) < 6 and all(_series(file) for file in files) and not any(map(_complete, files))
        return path.suffix == ".npz"

    def read(self, path: Path) -> list[Recording]:
        """One recording."""
        files = sorted(path.glob("*.npz")) if path.is_dir() else [path]
        meanings: dict[str, Column] = {}
        streams, metadata = [], {}
        for file in files:
            content = _load(file)
            time = _time(content, file)
            named = _signals(content, file) if "signal_mapping" in content else _arrays(content, len(time), file)
            columns, known, joints = named
            streams.append(Stream(time, columns))
            meanings |= known
            metadata |= {"joints": joints} if joints else {}
        streams.sort(key=lambda s: not any(str(meanings[n].name).endswith(".position") for n in s.columns))
        return [Recording(streams, {"robot": "real", "mount": "stand", **metadata}, meanings)]


def _load(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error, AttributeError, TypeError):
        remedy = "copy the file again, or save it with numpy.savez and without objects"
        raise LogError("the file is no readable npz archive", remedy, source=path) from None
    except (NotImplementedError, MemoryError, SyntaxError, RuntimeError, OverflowError):
        raise LogError("the npz archive is damaged", "copy the file again", source=path) from None


def _series(path: Path) -> bool:
    try:
        return {"times", "data"} <= set(_load(path))
    except LogError:
        return False


def _complete(path: Path) -> bool:
    try:
        names = {str(column.name).rpartition(".")[2] for column in _signals(_load(path), path)[1].values()}
    except LogError:
        return False
    return {"target", "position"} <= names


def _time(content: dict[str, np.ndarray], path: Path) -> np.ndarray:
    time = next((content[name] for name in _TIMES if name in content), np.zeros(()))
    if time.ndim not in (1, 2) or time.dtype.kind not in "fiu" or time.size != len(time):
        raise LogError("there is no array of times", "save `time` [s], one per row", source=path, column="time")
    return time.reshape(-1).astype(float)


def _signals(content: dict[str, np.ndarray], path: Path) -> tuple[dict[str, np.ndarray], dict[str, Column], list[str]]:
    """Signals of `mujoco.sysid`: positions, velocities and controls by their kind, sensors by their name."""
    data = content.get("data", np.zeros(0))
    try:
        mapping = {
            n: (int(kind), [int(i) for i in index])
            for n, (kind, index) in json.loads(str(content["signal_mapping"])).items()
        }
        columns = {n: data[:, index[0]].astype(float) for n, (_, index) in mapping.items() if len(index) == 1}
    except (KeyError, ValueError, TypeError, IndexError, AttributeError, RecursionError):
        remedy = "save it again with TimeSeries.save_to_disk"
        raise LogError("the signal mapping does not fit the data", remedy, source=path) from None
    endings: dict[int, Any] = {_STATE_POSITION: ("_qpos", "position"), _STATE_VELOCITY: ("_qvel", "velocity")}
    endings[_CONTROL] = ("_ctrl", "target")
    meanings = guess_all(columns)
    for name, (kind, _) in mapping.items():
        if kind in endings and name in columns:
            ending, ours = endings[kind]
            meanings[name] = Column(f"{name.removesuffix(ending)}.{ours}")
    return columns, meanings, []


def _arrays(
    content: dict[str, np.ndarray], rows: int, path: Path
) -> tuple[dict[str, np.ndarray], dict[str, Column], list[str]]:
    """Arrays by name; the last axis of two-dimensional ones is the joints."""
    listed = next((content[name] for name in _JOINTS if name in content and content[name].dtype.kind == "U"), None)
    joints = [] if listed is None else [str(name) for name in listed.reshape(-1)]
    columns: dict[str, np.ndarray] = {}
    for name, array in content.items():
        if array.dtype.kind not in "fiub" or name in _TIMES or array.ndim not in (1, 2) or len(array) != rows:
            continue
        table = array.reshape(rows, -1).astype(float)
        axes = joints if len(joints) == table.shape[1] else [f"joint_{i}" for i in range(table.shape[1])]
        if table.shape[1] == 3 and any(word in name for word in ("imu", "gyro", "acc")):
            axes = ["roll", "pitch", "yaw"] if "orient" in name or "rpy" in name else ["x", "y", "z"]
            columns |= {f"{name.replace('/', '_')}_{axis}": table[:, i] for i, axis in enumerate(axes)}
        elif array.ndim == 1:
            columns[name] = table[:, 0]
        else:
            kind = name.replace("command/position", "target").replace("/", "_")
            columns |= {f"{axis}.{kind}": table[:, i] for i, axis in enumerate(axes)}
    return columns, guess_all(columns, joints), joints
