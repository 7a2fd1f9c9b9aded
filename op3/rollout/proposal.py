"""Proposes names, units and signs for a log without a YAML, with reasons."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from op3.robot import load_robot
from op3.robot.robot import Robot
from op3.rollout.errors import LogError
from op3.rollout.guess import guess_all
from op3.rollout.importing import read_side
from op3.rollout.read import reader_of
from op3.rollout.readers.reader import Column, Recording
from op3.rollout.robot_log import called, in_its_terms
from op3.rollout.schema import place
from op3.rollout.units import COUNTS, UNITS

Proposal = tuple[dict[str, Any], dict[str, Column], list[str], set[str]]


def propose(path: Path, robot: str | None = None) -> Proposal:
    """Proposed metadata and column meanings of a log, doubts about them, and the columns with doubtful units.

    Args:
        path: Path of the log.
        robot: Name or file of the robot whose joint names the columns get; None: names are unchanged.
    """
    found = reader_of(path).read(path)[0]
    if not isinstance(found, Recording):
        return found.metadata.to_dict(), {}, [], set()
    known = load_robot(robot) if robot else None
    columns = guess_all([n for stream in found.streams for n in stream.columns], list(called(known)) if known else ())
    columns |= {name: column for name, column in found.columns.items() if name in columns}
    doubts = [f"{one.problem}; {one.remedy}" for one in found.doubts]
    values = {name: column for stream in found.streams for name, column in stream.columns.items()}
    about = {"robot": "real", "mount": "stand", **found.metadata, **read_side(path).metadata}
    if known is not None:
        columns = _by_number(columns, known)
    columns, guessed = _in_counts(columns, values, known)
    if known is not None:
        columns = {name: _of_robot(column, known) for name, column in columns.items()}
        if not any(column.name and column.name.rpartition(".")[0] in known.joints for column in columns.values()):
            problem = f"the log has none of the joints of {known.name}: {', '.join(known.joints)}"
            remedy = "give the robot that made the log, or import the log without robot= and correct the YAML"
            raise LogError(problem, remedy, source=path)
        there = {column.name.rpartition(".")[0] for column in columns.values() if column.name}
        # its conventions are in the columns
        about |= {"joints": [joint for joint in known.joints if joint in there], "robot_file": known.reference}
    about = {name: value for name, value in about.items() if value not in (None, {}, [])}
    reasons = {found.columns[one.column].why for one in found.doubts if one.column in found.columns}
    doubted = {n for n, column in found.columns.items() if column.why in reasons and columns.get(n) == column}
    return about, columns, doubts + guessed, doubted


def _in_counts(
    columns: dict[str, Column], values: Mapping[str, np.ndarray], robot: Robot | None
) -> tuple[dict[str, Column], list[str]]:
    """The columns with angles converted from encoder counts, and the guesses about them.

    Integers too large for an angle are counts. The robot file states the servo; otherwise values around 2048 mean 4096
    counts per turn, values around 512 mean 1024 counts in 300 degrees, and values around 32768 mean 16 bits per turn.
    """
    kind = {name: str(column.name).rpartition(".")[2] for name, column in columns.items()}
    angles = {name for name in columns if kind[name] in ("position", "target")}
    said = {name for name in angles if "counts" in str(columns[name].unit)}
    whole = {n for n in angles if columns[n].unit is None and columns[n].offset == 0 and _whole(values[n])}
    chosen = said or (whole if any(np.abs(values[name]).max() > 360 for name in whole) else set())
    if not chosen:
        return columns, []
    numbers = np.concatenate([values[name][np.isfinite(values[name])] for name in chosen])
    small = numbers.max() < 1024 and numbers.min() >= 0 and 256 < np.median(numbers) < 768
    fine = numbers.max() < 2**16 and numbers.min() >= 0 and 2**14 < np.median(numbers) < 3 * 2**14
    unit = "counts of 1024 in 300 deg" if small else "counts of 65536 a turn" if fine else COUNTS
    found, why = dict(columns), f"integers from {numbers.min():g} to {numbers.max():g}"
    for name, column in columns.items():
        joint = called(robot).get(str(column.name).rpartition(".")[0]) if robot and column.name else None
        make = robot.servo(joint) if robot and joint else None
        size, zero = (unit, 0.0) if make is None else (make.position_unit, make.counts.zero.si)
        if name in chosen:
            offset = -zero * size if isinstance(size, float) else 0.0
            found[name] = dataclasses.replace(column, unit=size, offset=offset, why=why)
        elif make and kind[name] == "velocity" and column.unit is None and _whole(values[name]):
            found[name] = dataclasses.replace(column, unit=make.counts.velocity.si, why=why)
    others = "those of a servo with 1024 counts in 300 degrees, such as XL-320, AX-12 or SCS0009"
    assumed = f"{others}, with values near the middle" if small else f"{unit}, not {others}"
    if robot is not None:
        sizes = [found[name].unit for name in chosen]
        fine = small and any(isinstance(size, float) and size < UNITS["rad"][unit] for size in sizes)
        return found, [f"{why} look like {others}, but {robot.name} has other servos"] if fine else []
    return found, [f"{why} are assumed to be {assumed}; write `unit:` if the servo's unit differs"]


def _whole(values: np.ndarray) -> bool:
    there = values[np.isfinite(values)]
    return bool(len(there)) and bool((there == np.round(there)).all())


def _by_number(columns: dict[str, Column], robot: Robot) -> dict[str, Column]:
    """The columns with the robot's joint names, assigned by bus id, or in order if the numbers of joints agree."""
    joints = {name: str(column.name).rpartition(".")[0] for name, column in columns.items() if column.name}
    numbers = {j: int(found[1]) for j in joints.values() if (found := re.fullmatch(r"(?:[A-Za-z]+_?)?(\d+)", j))}
    if len(numbers) != len(robot.joints) or numbers.keys() & called(robot).keys():
        return columns
    ids, why = {number: joint for joint, number in robot.bus_ids.items()}, f"the bus ids of {robot.name}"
    if ids.keys() != set(numbers.values()):
        ids = dict(zip(sorted(numbers.values()), robot.joints, strict=True))
        why = f"the order of the joints of {robot.name}"
    named = {joint: ids[number] for joint, number in numbers.items()}
    return columns | {
        name: dataclasses.replace(columns[name], name=str(columns[name].name).replace(joint, named[joint], 1), why=why)
        for name, joint in joints.items()
        if joint in named
    }


