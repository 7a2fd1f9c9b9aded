"""SAGE pairs: a folder with `control.csv`, `state_motor.csv` and `joint_list.txt`, plain or compressed.

Commands and states have separate time stamps on one clock, in microseconds.
"""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

from op3.rollout.errors import LogError
from op3.rollout.readers.reader import Column, Recording, Stream
from op3.rollout.readers.text import numbers, read_text

_KINDS = {"positions": "position", "velocities": "velocity", "torques": "load"}
_EVERY = ("control.csv", "state_motor.csv", "joint_list.txt")


class Sage:
    """A motion of a robot recorded by SAGE."""

    title = "SAGE pair"
    paths = "<folder with control.csv, state_motor.csv, joint_list.txt>"

    def claims(self, path: Path) -> bool:
        """Recognised by the files in the folder; for a single file of a pair, the error names the folder."""
        if path.is_file():
            return path.name.startswith(_EVERY[:2]) and (path.parent / _EVERY[2]).is_file()
        there = [any(path.glob(f"{name}*")) for name in _EVERY]
        return there[1] or (there[0] and there[2])

    def read(self, path: Path) -> list[Recording]:
        """One recording; torques keep the recorder's unit."""
        if path.is_file():
            raise LogError("the file is one part of a SAGE pair", f"name its folder, {path.parent.name}", source=path)
        control, state, listed = (next(iter(sorted(path.glob(f"{name}*"))), path / name) for name in _EVERY)
        joints = [line.strip() for line in read_text(listed).splitlines() if line.strip()]
        about = dict(joints=joints, robot="real", mount="stand", motion=path.name)
        streams = [_stream(state, joints, _KINDS), _stream(control, joints, {"positions": "target"})]
        return [Recording(streams, about, {"timestamp": Column("time", "us")})]


def _stream(path: Path, joints: list[str], kinds: dict[str, str]) -> Stream:
    """The lists of numbers in a file as columns."""
    rows = list(csv.DictReader(io.StringIO(read_text(path), newline="")))
    header = list(rows[0]) if rows else []
    if not rows:
        raise LogError("the file has no rows", "export it again", source=path)
    for name in ("timestamp", "positions"):
        if name not in header:
            raise LogError("the column is missing", "export it again", source=path, column=name, row="header")
    time = numbers([_listed(row["timestamp"]) for row in rows], path, "timestamp")[:, 0]
    columns = {"timestamp": time}
    for name in (name for name in kinds if name in header):
        lists = [_listed(row[name]) for row in rows]
        if isinstance(lists[0], list) and len(lists[0]) != len(joints):
            problem = f"joint_list.txt has {len(joints)} joints, but a row of {name} has {len(lists[0])} numbers"
            raise LogError(problem, "list every joint of the file in joint_list.txt", source=path, column=name)
        table = numbers(lists, path, name, len(joints))
        columns |= {f"{joint}.{kinds[name]}": table[:, i] for i, joint in enumerate(joints)}
    return Stream(time, columns)


def _listed(cell: str | None) -> Any:
    """The numbers in a cell, or its text if it is not a list."""
    try:
        return json.loads(cell or "")
    except (ValueError, RecursionError):
        return cell
