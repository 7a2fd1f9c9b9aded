"""What an import proposes for a log that nobody has described yet: names, units and signs, and why."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

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


def propose(path: Path, robot: str | None = None) -> tuple[dict[str, Any], dict[str, Column], list[str]]:
    """Metadata, the meaning of every column of a log, and what cannot be known of them.

    Args:
        path: Of the log.
        robot: Name or file of the robot, whose joints the columns are given; None: names stay as they are.
    """
    found = reader_of(path).read(path)[0]
    if not isinstance(found, Recording):
        return found.metadata.to_dict(), {}, []
    known = load_robot(robot) if robot else None
    columns = guess_all([n for stream in found.streams for n in stream.columns], list(called(known)) if known else ())
    columns |= {name: column for name, column in found.columns.items() if name in columns}
    about = {"robot": "real", "mount": "stand", **found.metadata, **read_side(path).metadata}
    if known is not None:
        columns = {name: _of_robot(column, known) for name, column in _by_number(columns, known).items()}
        if not any(column.name and column.name.rpartition(".")[0] in known.joints for column in columns.values()):
            problem = f"it names none of the joints of {known.name}, which are {', '.join(known.joints)}"
            remedy = "give the robot that made it; or import it without robot=, and correct the names in the YAML"
            raise LogError(problem, remedy, source=path)
        there = {column.name.rpartition(".")[0] for column in columns.values() if column.name}
        # its terms are in the columns
        about |= {"joints": [joint for joint in known.joints if joint in there], "robot_file": known.reference}
    about = {name: value for name, value in about.items() if value not in (None, {}, [])}
    return about, columns, [f"{one.problem}; {one.remedy}" for one in found.doubts]


def _by_number(columns: dict[str, Column], robot: Robot) -> dict[str, Column]:
    """The columns with the robot's joints in their order, where the file numbers as many joints as it has."""
    joints = {name: str(column.name).rpartition(".")[0] for name, column in columns.items() if column.name}
    numbers = {joint: found[1] for joint in joints.values() if (found := re.fullmatch(r"(?:[a-z]+_)?(\d+)", joint))}
    if len(numbers) != len(robot.joints) or numbers.keys() & called(robot).keys():
        return columns
    named = dict(zip(sorted(numbers, key=lambda joint: int(numbers[joint])), robot.joints, strict=True))
    why = f"the order of the joints of {robot.name}"
    return columns | {
        name: dataclasses.replace(columns[name], name=str(columns[name].name).replace(joint, named[joint], 1), why=why)
        for name, joint in joints.items()
        if joint in named
    }


def _of_robot(column: Column, robot: Robot) -> Column:
    """The column with the robot's joint, and the sign, zero and unit that the robot's file gives its logs."""
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


def as_yaml(metadata: dict[str, Any], columns: dict[str, Column], doubts: Sequence[str] = ()) -> str:
    """The text of the YAML that lies beside the log, for the user to correct."""
    options: dict[str, Any] = dict(default_flow_style=True, width=10**9, allow_unicode=True, sort_keys=False)
    lines = [yaml.safe_dump({name: value}, **options).strip()[1:-1] for name, value in metadata.items()]
    if columns:
        lines.append("columns:  # column of the file: {name, unit, sign, offset [SI]}; null leaves it out")
    usual = dataclasses.asdict(Column())
    for name, column in columns.items():
        entry = {k: v for k, v in dataclasses.asdict(column).items() if k != "why" and v != usual[k]}
        written = yaml.safe_dump({name: entry or None}, **options).strip()[1:-1]
        lines.append(f"  {written}" + (f"  # guessed: {column.why}" if column.why else ""))
    return "\n".join([*(f"# doubtful: {one}" for one in doubts), *lines]) + "\n"
