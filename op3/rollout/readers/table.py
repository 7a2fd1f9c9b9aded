"""Tables of numbers in text: a header and rows with any separator, compression and encoding."""

from __future__ import annotations

import csv
import datetime
import functools
import itertools
import math
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.readers.text import open_text
from op3.rollout.units import UNITS, canonical

Codes = dict[str, int]
"""Texts of a column, in the order of their numeric codes."""


def read_table(
    path: Path, texts: Callable[[Sequence[str]], Sequence[str]], slowly: bool = False
) -> tuple[list[str], np.ndarray, dict[str, Codes]]:
    """Header, numbers [row, column], and the codes of text columns.

    Cells may have decimal commas, be empty, or contain times of day; only such tables need the slower parser.

    Args:
        path: Path of the file.
        texts: Function that selects text columns from the header.
        slowly: Whether to accept cells other than plain numbers, and lines of spaces.
    """
    with open_text(path) as lines:
        header, mark, open_end, lines = _header(lines)
        codes: dict[str, Codes] = {name: {} for name in texts(header)}
        convert: dict[int | str, Callable[[str], float]] = dict.fromkeys(range(len(header)), _number) if slowly else {}
        convert |= {header.index(name): functools.partial(_code, known) for name, known in codes.items()}
        plain = lines if mark == "," else (line.replace(",", ".") for line in lines)
        plain = (line for line in plain if line.strip()) if slowly else plain
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # for a table without rows
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
            if not slowly:
                return read_table(path, texts, slowly=True)
            raise _fault(str(error), header) from None
    if not table.size:
        raise LogError("there is a header but there are no rows", "write at least one row", row="row 1")
    if table.shape[1] != len(header):
        if table.shape[1] > 1.5 * len(header):
            problem = f"there are {table.shape[1]} cells for {len(header)} names, as if decimal commas had split them"
            raise LogError(problem, "write decimal points, or separate the columns by `;`", row=1)
        raise _fault("at row 1", header)
    return header, table, codes


def _code(known: Codes, cell: str) -> int:
    return known.setdefault(cell.strip(), len(known))


def _number(cell: str) -> float:
    """A number, possibly with a decimal comma; NaN for an empty cell, seconds for a date or time of day."""
    cell = cell.strip()
    if cell.lower() in ("", "-", "n/a", "na", "null", "none"):
        return math.nan
    if re.match(r"(\d{4}-\d\d-\d\d[T ])?\d\d:\d\d:|\d{8}T\d{6}", cell):
        return datetime.datetime.fromisoformat(cell if re.match(r"\d{4}", cell) else f"2001-01-01T{cell}").timestamp()
    if cell.lower() in ("true", "false"):
        return float(cell.lower() == "true")
    return float(cell.replace("_", "?").replace(",", "."))


def _fault(said: str, header: list[str]) -> LogError:
    """An error from numpy's message about a non-numeric cell or a row with a wrong number of cells."""
    if cell := re.search(r"string '(.*)' to float64 at row (\d+), column (\d+)", said, re.DOTALL):
        column, row, text = header[min(int(cell[3]), len(header)) - 1], int(cell[2]) + 1, cell[1].strip()
        problem, remedy = f"{cell[1][:40]!r} is not a number", "write a number, or remove the row"
        if re.match(r"\d{1,4}[./-]\d\d?[./-]\d{1,4}\b", text):
            remedy = "write dates such as 2026-03-28T14:59:55.123, or seconds"
        elif re.fullmatch(r"-?\d{1,3}([.,]\d{3})+[.,]\d*", text):
            remedy = "write numbers without thousands separators"
        if text.strip("# ") == column:
            problem, remedy = "the header is repeated", "remove the line, or split the file there"
        elif row == 1 and (
            text[:1] + text[-1:] in ("[]", "()") or any(canonical(text) in known for known in UNITS.values())
        ):
            problem, remedy = (
                f"{text!r} is a unit",
                "remove the row of units, and write the units under `columns:` in the YAML",
            )
        return LogError(problem, remedy, row=row, column=column)
    row = re.search(r"at row (\d+)", said)
    problem, remedy = f"the row does not have the {len(header)} cells of the header", "complete or remove it"
    return LogError(problem, f"{remedy} (a truncated file ends like this)", row=int(row[1]) if row else None)


def _header(lines: Iterator[str]) -> tuple[list[str], str, bool, Iterator[str]]:
    """Names, their separator, whether rows end with a separator, and the rows.

    Skips Excel's additions and comments; a line that begins with `#` or `%` is the header only if rows follow it.
    """
    remark = first = ""
    for line in lines:
        if not line.strip(" #%\t\r\n,;") or line.lower().startswith("sep="):
            continue
        if line[0] not in "#%":
            first = line
            break
        remark = line
    follows = not first or any(re.match(r'["\s]*[-+.]?\d', cell) for cell in re.split("[,;\t]", first))
    if follows and any(mark in remark for mark in ",;\t"):
        lines, first = itertools.chain([first] * bool(first), lines), remark
    first = first.lstrip("#% \t")
    mark = next((m for m in (",", ";", "\t", "|", " ") if m in first.strip()), ",")
    try:
        named = first.split() if mark == " " else next(csv.reader([first], delimiter=mark, strict=True), [])
        header = [name.strip(' "' if mark == " " else None) for name in named]
    except csv.Error as error:
        raise LogError(f"the header is not CSV ({error})", "write names and commas", row="header") from None
    open_end = len(header) > 1 and not header[-1]
    header = header[:-1] if open_end else header
    row = next(lines, "")  # rows may lack the separator that ends the header
    open_end |= mark != " " and row.count(mark) == len(header) and row.rstrip().endswith(mark)
    lines = itertools.chain([row] * bool(row), lines)
    if not header:
        raise LogError("the file is empty", "write a header and at least one row")
    if all(re.fullmatch(r"[-+]?[0-9.]+(e[-+]?[0-9]+)?", name) for name in header):
        remedy = "write the names of the columns into the first line"
        raise LogError("there is no header; the first row contains numbers", remedy, row=1)
    for position, name in enumerate(header):
        if name in header[:position]:
            remedy = "give every column a unique name (join a header of two rows into one, such as `hip.position`)"
            raise LogError("the column appears twice", remedy, column=name, row="header")
    return header, mark, open_end, lines
