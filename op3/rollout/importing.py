"""Converts the content of a file to rollouts: names, units, a common clock and import options.

A log may have a YAML file of the same name beside it (`run.yaml` for `run.csv`, `chirp.yaml` for the folder `chirp`),
or a folder may have one `columns.yaml` for all its logs. The YAML contains metadata, and `Options` for everything that
the log does not state.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from op3.common.settings import Listed, Named, Number, read_yaml, settings, shown
from op3.rollout.errors import LogError, located, rename
from op3.rollout.finding import WARNING, LogFinding
from op3.rollout.guess import guess, guess_all
from op3.rollout.metadata import Metadata
from op3.rollout.readers.reader import Column, Recording, Stream
from op3.rollout.readers.text import unpacked
from op3.rollout.rollout import Rollout
from op3.rollout.schema import CHANNELS, column_names, key_name, place
from op3.rollout.units import factor, likely_unit
from op3.rollout.validate import check_time, holes

SHARED = "columns.yaml"

HELD = 0.25
"""Time for which the last command is held after its time stamp [s], while the robot comes to rest."""

_BLANK = 0.05
"""Largest share of blank cells in an incomplete measured column; with more, the column has its own times."""

Columns = dict[str, np.ndarray]
"""Values by column of the wide CSV, [time]."""


def _wrong(name: str, wanted: str, given: Any) -> LogError:
    option = name.partition(".")[0]
    wanted = {"unwrap": "true, or a list of joints", "split": "true or false"}.get(option, "a mapping of names")
    wanted = "names with numbers" if option in ("scale", "shift") else wanted
    return LogError(f"{shown(given)} is not allowed here", f"write {wanted}", column=f"field {option}")


@settings(raises=_wrong)
class Options:
    """Options for reading a log, from the YAML beside it or from a command.

    Attributes:
        columns: Name in the wide CSV, or fields of `Column`, by column of the file, such as ``{name: elbow.position,
            unit: deg, sign: -1}``.
        scale: Factors on columns, applied after `columns`.
        unwrap: Whether, or in which joints, to remove jumps by a turn and offsets of whole turns from the command.
        shift: Angles added to positions and targets of joints [rad], after unwrapping.
        split: Whether to cut the log where the clock jumps or rows are missing.
    """

    columns: Named[Any] = field(default_factory=dict)
    scale: Named[Number] = field(default_factory=dict)
    unwrap: bool | Listed[str] = False
    shift: Named[Number] = field(default_factory=dict)
    split: bool = False


OPTIONS = tuple(entry.name for entry in dataclasses.fields(Options))


@dataclass(frozen=True)
class Side:
    """Content of the YAML beside a log.

    Attributes:
        metadata: Fields of `Metadata`.
        options: Options of the import.
        source: The file that errors name.
        found: Whether the file exists.
    """

    metadata: dict[str, Any]
    options: Options
    source: Path
    found: bool


def side_path(path: Path) -> Path:
    """Path of a log's YAML, such as `run.yaml` for `run.csv.xz`; dots in folder names are kept."""
    name = path.name if path.is_dir() else unpacked(path).stem
    short = path.parent / f"{name}.yml"
    return short if short.is_file() else short.with_suffix(".yaml")


def read_side(path: Path, options: Mapping[str, Any] | None = None, proposed: Mapping[str, Any] | None = None) -> Side:
    """Content of the YAML beside a log. The log's file overrides the folder's file, and options of a command override
    both; without a file, the proposed content is used."""
    values = dict(proposed or {})
    files = [file for file in (path.parent / SHARED, side_path(path)) if file.is_file() and file != path]
    for file in files:
        values |= read_yaml(file, LogError)
    source = files[-1] if files else side_path(path)
    given = {name: values.pop(name) for name in OPTIONS if name in values}
    given |= {name: value for name, value in (options or {}).items() if value is not None}
    with located(source=source):
        if (odd := next((name for name in options or {} if name not in OPTIONS), None)) is not None:
            problem, remedy = f"{odd!r} is not an import option", f"the options are {', '.join(OPTIONS)}"
            raise LogError(problem, rename(odd, OPTIONS, remedy))
        chosen = Options(**{name: value for name, value in given.items() if value is not None})
    return Side(values, chosen, source, bool(files or proposed))


