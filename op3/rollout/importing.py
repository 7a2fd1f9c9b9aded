"""From what a reader found to rollouts: names, units, one clock, the options of the import, and the checks.

Beside a log may lie a YAML file of its name (`run.yaml` for `run.csv`, `chirp.yaml` for the folder `chirp`), or
one `columns.yaml` for all logs of a folder. It holds metadata and, where the file cannot say it,

    columns: {elbow_deg: {name: elbow.position, unit: deg, sign: -1, offset: 0.1}}
    scale: {elbow.velocity: 0.0175}   # multiplies, after everything above
    unwrap: true                       # or joints: takes out jumps by a turn and a turn against the command
    shift: {elbow: -3.14159}          # added to positions and targets [rad], after unwrapping
    split: true                        # cuts where the clock jumps or rows are missing
"""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.metadata import Metadata
from op3.rollout.readers.reader import Column, Recording, Stream
from op3.rollout.readers.text import stem
from op3.rollout.rollout import Rollout
from op3.rollout.schema import CHANNELS, Channel, Key, column_names, joint_suffixes, key_name, vector_column
from op3.rollout.units import factor
from op3.settings import read_yaml

OPTIONS = ("columns", "scale", "unwrap", "shift", "split")
SHARED = "columns.yaml"
GAP_INTERVALS, GAP = 10.0, 0.15
"""A hole is an interval of so many usual ones that is at least so long [s]."""


@dataclass(frozen=True)
class Side:
    """What the YAML beside a log says.

    Attributes:
        metadata: Fields of `Metadata`.
        options: Those of `OPTIONS` that are given.
        source: The file, named in errors.
        found: Whether there is one.
    """

    metadata: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    source: Path = Path("metadata")
    found: bool = False


def side_path(path: Path) -> Path:
    """Where the YAML of a log lies."""
    return path.parent / f"{stem(path)}.yaml"


def read_side(path: Path) -> Side:
    """What lies beside a log: its own file over the folder's."""
    own, values, found = side_path(path), {}, False
    for file in (path.parent / SHARED, own):
        if file.is_file() and file != path:
            values, found, own = {**values, **read_yaml(file, LogError)}, True, file
    options = {name: values.pop(name) for name in OPTIONS if values.get(name) is not None}
    return Side(values, options, own, found)


def roll_out(recording: Recording, side: Side, path: Path) -> list[Rollout]:
    """One rollout, or one per part where the import splits; raises `LogError` where it cannot be right."""
    meanings = _meanings(recording, side)
    streams = [_named(stream, meanings, recording, side, path) for stream in recording.streams]
    time, columns = _one_clock(streams, path)
    about = {**recording.metadata, **side.metadata}
    if "joints" not in about:
        about["joints"] = _joints(columns)
    if not recording.strict:
        columns = _whole(columns, about["joints"])
    if not recording.strict:
        about.setdefault("recording", recording.name or stem(path))
    parts = _split(time, columns) if side.options.get("split") else [(time, columns)]
    return [_build(t, c, dict(about), side, path, n if len(parts) > 1 else None) for n, (t, c) in enumerate(parts)]


def _meanings(recording: Recording, side: Side) -> dict[str, Column]:
    """What the format says, with the user's word over it."""
    meanings, given = dict(recording.columns), side.options.get("columns", {})
    there = {name for stream in recording.streams for name in stream.columns}
    if not isinstance(given, Mapping):
        raise LogError("columns is no mapping", "write `<column of the file>: {name: ...}`", source=side.source)
    for name, entry in given.items():
        where: dict[str, Any] = dict(source=side.source, column=f"field columns.{name}")
        entry = {"name": entry} if entry is None or isinstance(entry, str) else entry
        if not isinstance(entry, Mapping) or set(entry) - {"name", "unit", "sign", "offset", "why"}:
            raise LogError("the entry has other fields", "write name, unit, sign and offset", **where)
        if name not in there and side.source.name != SHARED:
            close = difflib.get_close_matches(str(name), sorted(there), n=1)
            remedy = f"write {close[0]} if that is meant" if close else "remove the entry"
            raise LogError("the file has no such column", remedy, **where)
        sign, offset = entry.get("sign", 1), entry.get("offset", 0.0)
        if sign not in (1, -1) or isinstance(offset, bool) or not isinstance(offset, int | float):
            raise LogError("sign or offset is wrong", "write sign: 1 or -1, and offset as a number in SI", **where)
        meanings[str(name)] = Column(entry.get("name"), entry.get("unit"), int(sign), float(offset))
    return meanings


