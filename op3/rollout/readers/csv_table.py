"""CSV, wide (a column per channel and joint) or long (a row per joint and time, or per value)."""

from __future__ import annotations

import csv
import datetime
import functools
import math
import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from op3.rollout.errors import LogError, located
from op3.rollout.guess import guess, guess_all
from op3.rollout.readers.reader import Column, Recording, Stream
from op3.rollout.readers.text import open_text, unpacked

_NAMES = ("joint", "joint_name", "servo", "motor", "name")
_KINDS = ("channel", "signal", "variable", "quantity", "field", "key")

Codes = dict[str, int]
"""Texts of a column by the numbers that stand for them in the table."""


class CsvTable:
    """A table with a header; columns that are not ours by name need `columns:` in the YAML beside it."""

    title = "CSV, wide or long"
    paths = "<name>.csv"

    def claims(self, path: Path) -> bool:
        """By the ending."""
        return path.is_file() and unpacked(path).suffix == ".csv"

    def read(self, path: Path) -> list[Recording]:
        """One recording."""
        with located(source=path):
            header, table, codes = _parsed(path)
            return [_long(header, table, codes) if codes else _wide(header, table)]


def _parsed(path: Path, slowly: bool = False) -> tuple[list[str], np.ndarray, dict[str, Codes]]:
    """Header, numbers [row, column], and codes of the columns that name a joint or what is measured.

    Cells may have decimal commas, hold nothing, or times of the day: numpy is told only where it needs to be.
    """
    with open_text(path) as lines:
        header, mark, open_end = _header(lines)
        named, kinds = ([n for n in header if n.lower() in words][:1] for words in (_NAMES, _KINDS))
        codes: dict[str, Codes] = {name: {} for name in named + kinds} if named and len(header) > 2 else {}
        convert: dict[int | str, Callable[[str], float]] = dict.fromkeys(range(len(header)), _number) if slowly else {}
        convert |= {header.index(name): functools.partial(_code, known) for name, known in codes.items()}
        plain = lines if mark == "," else (line.replace(",", ".") for line in lines)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of a table without rows
                table = np.loadtxt(
                    plain,
                    delimiter=None if mark == " " else mark,
                    converters=convert or None,
                    usecols=range(len(header)) if open_end else None,
                    quotechar='"',
                    ndmin=2,
                )
        except UnicodeError:
            raise
        except ValueError as error:
            if not slowly and "could not convert" in str(error):
                return _parsed(path, slowly=True)
            raise _fault(str(error), header) from None
    if not table.size:
        raise LogError("there is a header but no row", "write at least one row", row="row 1")
    if table.shape[1] != len(header):
        raise _fault("at row 1", header)
    return header, table, codes


def _code(known: Codes, cell: str) -> int:
    return known.setdefault(cell.strip(), len(known))


def _number(cell: str) -> float:
    """A number, also with a decimal comma; NaN for an empty cell, seconds for a date or a time of the day."""
    cell = cell.strip()
    if cell.lower() in ("", "-", "n/a", "na", "null", "none"):
        return math.nan
    if re.match(r"(\d{4}-\d\d-\d\d[T ])?\d\d:\d\d:", cell):
        return datetime.datetime.fromisoformat(cell if "-" in cell else f"2001-01-01T{cell}").timestamp()
    return float(cell.replace("_", "?").replace(",", "."))


def _fault(said: str, header: list[str]) -> LogError:
    """What numpy says of a cell that is no number, or of a row with more or fewer cells than those before."""
    if cell := re.search(r"string '(.*)' to float64 at row (\d+), column (\d+)", said, re.DOTALL):
        problem, remedy = f"{cell[1][:40]!r} is not a number", "write a number, or leave the cell empty"
        return LogError(problem, remedy, row=int(cell[2]) + 1, column=header[min(int(cell[3]), len(header)) - 1])
    row = re.search(r"at row (\d+)", said)
    problem, remedy = f"the row has not the {len(header)} cells of the header", "complete it or leave it out"
    return LogError(problem, f"{remedy} (a file cut short ends like this)", row=int(row[1]) if row else None)


def _header(lines: Iterator[str]) -> tuple[list[str], str, bool]:
    """Names, what separates them, and whether rows end with a separator; passes over remarks and what Excel writes."""

    def skipped(line: str) -> bool:
        remark = line.startswith("#") and not any(mark in line for mark in ",;\t")
        return not line.strip(" #\t\r\n,;") or remark or line.lower().startswith("sep=")

    first = next((line for line in lines if not skipped(line)), "").lstrip("# \t")
    mark = next((m for m in (",", ";", "\t", " ") if m in first.strip()), ",")
    try:
        header = [name.strip() for name in next(csv.reader([first], delimiter=mark, strict=True), [])]
    except csv.Error as error:
        raise LogError(f"the header is not CSV ({error})", "write names and commas", row="header") from None
    open_end = len(header) > 1 and not header[-1]
    header = header[:-1] if open_end else header
    if not header:
        raise LogError("the file is empty", "write a header and at least one row")
    if all(re.fullmatch(r"[-+]?[0-9.]+(e[-+]?[0-9]+)?", name) for name in header):
        remedy = "write the names of the columns into the first line"
        raise LogError("there is no header, the first row holds numbers", remedy, row=1)
    for position, name in enumerate(header):
        if name in header[:position]:
            raise LogError("the column is there twice", "keep one", column=name, row="header")
    return header, mark, open_end


def _wide(header: list[str], table: np.ndarray) -> Recording:
    columns = dict(zip(header, table.T, strict=True))
    for name in [n for n in columns if n == "" or n.startswith("Unnamed")]:
        if np.array_equal(columns[name], np.arange(len(table)) + columns[name][0]):
            del columns[name]  # the row numbers that pandas writes
    clock = None if "time" in columns else _clock(header)
    return Recording([Stream(table[:, 0], columns)], columns={clock[0]: clock[1]} if clock else {}, strict=True)


def _clock(header: list[str]) -> tuple[str, Column] | None:
    """The column that holds the time, by its name, and its meaning."""
    meanings = ((name, guess(name)) for name in header)
    return next(((name, column) for name, column in meanings if column and column.name == "time"), None)


def _long(header: list[str], table: np.ndarray, codes: dict[str, Codes]) -> Recording:
    """A stream per joint, or per joint and kind of value; those of the same times are one."""
    values = [name for name in header if name not in codes]
    clock = _clock(values)
    if clock is None:
        raise LogError("no column names a time", "name one `time` [s]", column="time", row="header")
    values.remove(clock[0])
    told = [header.index(name) for name in codes]
    clocks: dict[bytes, tuple[np.ndarray, dict[str, np.ndarray]]] = {}
    meanings: dict[str, Column] = {clock[0]: clock[1]}
    for group in dict.fromkeys(map(tuple, table[:, told].tolist())):
        joint, *kind = (list(known)[int(code)] for known, code in zip(codes.values(), group, strict=True))
        joint = f"joint_{joint}" if joint.isdigit() else joint
        rows = table[(table[:, told] == group).all(1)]
        named = {f"{joint}.{(kind or [h])[0] or h}": rows[:, header.index(h)] for h in values}
        meanings |= guess_all(named)
        time = rows[:, header.index(clock[0])]
        clocks.setdefault(time.tobytes(), (time, {clock[0]: time}))[1].update(named)
    ordered = sorted(clocks.values(), key=lambda item: not any("pos" in column for column in item[1]))
    return Recording([Stream(time, columns) for time, columns in ordered], columns=meanings)