def roll_out(recording: Recording, side: Side, path: Path) -> list[Rollout]:
    """One rollout, or one per part if the import splits the log; raises `LogError` if the data are invalid."""
    if recording.strict and not side.found:
        remedy = f"write the metadata (joints, robot, mount, rate) to {side.source.name} beside it"
        remedy += f", or let `op3 import {path}` propose it"
        raise LogError("the sidecar is missing", remedy, source=side.source)
    guessed = _guessed(recording, side)
    meanings = guessed | _meanings(recording, side)
    with located(source=path):
        streams = [one for s in recording.streams for one in _stamped_apart(_named(s, meanings, recording, side))]
        time, columns = _one_clock(streams, side.options.split)
    name = recording.name or side_path(path).stem
    about = {"recording": name, "joints": _joints(columns), **recording.metadata, **side.metadata}
    parts = _split(time) if side.options.split else [slice(None)]
    logs = []
    for number, part in enumerate(parts):
        said = {"rate": _rate(time[part]), **about}
        if len(parts) > 1:
            said["recording"] = f"{about.get('recording') or side_path(path).stem}/part-{number}"
        metadata = Metadata.from_dict(said, side.source if side.found else path, OPTIONS)
        chosen = {name: values[part] for name, values in columns.items()}
        _mend(chosen, side)
        with located(source=path):
            arrays = _arrays(chosen, metadata, recording.strict, side)
            known = {*side.options.columns, *(f"field {name}" for name in side.metadata)}
            unread = [one for one in recording.doubts if one.column not in known]
            unread += _unread(arrays, metadata.joints) + _unshared(time, streams) + _guess_warning(guessed)
            log = Rollout.from_arrays({"time": time[part], **arrays}, metadata, path)
            logs.append(log.with_findings(unread))
    return logs


def _guessed(recording: Recording, side: Side) -> dict[str, Column]:
    """Guessed meanings of columns, for logs without names of the wide CSV and without columns in the YAML."""
    names = [name for stream in recording.streams for name in stream.columns]
    ours = any(known[0].axes == "joint" for known in map(place, names) if known)
    joints = side.metadata.get("joints")
    if not recording.strict or side.options.columns or ours or not isinstance(joints, list | tuple):
        return {}
    return guess_all(names, list(map(str, joints)))


def _guess_warning(guessed: Mapping[str, Column]) -> list[LogFinding]:
    """A warning that the meanings of columns were guessed only from their names."""
    read = [f"{name} as {column.name}" for name, column in guessed.items() if column.name]
    problem = f"{', '.join(read[:4])}{' and so on' * (len(read) > 4)}: the meanings of these columns were guessed"
    remedy = "write them under `columns:` in the YAML"
    return [LogFinding(WARNING, problem, remedy, "columns", check="names")] if read else []


def _meanings(recording: Recording, side: Side) -> dict[str, Column]:
    """The meaning of a column: the user's, otherwise that of the format."""
    meanings = dict(recording.columns)
    there = {name for stream in recording.streams for name in stream.columns}
    for name, entry in side.options.columns.items():
        with located(source=side.source, column=f"field columns.{name}"):
            if name not in there and side.source.name != SHARED:
                raise LogError("the file has no such column", rename(name, there, "remove the entry"))
            try:
                given = entry if isinstance(entry, Mapping) else {"name": entry}
                meanings[str(name)] = Column(**given)
            except (ValueError, TypeError) as error:
                raise LogError(str(error), "write name, unit, sign (1 or -1) and offset in SI") from None
    return meanings