def _of_robot(column: Column, robot: Robot) -> Column:
    """The column with the robot's joint name, and with sign, zero and unit from the robot file."""
    known = place(column.name) if column.name else None
    if known is None or known[0].axes != "joint" or known[1] not in called(robot):
        return column
    joint = called(robot)[known[1]]
    name = known[0].column.format(joint=joint)
    if column.unit is not None:
        return dataclasses.replace(column, name=name)
    sign, size, offset = in_its_terms(robot, joint, name.rpartition(".")[2])
    why = column.why or f"the file of {robot.name}"
    return Column(name, None if size == 1.0 else size, 1 if sign == 1 else -1, offset, why)


def as_yaml(
    metadata: dict[str, Any],
    columns: dict[str, Column],
    doubts: Sequence[str] = (),
    doubted: Collection[str] = (),
) -> str:
    """The text of the YAML beside the log, which the user can correct. Doubted columns are comments, so that the reader
    decides their units again, for example after a missing file was added."""
    options: dict[str, Any] = dict(default_flow_style=True, width=10**9, allow_unicode=True, sort_keys=False)
    lines = [yaml.safe_dump({name: value}, **options).strip()[1:-1] for name, value in metadata.items()]
    if columns:
        lines.append("columns:  # column of the file: {name, unit, sign, offset [SI]}; null omits it")
    usual = dataclasses.asdict(Column())
    for name, column in columns.items():
        entry = {k: v for k, v in dataclasses.asdict(column).items() if k != "why" and v != usual[k]}
        written = yaml.safe_dump({name: entry or None}, **options).strip()[1:-1]
        lines.append(f"  {'# ' * (name in doubted)}{written}" + (f"  # guessed: {column.why}" if column.why else ""))
    return "\n".join([*(f"# doubtful: {one}" for one in doubts), *lines]) + "\n"
