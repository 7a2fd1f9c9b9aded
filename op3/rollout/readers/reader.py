"""The interface of a log format's reader, and its result.

A reader is a small class that claims paths and returns their content: columns by their names in the file, in groups
with a common clock, and the meanings that the format defines. Naming, units, resampling, import options, checks and the
construction of a `Rollout` are common to all formats (`op3.rollout.importing`). Another package adds a format with an
entry point in the group `op3.readers` that names such a class.
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
    """Meaning of a column of a file: the SI value is ``sign * size of the unit * number + offset``.

    Attributes:
        name: Column of the wide CSV (`elbow.position`, `imu.gyro_x`, `time`); None if it is omitted.
        unit: Name of a unit, or its size in SI units; None for the SI unit.
        sign: 1 or -1.
        offset: Value added last, in the SI unit.
        why: Reason for a guessed meaning; empty if the file or the user states the meaning.
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
        time: Time of each row [time] in s, if no column means `time`.
        columns: Numbers by the column's name in the file, each [time].
    """

    time: np.ndarray
    columns: dict[str, np.ndarray]


@dataclass
class Recording:
    """Content of a file, before names and units are converted.

    Attributes:
        streams: The first stream defines the rows; the others are resampled to its times with unchanged delay.
        metadata: Fields of `Metadata` that the file states.
        columns: Meanings of columns by name in the file, if the format states or suggests them.
        name: Identifier of the recording; empty: the file's name.
        strict: Whether a YAML is required, and a column without a meaning is an error instead of omitted.
        doubts: Guesses of the reader; a doubt about a column lasts until the YAML describes the column.
    """

    streams: list[Stream]
    metadata: dict[str, Any] = field(default_factory=dict)
    columns: dict[str, Column] = field(default_factory=dict)
    name: str = ""
    strict: bool = False
    doubts: Sequence[LogFinding] = ()


def needed(module: str, extra: str, path: Path) -> Any:
    """A module of an optional package; if it is missing, the error states how to install it."""
    try:
        return import_module(module)
    except ImportError:
        problem = f"reading the file needs the package {module.partition('.')[0]}, which is not installed"
        raise LogError(problem, f"install it with `pip install 'op3[{extra}]'`", source=path) from None


class Reader(Protocol):
    """A log format.

    Attributes:
        title: Name of the format, for the table of formats.
        paths: Example of a path, for the table and for messages.
    """

    title: str
    paths: str

    def claims(self, path: Path) -> bool:
        """Whether an existing path has this format, judged by name or first bytes; never raises an error."""
        ...

    def read(self, path: Path) -> Sequence[Recording | Rollout]:
        """The recordings in a path, one per episode; raises `LogError` with one sentence."""
        ...
