"""SAGE pairs: a folder with `control.csv`, `state_motor.csv` and `joint_list.txt`, each plain or packed.

Commands and states have time stamps of their own, in microseconds of one clock.
"""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.readers.reader import Recording, Stream
from op3.rollout.readers.text import read_text

_STATE = {"positions": "position", "velocities": "velocity", "torques": "load"}
_EVERY = ("control.csv", "state_motor.csv", "joint_list.txt")


class Sage:
    """One excitation of a robot, recorded by SAGE."""

    title = "SAGE pair"
    paths = "<folder with control.csv, state_motor.csv, joint_list.txt>"

    def claims(self, path: Path) -> bool:
        """By the files in the folder."""
        return path.is_dir() and any(path.glob("control.csv*")) and any(path.glob("state_motor.csv*"))

    def read(self, path: Path) -> list[Recording]:
        """One recording; torques stay in the recorders' unit."""
        files = {name: next(iter(sorted(path.glob(f"{name}*"))), path / name) for name in _EVERY}
        joints = [line.strip() for line in read_text(files["joint_list.txt"]).splitlines() if line.strip()]
        state = _table(files["state_motor.csv"], joints, _STATE)
        control = _table(files["control.csv"], joints, {"positions": "target"})
        about = dict(joints=joints, robot="real", mount="stand", motion=path.name)
        return [Recording([state, control], about)]


def _table(path: Path, joints: list[str], kinds: dict[str, str]) -> Stream:
    """A file's lists of numbers as columns."""
    rows = list(csv.DictReader(io.StringIO(read_text(path), newline="")))
    header = list(rows[0]) if rows else []
    for name in ("timestamp", "positions"):
        if name not in header:
            raise LogError("the column is missing", "export it again", source=path, column=name, row="header")
    time = np.array([_list(row, "timestamp", 1, n, path) for n, row in enumerate(rows)])[:, 0] * 1e-6
    columns = {}
    for name in (name for name in kinds if name in header):
        table = np.array([_list(row, name, len(joints), n, path) for n, row in enumerate(rows)])
        columns |= {f"{joint}.{kinds[name]}": table[:, i] for i, joint in enumerate(joints)}
    return Stream(time, columns)


def _list(row: dict, name: str, width: int, number: int, path: Path) -> list[float]:
    """The numbers in a cell."""
    text = row[name] or ""
    try:
        values = json.loads(text)
        values = [float(value) for value in (values if isinstance(values, list) else [values])]
    except (ValueError, TypeError, RecursionError, OverflowError):
        values = []
    if len(values) != width:
        problem = f"{text[:40]!r} does not hold {width} numbers"
        remedy = "complete or remove the row, or correct joint_list.txt"
        raise LogError(problem, remedy, source=path, column=name, row=number + 1)
    return values