def _named(stream: Stream, meanings: dict[str, Column], recording: Recording, side: Side) -> Stream:
    """The stream with names of the wide CSV and SI units; columns without a meaning are rejected or omitted."""
    columns: Columns = {}
    for name, values in stream.columns.items():
        column = meanings.get(name, Column(name))
        known = place(column.name) if column.name is not None else None
        if known is None:
            if column.name is not None and (recording.strict or name in side.options.columns):
                raise _unknown(column.name, list(stream.columns).index(name), side)
            continue
        assert column.name is not None
        if column.name in columns:
            raise LogError("the column appears twice", "keep one of the two", column=column.name, row="header")
        if values.shape != stream.time.shape:
            problem = f"the column has {len(values)} rows but its clock has {len(stream.time)}"
            raise LogError(problem, "record the file again, or export it completely", column=name)
        size, shift = factor(column.unit, known[0].quantity, name) if column.unit is not None else (1.0, 0.0)
        scale, shift = column.sign * size, shift + column.offset
        columns[column.name] = values if scale == 1 and not shift else scale * values + shift
    if recording.strict and "time" not in columns:
        remedy = "add time [s], or name the time column under `columns:`"
        raise LogError("the required column is missing", remedy, column="time", row="header")
    return Stream(columns.pop("time", stream.time), columns)


def _stamped_apart(stream: Stream) -> list[Stream]:
    """A stream for each set of rows with numbers in the same columns, because a blank cell means that the row is a time
    stamp of other columns. A command holds until the next one, and the last one stays. If every row has positions,
    other blank cells are missing values.
    """
    there = {name: np.isfinite(values) for name, values in stream.columns.items()}
    apart = any(name.endswith(".position") and rows.mean() < 1 - _BLANK for name, rows in there.items())
    groups: dict[bytes, list[str]] = {}
    for name, rows in there.items():
        often = rows.all() or not rows.any() or not (_is_held(name) or (apart and rows.mean() < 1 - _BLANK))
        groups.setdefault(b"" if often else rows.tobytes(), []).append(name)
    if len(groups) < 2 and not any(groups):
        return [stream]
    streams = []
    for rows, names in sorted(groups.items(), key=lambda item: not any(n.endswith(".position") for n in item[1])):
        kept = np.frombuffer(rows, bool) if rows else np.ones(len(stream.time), bool)
        time, columns = stream.time[kept], {name: stream.columns[name][kept] for name in names}
        if not kept[-1] and all(map(_is_held, names)):
            time = np.append(time, stream.time[-1])
            columns = {name: np.append(values, values[-1]) for name, values in columns.items()}
        streams.append(Stream(time, columns))
    return streams


def _unknown(name: str, position: int, side: Side) -> LogError:
    shown_name = name if name.isprintable() and 0 < len(name) <= 60 else f"{position + 1} ({name[:40]!r})"
    joints = side.metadata.get("joints") or ["<joint>"]
    known = [column for c in CHANNELS.values() for column in column_names(c, joints, 1)]
    meant = guess(name, joints) if isinstance(joints, list) else None
    entry = f"{{name: {meant.name}, unit: {meant.unit}}}" if meant and meant.unit else str(meant and meant.name)
    remedy = rename(name, known, "define it under `columns:` in the YAML")
    if meant and meant.name in known:
        remedy = f"if it is {meant.name}, write `{name}: {entry}` under `columns:` in the YAML"
    return LogError("unknown column", remedy + ", or remove the column", column=shown_name, row="header")


