"""The wide CSV: one row per time, one column per channel and joint, and a YAML sidecar with the metadata.

`run.csv` lies beside `run.yaml`. Columns are those of the channel table; their order is free. Numbers are
written so that reading gives back the same bits.
"""

from __future__ import annotations

import csv
import difflib
import io
from pathlib import Path

import numpy as np

from op3.rollout import files
from op3.rollout.errors import LogError
from op3.rollout.metadata import Metadata
from op3.rollout.rollout import Rollout
from op3.rollout.schema import CHANNELS, Key, column_names, joint_suffixes, key_name, vector_column

Place = tuple[Key, int]
"""Where a column belongs: a channel and an index on its last axis."""


def write_csv(rollout: Rollout, path: Path, overwrite: bool = False) -> Path:
    """Write `path` and its sidecar; each file is replaced whole or not at all."""
    if rollout.batched:
        raise LogError("a CSV holds one episode", "write rollout.episode(i)", source=path)
    if path.suffix != ".csv":
        raise LogError("the name does not end in .csv", "name the file <name>.csv", source=path)
    for file in (path, path.with_suffix(".yaml")):
        if file.exists() and not overwrite:
            raise LogError("the file is there already", "choose another name or pass overwrite=True", source=file)
    header, columns = [], []
    for key in rollout.channels:
        values = rollout.array(key)
        header += column_names(CHANNELS[key], rollout.joints, values.shape[-1])
        columns.append(values.astype(float))
    lines = [",".join(header)]
    lines += [",".join(map(repr, row)) for row in np.concatenate(columns, axis=1).tolist()]
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write_text(path.with_suffix(".yaml"), rollout.metadata.to_yaml())
    files.write_text(path, "\n".join(lines) + "\n")
    return path


def read_csv(path: Path) -> Rollout:
    """Read a wide CSV and its sidecar `<name>.yaml`; raises `LogError` and imports nothing otherwise."""
    text = _read_text(path)
    sidecar = path.with_suffix(".yaml")
    if not sidecar.is_file():
        remedy = f"write the metadata (joints, robot, mount, rate) to {sidecar.name} beside it"
        raise LogError("the sidecar is missing", remedy, source=sidecar)
    metadata = Metadata.read(sidecar)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        header = [name.strip() for name in next(reader, [])]
        places = _places(header, metadata, path)
        table = _numbers(reader, header, path)
    except csv.Error as error:
        remedy = "write plain comma-separated numbers"
        raise LogError(f"line {reader.line_num} is not CSV ({error})", remedy, source=path) from None
    arrays = {}
    for key in dict.fromkeys(key for key, _ in places):
        columns = sorted((index, column) for column, (k, index) in enumerate(places) if k == key)
        arrays[key] = table[:, [column for _, column in columns]]
    return Rollout.from_arrays(arrays, metadata, path).check(path)


def _read_text(path: Path) -> str:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise LogError(f"the file cannot be read ({error.strerror})", "check the path", source=path) from None
    except UnicodeDecodeError as error:
        remedy = "save it as UTF-8"
        raise LogError(f"byte {error.start} is not UTF-8 text", remedy, source=path) from None
    if not text.strip():
        raise LogError("the file is empty", "write a header and at least one row", source=path)
    return text


def _places(header: list[str], metadata: Metadata, path: Path) -> list[Place]:
    """Where each column belongs; refuses unknown, doubled and missing columns."""
    known: dict[str, Place] = {}
    for key, channel in CHANNELS.items():
        for index, name in enumerate(column_names(channel, metadata.joints)):
            known[name] = key, index
    if len(header) == 1 and ";" in header[0]:
        raise LogError("the columns are separated by ;", "separate them by commas", source=path, row="header")
    places = []
    for position, name in enumerate(header):
        vector = vector_column(name)
        if name not in known and vector is None:
            raise _unknown(name, position, known, metadata, path)
        if name in header[:position]:
            remedy = "keep one of the two"
            raise LogError("the column is there twice", remedy, source=path, column=name, row="header")
        places.append(known[name] if vector is None else (vector[0].key, vector[1]))
    _check_whole(places, metadata, path)
    return places


def _unknown(name: str, position: int, known: dict, metadata: Metadata, path: Path) -> LogError:
    joint, _, suffix = name.rpartition(".")
    shown = name if name.isprintable() and 0 < len(name) <= 60 else f"{position + 1} ({name[:40]!r})"
    if suffix in joint_suffixes() and joint:
        problem = "unknown joint"
        close = difflib.get_close_matches(joint, metadata.joints, n=1)
        rename = f"rename it {close[0]} if that is meant" if close else "correct it"
        remedy = f"{rename}, or add it to the joints in {path.with_suffix('.yaml').name}"
    else:
        problem = "unknown column"
        close = difflib.get_close_matches(name, list(known), n=1)
        rename = f"rename it {close[0]} if that is meant" if close else "name it as the schema does"
        remedy = f"{rename}, or remove the column"
    return LogError(problem, remedy, source=path, column=shown, row="header")


def _check_whole(places: list[Place], metadata: Metadata, path: Path) -> None:
    """Refuse missing required channels, and channels that lack a joint or an axis."""
    present: dict[Key, set[int]] = {}
    for key, index in places:
        present.setdefault(key, set()).add(index)
    for key, channel in CHANNELS.items():
        entries = present.get(key, set())
        if not entries and not channel.required:
            continue
        names = column_names(channel, metadata.joints, max(entries, default=-1) + 1)
        missing = [name for index, name in enumerate(names) if index not in entries]
        if not missing:
            continue
        if entries:
            problem = f"the column is missing while {names[min(entries)]} is there"
            remedy = f"give {key_name(key)} for all or for none"
        else:
            problem, remedy = "the required column is missing", f"add {key_name(key)} [{channel.unit}]"
        raise LogError(problem, remedy, source=path, column=missing[0], row="header")


def _numbers(reader, header: list[str], path: Path) -> np.ndarray:
    """Every data row as floats [time, column]; blank lines are passed over."""
    rows: list[list[float]] = []
    for cells in reader:
        if not cells:
            continue
        if len(cells) != len(header):
            problem = f"line {reader.line_num} has {len(cells)} cells where {len(header)} belong"
            few = len(cells) < len(header)
            remedy = "complete or remove the row (a file cut short ends like this)" if few else "remove the rest"
            column = header[min(len(cells), len(header) - 1)]
            raise LogError(problem, remedy, source=path, row=len(rows) + 1, column=column)
        try:
            # float() takes 1_000 for a thousand; in a log it is a slip.
            row = list(map(float, cells)) if not any("_" in cell for cell in cells) else None
        except ValueError:
            row = None
        rows.append(row or _bad_cell(cells, header, len(rows) + 1, path))
    if not rows:
        raise LogError("there is a header but no row", "write at least one row", source=path, row="row 1")
    return np.array(rows)


def _bad_cell(cells: list[str], header: list[str], row: int, path: Path):
    for column, cell in zip(header, cells, strict=True):
        try:
            bad = "_" in cell or float(cell) is None
        except ValueError:
            bad = True
        if bad:
            problem = f"{cell[:40]!r} is not a number" if cell.strip() else "the cell is empty"
            remedy = "write a number with a decimal point, or leave out the row"
            raise LogError(problem, remedy, source=path, column=column, row=row)
    raise AssertionError("a row was refused without a bad cell")
