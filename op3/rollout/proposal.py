"""What an import proposes for a log that nobody has described yet: names, units and signs, and why."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import yaml

from op3.robot import load_robot
from op3.rollout.errors import LogError
from op3.rollout.guess import guess_all
from op3.rollout.importing import place, read_side
from op3.rollout.read import find_reader
from op3.rollout.readers.csv_table import recording as csv_recording
from op3.rollout.readers.reader import Column, Recording
from op3.rollout.readers.text import ending

_TURNED = {"target": 1.0, "position": 1.0, "velocity": 1.0, "current": 0.0, "duty": 0.0, "load": 0.0}
"""Channels that take the sign of a joint's log, and whether its unit of angle applies to them."""


def propose(path: Path, robot: str | None = None) -> tuple[dict[str, Any], dict[str, Column]]:
    """Metadata and the meaning of every column of a log.

    Args:
        path: Of the log.
        robot: Name or file of the robot, whose joints the columns are given; None: names stay as they are.
    """
    reader = find_reader(path)
    if reader is None:
        raise LogError("no reader knows this log", "name a file or folder of a known format", source=path)
    found = csv_recording(path) if ending(path) == ".csv" else reader.read(path)[0]
    if not isinstance(found, Recording):
        return found.metadata.to_dict(), {}
    known = load_robot(robot) if robot else None
    names = {known.log_channel(joint)[0].name or joint: joint for joint in known.joints} if known else {}
    columns = guess_all([n for stream in found.streams for n in stream.columns], list(names))
    columns = {name: found.columns.get(name, column) for name, column in columns.items()}
    if known is not None:
        columns = {name: _of_robot(column, known, names) for name, column in columns.items()}
    about = {**{"robot": "real", "mount": "stand"}, **found.metadata, **read_side(path).metadata}
    if known is not None:
        about["joints"] = list(known.joints)
    return {name: value for name, value in about.items() if value not in (None, {}, [])}, columns


def _of_robot(column: Column, robot: Any, names: dict[str, str]) -> Column:
    """The column with the robot's joint, and the sign, zero and unit that the robot's file gives its logs."""
    known = place(column.name) if column.name else None
    if known is None or known[0].axes != "joint" or known[1] not in names:
        return column
    joint = names[known[1]]
    name = known[0].column.format(joint=joint)
    channel, unit = robot.log_channel(joint)
    kind = str(column.name).rpartition(".")[2]
    if kind not in _TURNED or column.unit is not None:
        return dataclasses.replace(column, name=name)
    size = unit * (channel.velocity_factor if kind == "velocity" else 1.0) if _TURNED[kind] else 1.0
    offset = -channel.sign * channel.zero * unit if kind in ("position", "target") else 0.0
    why = column.why or f"the file of {robot.name}"
    return Column(name, None if size == 1.0 else size, channel.sign, offset + 0.0, why)


def as_yaml(metadata: dict[str, Any], columns: dict[str, Column]) -> str:
    """The text of the YAML that lies beside the log, for the user to correct."""
    options: dict[str, Any] = dict(default_flow_style=True, width=10**9, allow_unicode=True, sort_keys=False)
    lines = [yaml.safe_dump({name: value}, **options).strip()[1:-1] for name, value in metadata.items()]
    if columns:
        lines.append("columns:  # column of the file: {name, unit, sign, offset [SI]}; null leaves it out")
    for name, column in columns.items():
        entry = {k: v for k, v in dataclasses.asdict(column).items() if k != "why" and v not in (None, 0.0)}
        if entry.get("sign") == 1:
            del entry["sign"]
        written = yaml.safe_dump({name: entry or None}, **options).strip()[1:-1]
        lines.append(f"  {written}" + (f"  # guessed: {column.why}" if column.why else ""))
    return "\n".join(lines) + "\n"
