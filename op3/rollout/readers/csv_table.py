"""CSV: wide (a column per channel and joint) or long (a row per joint and time, or per value)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from op3.rollout.errors import LogError, located
from op3.rollout.guess import guess, guess_all
from op3.rollout.readers.reader import Column, Recording, Stream
from op3.rollout.readers.table import Codes, read_table
from op3.rollout.readers.text import unpacked

_NAMES = ("joint", "joint_name", "servo", "motor", "name")
_NUMBERS = ("id", "joint_id", "servo_id", "motor_id")
_KINDS = ("channel", "signal", "variable", "quantity", "field", "key")
_LISTED = re.compile(r"(.*\.)(?:joint_)?names?(\d+)")
"""Columns with joint names written by `rostopic echo -p`; the numbers of a joint have the same index."""


class CsvTable:
    """A table with a header; names other than those of the wide CSV need `columns:` in the YAML."""

    title = "CSV, wide or long"
    paths = "<name>.csv"

    def claims(self, path: Path) -> bool:
        """Recognised by the file name extension."""
        return path.is_file() and unpacked(path).suffix == ".csv"

    def read(self, path: Path) -> list[Recording]:
        """One recording."""
        with located(source=path):
            header, table, codes = read_table(path, _texts)
            if any(_LISTED.fullmatch(name) for name in codes):
                return [_echoed(header, table, codes)]
            return [_long(header, table, codes) if codes else _wide(header, table)]


def _texts(header: Sequence[str]) -> list[str]:
    """Columns of a long table that contain the joint and the quantity."""
    if listed := [name for name in header if _LISTED.fullmatch(name)]:
        return listed + [name for name in header if name.endswith(".frame_id")]
    named, kinds, numbered = ([n for n in header if n.lower() in words][:1] for words in (_NAMES, _KINDS, _NUMBERS))
    named = named or (numbered if kinds else [])  # a lone number may count rows
    return named + kinds if named and len(header) > 2 else []


def _echoed(header: list[str], table: np.ndarray, codes: dict[str, Codes]) -> Recording:
    """One message per row, as `rostopic echo -p` writes it: joint names in cells, times in ns."""
    joints = {}
    for name, known in codes.items():
        if (listed := _LISTED.fullmatch(name)) is None:
            continue
        if len(known) > 1:
            problem, remedy = (
                f"the joint name changes within the column: {', '.join([*known][:2])}",
                "record the messages as a bag",
            )
            raise LogError(problem, remedy, column=name, row=int((table[:, header.index(name)] != 0).argmax()) + 1)
        joints[listed[2]] = next(iter(known))
    columns: dict[str, np.ndarray] = {}
    for name, values in zip(header, table.T, strict=True):
        numbered = re.fullmatch(r"(?:field\.)?(.*?)(\d+)", name)
        if name in codes or ".header." in name:
            continue
        joint = joints.get(numbered[2]) if numbered else None
        columns[f"{joint}.{numbered[1]}" if joint and numbered else name] = values
    meanings = guess_all(columns)
    if header[0] in columns:
        meanings[header[0]] = Column("time", "ns" if table[0, 0] > 1e15 else None)
    return Recording([Stream(table[:, 0], columns)], columns=meanings)


def _wide(header: list[str], table: np.ndarray) -> Recording:
    columns = dict(zip(header, table.T, strict=True))
    for name in [n for n in columns if n == "" or n.startswith("Unnamed")]:
        if (np.diff(columns[name]) >= 1).all() and not (columns[name] % 1).any():
            del columns[name]  # row numbers that pandas writes
    clock = None if "time" in columns else _clock(header)
    return Recording([Stream(table[:, 0], columns)], columns={clock[0]: clock[1]} if clock else {}, strict=True)


def _clock(header: list[str]) -> tuple[str, Column] | None:
    """The name and the meaning of the time column."""
    meanings = ((name, guess(name)) for name in header)
    return next(((name, column) for name, column in meanings if column and column.name == "time"), None)


def _long(header: list[str], table: np.ndarray, codes: dict[str, Codes]) -> Recording:
    """One stream per joint, or per joint and quantity; streams with equal times are merged."""
    values = [name for name in header if name not in codes]
    clock = _clock(values)
    if clock is None:
        raise LogError("no column contains the time", "name one `time` [s]", column="time", row="header")
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
