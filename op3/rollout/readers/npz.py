"""Numpy archives: arrays by name, and the time series of `mujoco.sysid`."""

from __future__ import annotations

import json
import zipfile
import zlib
from pathlib import Path

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.guess import guess_all
from op3.rollout.readers.reader import Column, Recording, Stream

_TIMES, _JOINTS = ("time", "times", "t", "timestamp"), ("joints", "joint_names", "names")
_STEPS = ("dt", "timestep", "period")
_SIGNALS = {2: ("_qpos", "position"), 3: ("_qvel", "velocity"), 5: ("_ctrl", "target")}
"""Signal kinds of `mujoco.sysid` (`SignalType`): ending of their names, and op3's quantity."""

_DAMAGED = (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error, AttributeError, TypeError)
_DAMAGED += (NotImplementedError, MemoryError, SyntaxError, RuntimeError, OverflowError)

Content = dict[str, np.ndarray]


class Npz:
    """An archive with a time, arrays [time] or [time, joint], and joint names in `joints`."""

    title = "npz, also of mujoco.sysid"
    paths = "<name>.npz, or a folder of sysid's control and state files"

    def claims(self, path: Path) -> bool:
        """Recognised by the extension, or as a folder of time series that form one recording."""
        if not path.is_dir():
            return path.suffix == ".npz"
        files = sorted(path.glob("*.npz"))
        return 0 < len(files) < 6 and all(map(_partial, files))

    def read(self, path: Path) -> list[Recording]:
        """One recording."""
        meanings: dict[str, Column] = {}
        streams, metadata = [], {}
        for file in sorted(path.glob("*.npz")) if path.is_dir() else [path]:
            content = _load(file)
            time = next((content[name] for name in _TIMES if name in content), np.zeros(()))
            if time.dtype.kind == "M":  # dates
                time = time.astype("datetime64[ns]").astype(np.int64) * 1e-9
            steps = [float(content[n]) for n in _STEPS if n in content and content[n].size == 1]
            if not time.ndim and steps and steps[0] > 0:
                time = steps[0] * np.arange(max(map(len, (a for a in content.values() if a.ndim)), default=0))
            if time.ndim not in (1, 2) or time.dtype.kind not in "fiu" or time.size != len(time):
                raise LogError("there is no array of times", "save `time` [s], one per row", source=file, column="time")
            listed = next((content[n] for n in _JOINTS if n in content and content[n].dtype.kind in "US"), np.array([]))
            joints = [str(name) for name in listed.astype(str).reshape(-1)]
            if "signal_mapping" in content:
                columns, known = _signals(content, file)
            else:
                columns = columns_of(content, len(time), joints, file)
                known = guess_all(columns, joints)
            streams.append(Stream(time.reshape(-1).astype(float), columns))
            meanings |= known
            metadata |= {"joints": joints} if joints else {}
        streams.sort(key=lambda s: not any(str(meanings[n].name).endswith(".position") for n in s.columns))
        return [Recording(streams, {"robot": "real", "mount": "stand", **metadata}, meanings)]


def _load(path: Path) -> Content:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except _DAMAGED:
        remedy = "copy the file again, or save it with numpy.savez without Python objects"
        raise LogError("the file is not a readable npz archive", remedy, source=path) from None


def _partial(path: Path) -> bool:
    """Whether a file is a time series with only states, or only controls."""
    try:
        content = _load(path)
        names = {str(column.name).rpartition(".")[2] for column in _signals(content, path)[1].values()}
    except LogError:
        return False
    return "times" in content and not {"target", "position"} <= names


def _signals(content: Content, path: Path) -> tuple[Content, dict[str, Column]]:
    """Signals of `mujoco.sysid`: positions, velocities and controls by kind, sensors by name."""
    try:
        if (data := content["data"]).dtype.kind not in "fiub":
            raise ValueError(data.dtype)
        mapping = json.loads(str(content["signal_mapping"])).items()
        kinds = {name: int(kind) for name, (kind, index) in mapping if len(index) == 1}
        columns = {name: data[:, int(index[0])].astype(float) for name, (_, index) in mapping if name in kinds}
    except (KeyError, ValueError, TypeError, IndexError, AttributeError, RecursionError, OverflowError):
        remedy = "save it again with TimeSeries.save_to_disk"
        raise LogError("the signal mapping does not fit the data", remedy, source=path) from None
    meanings = guess_all(columns)
    for name in columns:
        if kinds[name] in _SIGNALS:
            ending, ours = _SIGNALS[kinds[name]]
            meanings[name] = Column(f"{name.removesuffix(ending)}.{ours}")
    return columns, meanings


def columns_of(content: Content, rows: int, joints: list[str], path: Path) -> Content:
    """Arrays by name; the last axis of two-dimensional arrays is the joint."""
    columns: Content = {}
    for name, array in content.items():
        late = array.ndim > 1 and rows in array.shape[1:] and len(array) != rows
        wide = array.ndim == 2 and len(array) == rows and array.shape[1] not in (1, 3, 4, len(joints) or array.shape[1])
        if array.dtype.kind in "fiub" and (late or wide):
            problem = f"the array has shape {array.shape} for {rows} times and {len(joints) or 'unnamed'} joints"
            raise LogError(problem, "save arrays [time, joint], one archive per episode", source=path, column=name)
        if array.dtype.kind not in "fiub" or name in _TIMES or array.ndim not in (1, 2) or 2 * len(array) < rows:
            continue  # one number per joint or per recording
        table = array.reshape(len(array), -1).astype(float)
        axes = joints if len(joints) == table.shape[1] else [f"joint_{i}" for i in range(table.shape[1])]
        kind = name.replace("command/position", "target").replace("/", "_")
        if table.shape[1] == 3 and any(word in name for word in ("imu", "gyro", "acc")):
            axes = ["roll", "pitch", "yaw"] if "orient" in name or "rpy" in name else ["x", "y", "z"]
            columns |= {f"{kind}_{axis}": table[:, i] for i, axis in enumerate(axes)}
        else:
            columns |= {f"{axis}.{kind}" if array.ndim == 2 else name: table[:, i] for i, axis in enumerate(axes)}
    return columns
