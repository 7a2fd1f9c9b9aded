"""CSV, wide (a column per channel and joint) or long (a row per joint and time, or per value)."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.guess import guess, guess_all
from op3.rollout.importing import read_side, side_path
from op3.rollout.readers.reader import Column, Recording, Stream
from op3.rollout.readers.text import ending, read_text

_NAMES = ("joint", "joint_name", "servo", "motor", "name")
_KINDS = ("channel", "signal", "variable", "quantity", "field", "key")


class CsvTable:
    """A table with a header; beside it, its YAML."""

    title = "CSV, wide or long"
    paths = "<name>.csv"

    def claims(self, path: Path) -> bool:
        """By the ending."""
        return path.is_file() and ending(path) == ".csv"

    def read(self, path: Path) -> list[Recording]:
        """One recording."""
        text, side = read_text(path), read_side(path)
        if not side.found:
            remedy = f"write the metadata (joints, robot, mount, rate) to {side_path(path).name} beside it"
            remedy += f", which `python experiments/import_log.py data={path.name}` proposes"
            raise LogError("the sidecar is missing", remedy, source=side_path(path))
        return [recording(text, path)]


def recording(text: str, path: Path) -> Recording:
    """What a CSV text holds; columns that are ours by name are taken as they are, others need `columns:`."""
    text = text.lstrip()
    comma = _separator(text)
    if comma == ";":
        text = text.replace(",", ".")  # where ; separates, a comma may stand in numbers
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=comma, strict=True)
    try:
        header = [name.strip() for name in next(reader, [])]
        for position, name in enumerate(header):
            if name in header[:position]:
                raise LogError("the column is there twice", "keep one", source=path, column=name, row="header")
        keys = [n for n in header if n.lower() in _NAMES], [n for n in header if n.lower() in _KINDS]
        if keys[0] and len(header) > 2:
            rows = list(_rows(reader, header, path))
            return _long(header, rows, keys[0][0], next(iter(keys[1]), None), path)
        table = _fast(text, len(header), comma)
        if table is None:
            table = np.array([_numbers(cells, header, n, path) for n, cells in _rows(reader, header, path)])
    except csv.Error as error:
        remedy = "write plain comma-separated numbers"
        raise LogError(f"line {reader.line_num} is not CSV ({error})", remedy, source=path) from None
    columns = {name: table[:, i] for i, name in enumerate(header)}
    time = next((name for name in header if name == "time"), None) or _clock(header)
    if time is None:
        remedy = "add time [s], or name the column of the time under `columns:`"
        raise LogError("the required column is missing", remedy, source=path, column="time", row="header")
    return Recording([Stream(columns[time], columns)], strict=True)


def _clock(header: list[str]) -> str | None:
    """The column that holds the time, by its name."""
    meanings = {name: guess(name) for name in header}
    return next((name for name, column in meanings.items() if column and column.name == "time"), None)


def _separator(text: str) -> str:
    line = text.partition("\n")[0]
    return next((mark for mark in ";\t" if mark in line and "," not in line), ",")


def _fast(text: str, width: int, comma: str) -> np.ndarray | None:
    """The table by numpy's parser; None where it is not plainly numbers, which the slow way names."""
    if "_" in text.partition("\n")[2] or '"' in text.partition("\n")[2]:
        return None  # a number with _ in it is a slip, in a log
    try:
        stream = io.StringIO(text, newline=None)
        table = np.loadtxt(stream, delimiter=comma, skiprows=1, comments=None, ndmin=2)
    except (ValueError, IndexError):
        return None
    return table if table.shape[1] == width and len(table) else None


def _rows(reader, header: list[str], path: Path):
    """Every data row with its number from 1; blank lines are passed over."""
    number = 0
    for cells in reader:
        if not cells:
            continue
        number += 1
        if len(cells) != len(header):
            problem = f"line {reader.line_num} has {len(cells)} cells where {len(header)} belong"
            few = len(cells) < len(header)
            remedy = "complete or remove the row (a file cut short ends like this)" if few else "remove the rest"
            column = header[min(len(cells), len(header) - 1)]
            raise LogError(problem, remedy, source=path, row=number, column=column)
        yield number, cells
    if not number:
        raise LogError("there is a header but no row", "write at least one row", source=path, row="row 1")


def _numbers(cells: list[str], header: list[str], row: int, path: Path) -> list[float]:
    return [_number(cell, name, row, path) for cell, name in zip(cells, header, strict=True)]


def _number(cell: str, column: str, row: int, path: Path) -> float:
    try:
        if "_" not in cell:
            return float(cell)
    except ValueError:
        pass
    problem = f"{cell[:40]!r} is not a number" if cell.strip() else "the cell is empty"
    remedy = "write a number with a decimal point, or leave out the row"
    raise LogError(problem, remedy, source=path, column=column, row=row)


def _long(header: list[str], rows: list[tuple[int, list[str]]], name: str, kind: str | None, path: Path) -> Recording:
    """A stream per joint, or per joint and kind of value; each has the clock of its own rows."""
    clock = _clock([h for h in header if h not in (name, kind)])
    if clock is None:
        raise LogError("no column names a time", "name one `time` [s]", source=path, column="time", row="header")
    groups: dict[tuple[str, str], list[tuple[int, list[str]]]] = {}
    for number, cells in rows:
        by = dict(zip(header, cells, strict=True))
        groups.setdefault((by[name].strip(), by[kind].strip() if kind else ""), []).append((number, cells))
    values = [h for h in header if h not in (name, kind, clock)]
    clocks: dict[bytes, tuple[np.ndarray, dict[str, np.ndarray]]] = {}
    meanings: dict[str, Column] = {clock: guess(clock) or Column("time")}
    for (joint, what), lines in groups.items():
        joint = f"joint_{joint}" if joint.isdigit() else joint
        table = np.array(
            [[_number(cells[header.index(h)], h, n, path) for h in (clock, *values)] for n, cells in lines]
        )
        named = {f"{joint}.{what or h}": table[:, i + 1] for i, h in enumerate(values)}
        meanings |= guess_all(named)
        clocks.setdefault(table[:, 0].tobytes(), (table[:, 0], {clock: table[:, 0]}))[1].update(named)
    ordered = sorted(clocks.values(), key=lambda item: not any("pos" in column for column in item[1]))
    return Recording([Stream(time, columns) for time, columns in ordered], columns=meanings)
