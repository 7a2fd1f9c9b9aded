"""What a reader of a log format is, and what it hands over.

A reader is a small class that says which paths are its own and what is in them: columns by their names in the
file, each group with its clock, and what the format itself says about them. Naming, units, resampling, options
of the import, checks and the building of a `Rollout` are the same for all formats (`op3.rollout.importing`).
Another package adds a format by an entry point of the group `op3.readers` that names such a class.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from op3.common.settings import Number, settings
from op3.rollout.errors import LogError
from op3.rollout.finding import LogFinding
from op3.rollout.rollout import Rollout


@settings("the entry")
class Column:
    """What a column of a file means: the SI value is ``sign * size of the unit * number + offset``.

    Attributes:
        name: Column of the wide CSV (`elbow.position`, `imu.gyro_x`, `time`); None where it is left out.
        unit: Name of a unit, or its size in the SI unit; None for the SI unit.
        sign: 1 or -1.
        offset: Added at the end, in the SI unit.
        why: What the meaning was guessed from; empty where the file or the user says it.
    """

    name: str | None = None
    unit: str | Number | None = None
    sign: Literal[1, -1] = 1
    offset: Number = 0.0
    why: str = ""


@dataclass(frozen=True)
class Stream:
    """Columns that share a clock.

    Attributes:
        time: Time of each row [time] in s, where no column means `time`.
        columns: Numbers by the column's name in the file, each [time].
    """

    time: np.ndarray
    columns: dict[str, np.ndarray]


@dataclass
class Recording:
    """What a file holds, before names and units are ours.

    Attributes:
        streams: The first gives the rows; the others are brought onto its clock, their delay kept.
        metadata: Fields of `Metadata` that the file tells.
        columns: Meaning of columns where the format tells or hints at it, by their names in the file.
        name: Identity of the recording; the file's name where empty.
        strict: Whether the YAML beside it must be there, and a column without a meaning is refused, not left out.
        doubts: What the reader guessed and cannot know; one about a column lasts until the YAML says what that is.
    """

    streams: list[Stream]
    metadata: dict[str, Any] = field(default_factory=dict)
    columns: dict[str, Column] = field(default_factory=dict)
    name: str = ""
    strict: bool = False
    doubts: Sequence[LogFinding] = ()


def needed(module: str, extra: str, path: Path) -> Any:
    """A module of a package that not everybody has; refused with what installs it where it is missing."""
    try:
        return import_module(module)
    except ImportError:
        problem = f"reading it needs the package {module.partition('.')[0]}, which is missing"
        raise LogError(problem, f"install it with `pip install 'op3[{extra}]'`", source=path) from None


class Reader(Protocol):
    """A log format.

    Attributes:
        title: Name of the format, for the table of formats.
        paths: What a path of it looks like, for the table and for messages.
    """

    title: str
    paths: str

    def claims(self, path: Path) -> bool:
        """Whether an existing path is of this format, by its name or a look at its beginning; never raises."""
        ...

    def read(self, path: Path) -> Sequence[Recording | Rollout]:
        """The recordings in it, one per episode; raises `LogError` with one sentence."""
        ...