def _one_clock(streams: Sequence[Stream], split: bool) -> tuple[np.ndarray, Columns]:
    """All columns at the times of the first stream that all streams cover.

    Signals are interpolated, but have no value within a gap. A command applies from the row nearest to its time stamp,
    so that the timing error is at most half a row and zero on average.
    """
    first, *others = streams
    if split and not others:  # the parts are checked instead
        return first.time, first.columns
    for stream in streams:
        check_time(stream.time)
    if not others:
        return first.time, first.columns
    spans = sorted(float(np.ptp(s.time)) for s in streams)
    if spans[0] > 0 and (unit := likely_unit(spans[-1] / spans[0], "s", 0.5)):
        problem = f"one clock runs over {spans[-1]:.4g} s and another over {spans[0]:.4g} s, as if one were in {unit}"
        raise LogError(problem, "convert both to seconds", column="time")
    half = float(np.median(np.diff(first.time))) / 2 if len(first.time) > 1 else 0.0
    start = max(s.time[0] for s in streams)
    end = min(s.time[-1] + (max(half, HELD) if all(map(_is_held, s.columns)) else half) for s in streams)
    inside = (first.time >= start - half) & (first.time <= end)
    if not inside.any():
        each = " and ".join(f"{s.time[0]:.6g} to {s.time[-1]:.6g} s" for s in streams)
        remedy = "shift one of the clocks with `offset:` of its time column to a common start"
        raise LogError(f"the time ranges of the clocks do not overlap: {each}", remedy, column="time")
    time = first.time[inside]
    columns = {name: values[inside] for name, values in first.columns.items()}
    for stream in others:
        row = np.clip(np.searchsorted(stream.time, time + half, side="right") - 1, 0, None)
        after = np.searchsorted(stream.time, time)
        lost = np.isin(after, holes(stream.time)) & ~np.isin(time, stream.time)
        measured = next((name for name in stream.columns if name.endswith(".position")), None)
        if measured and lost.any():
            gap = holes(stream.time)[0]
            problem = f"the column has no value from {stream.time[gap - 1]:.6g} to {stream.time[gap]:.6g} s"
            raise LogError(problem, "remove this time span from all columns, or cut the log there", column=measured)
        for name, values in stream.columns.items():
            signal = np.where(lost, np.nan, np.interp(time, stream.time, values))
            columns.setdefault(name, values[row] if _is_held(name) else signal)
    return time, columns


def _is_held(name: str) -> bool:
    """Whether a column holds its value until the next one."""
    return bool((known := place(name)) and known[0].hold)


def _split(time: np.ndarray) -> list[slice]:
    """The parts between gaps; single rows are dropped."""
    cuts = [0, *holes(time).tolist(), len(time)]
    return [slice(a, b) for a, b in itertools.pairwise(cuts) if b - a > 1] or [slice(None)]


def _rate(time: np.ndarray) -> float:
    span = float(np.ptp(time)) if len(time) else 0.0
    return float(f"{(len(time) - 1) / span:.10g}") if span > 0 else 1.0


def _joints(columns: Collection[str]) -> list[str]:
    """Joints in the order of the columns; if any joint has a position, only joints with a position."""
    found = (place(name) for name in columns)
    joints = list(dict.fromkeys(p[1] for p in found if p and p[0].axes == "joint"))
    measured = [joint for joint in joints if f"{joint}.position" in columns]
    driven = [joint for joint in measured if f"{joint}.target" in columns]
    return driven or measured or joints


def _mend(columns: Columns, side: Side) -> None:
    """Unwrap, shift and scale `columns` in place as the options state."""
    options, joints = side.options, _joints(columns)
    listed = options.unwrap if isinstance(options.unwrap, tuple) else joints if options.unwrap else []
    asked = (("unwrap", listed, joints), ("shift", options.shift, joints), ("scale", options.scale, columns))
    for option, names, known in asked:
        for name in names:
            if name not in known:
                remedy = rename(name, known, f"write some of {', '.join([*known][:20])}")
                raise LogError(f"{name} is not in the log", remedy, source=side.source, column=f"field {option}")
    if none := next((name for name, scale in options.scale.items() if scale == 0), None):
        problem = "a scale of 0 removes every value"
        raise LogError(problem, "omit the column", source=side.source, column=f"field scale.{none}")
    if wide := next((joint for joint, angle in options.shift.items() if abs(angle) > 4 * np.pi), None):
        problem = f"{options.shift[wide]:g} rad is more than two turns and looks like degrees"
        raise LogError(problem, "write the shift in radians", source=side.source, column=f"field shift.{wide}")
    for joint in dict.fromkeys([*listed, *options.shift]):
        names = [name for name in (f"{joint}.position", f"{joint}.target") if name in columns]
        angles = {name: np.unwrap(columns[name]) for name in names}
        if len(names) == 2:
            position, target = angles.values()
            angles[names[0]] = position - 2 * np.pi * np.round(np.median(position - target) / (2 * np.pi))
        columns |= {name: values + options.shift.get(joint, 0.0) for name, values in angles.items()}
    columns |= {name: columns[name] * scale for name, scale in options.scale.items()}


