"""CSV, wide (a column per channel and joint) or long (a row per joint and time, or per value)."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.guess import guess, guess_all
from op3.rollout.importing import read_side, side_path
from op3.rollout.readers.reader import Column, Recording, Stream
from op3.rollout.readers.text import ending, open_text

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
        if not read_side(path).found:
            remedy = f"write the metadata (joints, robot, mount, rate) to {side_path(path).name} beside it"
            remedy += f", which `python experiments/import_log.py data={path.name}` proposes"
            raise LogError("the sidecar is missing", remedy, source=side_path(path))
        return [recording(path)]


def recording(path: Path) -> Recording:
    """What a CSV holds; columns that are ours by name are taken as they are, others need `columns:`."""
    before = 0
    try:
        with open_text(path) as lines:
            before, first = next((item for item in enumerate(lines) if not _skipped(item[1])), (0, ""))
            first = first.lstrip("# \t")
            mark = next((m for m in (",", ";", "\t", " ") if m in first.strip()), ",")
            header = [name.strip() for name in next(csv.reader([first], delimiter=mark, strict=True), [])]
            header = header[:-1] if header[1:] and not header[-1] else header
            _check_header(header, path)
            keys = [[n for n in header if n.lower() in words] for words in (_NAMES, _KINDS)]
            if keys[0] and len(header) > 2:
                rows = list(_rows(lines, header, mark, before, path))
                return _long(header, rows, keys[0][0], next(iter(keys[1]), None), path)
            table = _fast(lines, len(header), mark)
        if table is None:
            with open_text(path) as lines:
                rows = _rows(itertools.islice(lines, before + 1, None), header, mark, before, path)
                numbers = [[_number(c, n, at, path) for c, n in zip(row, header, strict=True)] for at, row in rows]
            table = np.array(numbers)
    except csv.Error as error:
        raise LogError(f"line {before + 1} is not CSV ({error})", "write plain numbers", source=path) from None
    columns = {name: table[:, i] for i, name in enumerate(header)}
    for name in [n for n in columns if n == "" or n.startswith("Unnamed")]:
        if np.array_equal(columns[name], np.arange(len(table)) + columns[name][0]):
            del columns[name]  # the row numbers that pandas writes
    time = next((name for name in columns if name == "time"), None) or _clock(columns)
    if time is None:
        remedy = "add time [s], or name the column of the time under `columns:`"
        raise LogError("the required column is missing", remedy, source=path, column="time", row="header")
    return Recording([Stream(columns[time], columns)], strict=True)


def _skipped(line: str) -> bool:
    """Whether a line before the header is none: empty, a remark, or what Excel writes."""
    remark = line.startswith("#") and not any(mark in line for mark in ",;\t")
    return not line.strip(" #\t\r\n,;") or remark or line.lower().startswith("sep=")


def _check_header(header: list[str], path: Path) -> None:
    if not header:
        raise LogError("the file is empty", "write a header and at least one row", source=path)
    if all(re.fullmatch(r"[-+]?[0-9.]+(e[-+]?[0-9]+)?", name) for name in header):
        remedy = "write the names of the columns into the first line"
        raise LogError("there is no header, the first row holds numbers", remedy, source=path, row=1)
    for position, name in enumerate(header):
        if name in header[:position]:
            raise LogError("the column is there twice", "keep one", source=path, column=name, row="header")


def _clock(header: list[str] | dict[str, np.ndarray]) -> str | None:
    """The column that holds the time, by its name."""
    meanings = {name: guess(name) for name in header}
    return next((name for name, column in meanings.items() if column and column.name == "time"), None)


def _fast(lines: Iterator[str], width: int, mark: str) -> np.ndarray | None:
    """The table by numpy's parser; None where it is not plainly numbers, which the slow way names."""
    lines = lines if mark == "," else (line.replace(",", ".") for line in lines)
    peeked = next((line for line in lines if line.strip()), None)
    if peeked is None:
        return None
    try:
        table = np.loadtxt(
            itertools.chain([peeked], lines), delimiter=None if mark == " " else mark, ndmin=2, comments="#"
        )
    except (ValueError, IndexError):
        return None
    return table if table.shape[1] == width else None


def _rows(lines: Iterator[str], header: list[str], mark: str, before: int, path: Path) -> Iterator[tuple[int, list]]:
    """Every data row with its number from 1; blank lines and comments are passed over."""
    reader, number = csv.reader(lines, delimiter=mark, skipinitialspace=True, strict=True), 0
    for cells in reader:
        if not cells or cells[0].startswith("#"):
            continue
        number, line = number + 1, reader.line_num + before + 1
        if len(cells) == len(header) + 1 and not cells[-1]:
            cells = cells[:-1]
        if len(cells) != len(header):
            problem = f"line {line} has {len(cells)} cells where {len(header)} belong"
            few = len(cells) < len(header)
            remedy = "complete or remove the row (a file cut short ends like this)" if few else "remove the rest"
            column = header[min(len(cells), len(header) - 1)]
            raise LogError(problem, remedy, source=path, row=number, column=column)
        yield number, cells
    if not number:
        raise LogError("there is a header but no row", "write at least one row", source=path, row="row 1")


def _number(cell: str, column: str, row: int, path: Path) -> float:
    try:
        if "_" not in cell:
            return float(cell.replace(",", "."))
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
    values = [h for h in header if h not in (name, kind, clock)]
    groups: dict[tuple[str, str], list[list[float]]] = {}
    for number, cells in rows:
        by = dict(zip(header, cells, strict=True))
        place = by[name].strip(), by[kind].strip() if kind else ""
        groups.setdefault(place, []).append([_number(by[h], h, number, path) for h in (clock, *values)])
    clocks: dict[bytes, tuple[np.ndarray, dict[str, np.ndarray]]] = {}
    meanings: dict[str, Column] = {clock: guess(clock) or Column("time")}
    for (joint, what), lines in groups.items():
        joint, table = f"joint_{joint}" if joint.isdigit() else joint, np.array(lines)
        named = {f"{joint}.{what or h}": table[:, i + 1] for i, h in enumerate(values)}
        meanings |= guess_all(named)
        clocks.setdefault(table[:, 0].tobytes(), (table[:, 0], {clock: table[:, 0]}))[1].update(named)
    ordered = sorted(clocks.values(), key=lambda item: not any("pos" in column for column in item[1]))
    return Recording([Stream(time, columns) for time, columns in ordered], columns=meanings)