def place(name: str) -> tuple[Channel, str] | None:
    """The channel that a column of the wide CSV belongs to, and its joint or axis."""
    joint, _, suffix = name.rpartition(".")
    if suffix in joint_suffixes() and joint and joint not in ("imu", "policy", "raw"):
        return joint_suffixes()[suffix], joint
    for channel in CHANNELS.values():
        if channel.axes in ("scalar", "imu3") and name in column_names(channel, ()):
            return channel, name
    vector = vector_column(name)
    return (vector[0], str(vector[1])) if vector else None


def _named(stream: Stream, meanings: dict[str, Column], recording: Recording, side: Side, path: Path) -> Stream:
    """The stream with our names and units; columns without a meaning are refused or left out."""
    columns: dict[str, np.ndarray] = {}
    time = stream.time
    for name, values in stream.columns.items():
        column = meanings.get(name, Column(name))
        if column.name is None:
            continue
        known = place(column.name)
        if known is None:
            if recording.strict or name in side.options.get("columns", {}):
                raise _unknown(column.name, list(stream.columns).index(name), side, path)
            continue
        if column.name in columns:
            remedy = "keep one of the two"
            raise LogError("the column is there twice", remedy, source=path, column=column.name, row="header")
        try:
            size, shift = factor(column.unit, known[0].quantity, name) if column.unit is not None else (1.0, 0.0)
        except LogError as error:
            raise error.at(side.source) from None
        scale = column.sign * size
        values = values if scale == 1 and not shift and not column.offset else scale * values + shift + column.offset
        if column.name == "time":
            time = values
        else:
            columns[column.name] = values
    return Stream(time, columns)


def _unknown(name: str, position: int, side: Side, path: Path) -> LogError:
    _joint, _, _suffix = name.rpartition(".")
    shown = name if name.isprintable() and 0 < len(name) <= 60 else f"{position + 1} ({name[:40]!r})"
    joints = side.metadata.get("joints") or ["<joint>"]
    known = [column for c in CHANNELS.values() for column in column_names(c, joints, 1)]
    close = difflib.get_close_matches(name, known, n=1)
    rename = f"rename it {close[0]} if that is meant" if close else "say what it is under `columns:` in the YAML"
    remedy = f"{rename}, or remove the column"
    return LogError("unknown column", remedy, source=path, column=shown, row="header")