def _arrays(columns: Columns, metadata: Metadata, strict: bool, side: Side) -> dict[Any, np.ndarray]:
    """Channels [time, last axis].

    If the log is strict, missing joints and incomplete channels are errors; otherwise they are omitted.
    """
    widths: dict[Any, int] = {}
    for name in columns:
        channel, where = place(name) or (CHANNELS["time"], "")
        if channel.axes == "joint" and where not in metadata.joints and strict:
            remedy = rename(where, metadata.joints, "correct it")
            remedy += f", or add it to the joints in {side.source.name}"
            lacks = [n for n in column_names(channel, metadata.joints) if channel.required and n not in columns]
            if lacks:
                remedy = f"name its joint under `columns:` in the YAML, as in `<column>: {lacks[0]}`"
            raise LogError("unknown joint", remedy, column=name, row="header")
        if channel.axes == "vector":
            # a few names are enough to identify the missing joint
            widths[channel.key] = max(widths.get(channel.key, 0), min(int(where) + 1, len(columns) + 1))
    arrays: dict[Any, np.ndarray] = {}
    for key, channel in CHANNELS.items():
        wanted = column_names(channel, metadata.joints, widths.get(key))
        missing = [name for name in wanted if name not in columns]
        there = next((name for name in wanted if name in columns), None)
        if wanted and not missing:
            arrays[key] = np.stack([columns[name] for name in wanted], axis=-1)
        elif key != "time" and (channel.required or (there and strict)):
            problem = f"the column is missing, but {there} exists" if there else "the required column is missing"
            remedy = f"give all joints {key_name(key)} or none" if there else f"add {key_name(key)} [{channel.unit}]"
            others = [n for n in columns if (found := place(n)) and found[0] == channel and n not in wanted]
            if others and channel.required:
                problem = f"none of the columns {', '.join(others[:6])} belongs to {', '.join(metadata.joints[:6])}"
                remedy = f"name their joints under `columns:` in the YAML, as in `<column>: {missing[0]}`"
            raise LogError(problem, remedy, column=missing[0], row="header")
    for name in ("firmware_gain", "p_gain", "d_gain"):
        if (gain := getattr(metadata, name)) is not None:
            arrays.setdefault(("command", name), np.full_like(arrays["joint", "position"], gain))
    return arrays


def _unshared(time: np.ndarray, streams: Sequence[Stream]) -> list[LogFinding]:
    """A warning if the clocks overlap in only a part of the recording."""
    by_span = sorted(streams, key=lambda stream: float(np.ptp(stream.time)))
    shortest, (used, all_of_it) = by_span[0], (float(np.ptp(t)) for t in (time, by_span[-1].time))
    problem = f"only {used:.4g} of {all_of_it:.4g} s have values from all clocks and are used: "
    problem += f"{next(iter(shortest.columns), 'one')} runs from {shortest.time[0]:.4g} to {shortest.time[-1]:.4g} s"
    remedy = "record all columns for the whole time"
    return [LogFinding(WARNING, problem, remedy, "time", check="shared time")] if used < 0.9 * all_of_it else []


def _unread(arrays: dict[Any, np.ndarray], joints: Sequence[str]) -> list[LogFinding]:
    """Columns that are excluded because some cells contain no number; these cells are set to zero. Positions, commands
    and times are unchanged, so that such cells are rejected later.
    """
    findings = []
    for key, values in arrays.items():
        empty = ~np.isfinite(values)
        if key[0] not in ("joint", "imu") or CHANNELS[key].required or not empty.any():
            continue
        arrays[key] = np.where(empty, 0.0, values)
        columns = column_names(CHANNELS[key], joints)
        for index in np.flatnonzero(empty.any(0) | (key[0] == "imu")):
            rows = empty.any(1) if key[0] == "imu" else empty[:, index]
            problem = f"{rows.sum()} of {len(values)} rows contain no number"
            remedy = "remove these rows or fill them; until then, the channel is not used"
            findings.append(LogFinding(WARNING, problem, remedy, columns[index], set_aside=True, check="no number"))
    return findings