def _one_clock(streams: Sequence[Stream], path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """All columns at the times of the first stream, where every stream has begun and none has ended.

    Signals are interpolated. A command counts from the row nearest to when it was issued, so that what is lost is
    at most half a row and nothing on average.
    """
    first, *others = streams
    for stream in streams:
        for name, values in stream.columns.items():
            if values.shape != stream.time.shape:
                problem = f"the column has {len(values)} rows and its clock {len(stream.time)}"
                raise LogError(problem, "record the file again, or export it whole", source=path, column=name)
    for stream in others:
        check_clock(stream.time, path)
    if not others:
        return first.time, first.columns
    check_clock(first.time, path)
    start, end = max(s.time[0] for s in streams), min(s.time[-1] for s in streams)
    half = float(np.median(np.diff(first.time))) / 2 if len(first.time) > 1 else 0.0
    inside = (first.time >= start - half) & (first.time <= end + max(half, 0.25))
    if not inside.any():
        spans = " and ".join(f"{s.time[0]:.6g} to {s.time[-1]:.6g} s" for s in streams)
        remedy = "shift one of the clocks, by `offset:` of its time column, to a common start"
        raise LogError(f"the clocks share no time: {spans}", remedy, source=path, column="time")
    time = first.time[inside]
    columns = {name: values[inside] for name, values in first.columns.items()}
    for stream in others:
        for name, values in stream.columns.items():
            known = place(name)
            if known is None or name in columns:
                continue
            if known[0].hold:
                row = np.searchsorted(stream.time, time + half, side="right") - 1
                columns[name] = values[np.clip(row, 0, None)]
            else:
                columns[name] = np.interp(time, stream.time, values)
    return time, columns


def check_clock(time: np.ndarray, path: Path, column: str = "time") -> None:
    """Refuse a clock with no or unordered readings."""
    if not len(time):
        raise LogError("there is no row", "record at least one", source=path, row="row 1")
    if not np.isfinite(time).all():
        row = int(np.isfinite(time).argmin()) + 1
        raise LogError("the time is not a finite number", "leave out the row", source=path, column=column, row=row)
    steps = np.diff(time)
    if not (steps > 0).all():
        row = int(np.argmax(~(steps > 0)))
        before, now = time[row], time[row + 1]
        if now == before:
            problem, remedy = f"{now:.10g} s repeats the time of row {row + 1}", "remove the duplicated row"
        else:
            problem = f"time goes back from {before:.10g} s to {now:.10g} s"
            remedy = "sort the rows, or split the file where a new recording starts"
        raise LogError(problem, remedy, source=path, column=column, row=row + 2)


def holes(time: np.ndarray) -> np.ndarray:
    """Rows before which time jumps, counted from 0."""
    steps = np.diff(time)
    usual = float(np.median(steps)) if len(steps) else 0.0
    return np.flatnonzero(steps > max(GAP_INTERVALS * usual, GAP)) + 1


def _split(time: np.ndarray, columns: dict[str, np.ndarray]) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """The parts between holes; single rows are no part."""
    cuts = [0, *holes(time).tolist(), len(time)]
    pieces = [slice(a, b) for a, b in itertools.pairwise(cuts) if b - a > 1] or [slice(None)]
    return [(time[piece], {name: values[piece] for name, values in columns.items()}) for piece in pieces]


def _joints(columns: Mapping[str, Any]) -> list[str]:
    """Joints in the order in which columns name them; those with a position, where any has one."""
    found = {name: place(name) for name in columns}
    joints = dict.fromkeys(p[1] for p in found.values() if p and p[0].axes == "joint")
    measured = [joint for joint in joints if f"{joint}.position" in columns]
    driven = [joint for joint in measured if f"{joint}.target" in columns]
    return driven or measured or list(joints)


def _whole(columns: dict[str, np.ndarray], joints: Any) -> dict[str, np.ndarray]:
    """Columns of the log's joints only, without channels that some of these lack."""
    found = {name: place(name) for name in columns}
    kept = {n: p for n, p in found.items() if p and (p[0].axes != "joint" or p[1] in joints)}
    count = {c.key: sum(p[0] is c for p in kept.values()) for c in CHANNELS.values()}
    full = {"joint": len(joints), "imu3": 3}
    return {n: columns[n] for n, p in kept.items() if p[0].required or count[p[0].key] >= full.get(p[0].axes, 1)}


def _build(
    time: np.ndarray, columns: dict[str, np.ndarray], about: dict[str, Any], side: Side, path: Path, part: int | None
) -> Rollout:
    if "rate" not in about:
        span = float(time[-1] - time[0])
        about["rate"] = (len(time) - 1) / span if span > 0 else 1.0
    if part is not None:
        about["recording"] = f"{about.get('recording') or stem(path)}/part-{part}"
    metadata = Metadata.from_dict(about, side.source if side.found else path)
    named = {**columns}
    _unwrap(named, side)
    for column, scale in _by_name(side, "scale", named).items():
        named[column] = named[column] * scale
    arrays = _arrays(time, named, metadata, side, path)
    gain = metadata.firmware_gain
    if gain is not None and ("command", "firmware_gain") not in arrays:
        arrays["command", "firmware_gain"] = np.full((len(time), len(metadata.joints)), gain)
    return Rollout.from_arrays(arrays, metadata, path)


def _by_name(side: Side, option: str, known: Any) -> dict[str, float]:
    """A mapping of names to numbers among the options."""
    values = side.options.get(option, {})
    if not isinstance(values, Mapping):
        raise LogError(f"{option} is no mapping", "write `name: number`", source=side.source, column=f"field {option}")
    for name, value in values.items():
        if name not in known or isinstance(value, bool) or not isinstance(value, int | float):
            remedy = f"write numbers for some of {', '.join(list(known)[:20])}"
            raise LogError(f"{name}: {value!r}", remedy, source=side.source, column=f"field {option}")
    return {str(name): float(value) for name, value in values.items()}


def _unwrap(columns: dict[str, np.ndarray], side: Side) -> None:
    """Take out turns of positions and targets, and shift both, as the options ask; changes `columns`."""
    joints = _joints(columns)
    shift = _by_name(side, "shift", joints)
    asked = side.options.get("unwrap", False)
    listed = asked if isinstance(asked, list | tuple) else joints if asked else []
    unknown = [name for name in listed if name not in joints]
    if unknown or not isinstance(asked, list | tuple | bool):
        remedy = f"write true or some of {', '.join(joints)}"
        raise LogError(f"unwrap: {unknown or asked}", remedy, source=side.source, column="field unwrap")
    for joint in dict.fromkeys([*listed, *shift]):
        position, target = (columns.get(f"{joint}.{name}") for name in ("position", "target"))
        if position is not None:
            position = np.unwrap(position)
        if target is not None:
            target = np.unwrap(target)
        if position is not None and target is not None:
            turns = np.round(np.median(position - target) / (2 * np.pi))
            position = position - 2 * np.pi * turns
        for name, values in (("position", position), ("target", target)):
            if values is not None:
                columns[f"{joint}.{name}"] = values + shift.get(joint, 0.0)


def _arrays(
    time: np.ndarray, columns: dict[str, np.ndarray], metadata: Metadata, side: Side, path: Path
) -> dict[Any, np.ndarray]:
    """Channels [time, last axis]; refuses joints that are not the log's and channels that lack a column."""
    found: dict[Key, dict[str, str]] = {}
    for name in columns:
        known = place(name)
        assert known is not None
        channel, where = known
        if channel.axes == "joint" and where not in metadata.joints:
            close = difflib.get_close_matches(where, metadata.joints, n=1)
            rename = f"rename it {close[0]} if that is meant" if close else "correct it"
            remedy = f"{rename}, or add it to the joints in {side_path(path).name}"
            raise LogError("unknown joint", remedy, source=path, column=name, row="header")
        found.setdefault(channel.key, {})[name] = where
    arrays: dict[Any, np.ndarray] = {"time": time}
    for key, channel in CHANNELS.items():
        names = found.get(key, {})
        if key == "time" or not (names or channel.required):
            continue
        width = max((int(where) + 1 for where in names.values()), default=1) if channel.axes == "vector" else None
        if width is not None and width > len(names) + 1000:
            width = len(names) + 1000  # enough to name what is missing
        wanted = column_names(channel, metadata.joints, width)
        missing = [name for name in wanted if name not in names]
        if missing:
            there = next((name for name in wanted if name in names), None)
            problem = f"the column is missing while {there} is there" if there else "the required column is missing"
            remedy = f"give {key_name(key)} for all or for none" if there else f"add {key_name(key)} [{channel.unit}]"
            raise LogError(problem, remedy, source=path, column=missing[0], row="header")
        arrays[key] = np.stack([columns[name] for name in wanted], axis=-1)
    return arrays


def with_options(side: Side, options: Mapping[str, Any]) -> Side:
    """The same with options of a command over it."""
    return replace(side, options={**side.options, **{k: v for k, v in options.items() if v is not None}})
