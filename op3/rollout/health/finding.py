"""What a check of a log finds, and the registry of checks."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsInt

import numpy as np

from op3.robot.servo_make import ServoMake, find_servo
from op3.rollout.errors import LogError
from op3.rollout.health.match import step
from op3.rollout.schema import CHANNELS, Key, column_names

if TYPE_CHECKING:
    from op3.rollout.rollout import Rollout

POSITION, COMMAND = ("joint", "position"), ("command", "position")
VELOCITY, CURRENT = ("joint", "velocity"), ("joint", "current")
ORIENTATION, RATE, FORCE = ("imu", "orientation"), ("imu", "angular_velocity"), ("imu", "linear_acceleration")

ERROR, WARNING = "error", "warning"
"""An error cannot be right and refuses the log; a warning is suspicious and lets it pass."""


@dataclass(frozen=True)
class LogFinding:
    """Something about a log that is wrong or suspicious.

    Attributes:
        severity: `error` or `warning`.
        problem: Evidence with its numbers, and the likely cause.
        remedy: How to correct it, an option of the import where there is one.
        column: Column of the wide CSV, `time`, or a metadata field (`field mass`); None for the whole log.
        rows: First and last row concerned, counted from 1; None for all.
        times: Times of these rows [s].
        set_aside: Whether the column is not to be used, while the rest of the log is.
        check: Name of the check.
    """

    severity: str
    problem: str
    remedy: str
    column: str | None = None
    rows: tuple[int, int] | None = None
    times: tuple[float, float] | None = None
    set_aside: bool = False
    check: str = ""

    def error(self, source: str | Path | None) -> LogError:
        """As the error that refuses the log."""
        row = None if self.rows is None else self.rows[0]
        return LogError(self.problem, self.remedy, source=source, column=self.column, row=row)

    def row(self) -> dict[str, Any]:
        """As a row of a table, in plain values."""
        joint, _, channel = (self.column or "").rpartition(".")
        rows = "" if self.rows is None else "-".join(str(row) for row in dict.fromkeys(self.rows))
        times = "" if self.times is None else " to ".join(f"{t:.6g}" for t in dict.fromkeys(self.times))
        where = {"joint": joint, "channel": channel, "rows": rows, "times [s]": times}
        severity = "set aside" if self.set_aside else self.severity
        return {"severity": severity, **where, "finding": self.problem, "remedy": self.remedy}


class View:
    """One episode of a log as the checks look at it."""

    def __init__(self, log: Rollout):
        self.log, self.metadata, self.joints = log, log.metadata, log.joints
        self.time, self.position = log.array("time")[:, 0], log.array(POSITION)
        self.command = log.array(COMMAND)
        switch = self.get(("command", "torque_enable"))
        self.driven = np.ones(self.command.shape, bool) if switch is None else switch == 1
        gain = self.get(("command", "p_gain"))
        self.driven &= True if gain is None else gain != 0
        """Whether the servo drives, towards its target [time, joint]."""
        self.interval = float(np.median(np.diff(self.time))) if len(self.time) > 1 else np.inf
        """Usual time from row to row [s]."""
        self._steps: dict[Key, np.ndarray] = {}

    @cached_property
    def make(self) -> ServoMake | None:
        """The make of servo that the metadata name; None where none is known."""
        return find_servo(self.metadata.servo)

    @property
    def position_unit(self) -> float:
        """Step in which the servo's encoder tells angles, that of 4096 a turn where the make is unknown [rad]."""
        return 2 * np.pi / 4096 if self.make is None else self.make.position_unit

    @cached_property
    def duty_gain(self) -> np.ndarray | None:
        """Duty per angle [1/rad] of servos that close the loop themselves [time, joint]; None where it is unknown."""
        gain = self.get(("command", "firmware_gain"))
        law = None if self.make is None or self.make.loop != "firmware" else self.make.position_law
        return None if law is None or gain is None else gain * law.error_gain.si

    def get(self, key: Key) -> np.ndarray | None:
        """A channel [time, name], None where it is absent."""
        return self.log.array(key) if key in self.log else None

    def steps(self, key: Key) -> np.ndarray:
        """Step of the grid on which a channel's columns lie ``[name]``, see `step`; worked out once."""
        if key not in self._steps:
            self._steps[key] = step(self.log.array(key))
        return self._steps[key]

    def columns(self, *keys: Key) -> Iterator[tuple[Key, int, np.ndarray]]:
        """Key, index and numbers [time] of the columns of those channels that are there, in a log of some length."""
        for key in keys if len(self.time) >= 20 else ():
            values = self.get(key)
            yield from ((key, index, column) for index, column in enumerate(() if values is None else values.T))

    def name(self, key: Key, index: SupportsInt) -> str:
        """Name of one column of a channel."""
        return column_names(CHANNELS[key], self.joints, int(index) + 1)[int(index)]

    def found(
        self,
        severity: str,
        where: str | tuple[Key, SupportsInt],
        problem: str,
        remedy: str,
        *rows: SupportsInt,
        aside: bool = False,
    ) -> LogFinding:
        """A finding.

        Args:
            severity: `ERROR` or `WARNING`.
            where: Column of the wide CSV, or its channel and index.
            problem: See `LogFinding`.
            remedy: The same.
            rows: The row, or the first and the last, counted from 0; none for all.
            aside: Whether the column is not to be used.
        """
        column = where if isinstance(where, str) else self.name(*where)
        span = (int(rows[0]), int(rows[-1])) if rows else None
        times = (float(self.time[span[0]]), float(self.time[span[1]])) if span else None
        counted = (span[0] + 1, span[1] + 1) if span else None
        return LogFinding(severity, problem, remedy, column, counted, times, aside)


Check = Callable[[View], Iterable[LogFinding]]

CHECKS: dict[str, Check] = {}
"""Every check by its name; a check's docstring is its line in the documentation."""


UNLESS: dict[str, tuple[str, ...]] = {}
"""Checks before a check that explain what it would find: where one of them found something it says nothing."""


def check(name: str, unless: tuple[str, ...] = ()) -> Callable[[Check], Check]:
    """Enter a check into the registry; see `UNLESS`."""

    def enter(function: Check) -> Check:
        CHECKS[name], UNLESS[name] = function, unless
        return function

    return enter


def examine(log: Rollout) -> tuple[LogFinding, ...]:
    """Everything that the checks find in a log, errors first."""
    with np.errstate(all="ignore"):  # what overflows is refused by its bound
        found = [finding for episode in log.episodes() for finding in _findings(View(episode))]
    return tuple(sorted(found, key=lambda finding: finding.severity != ERROR))


def told_together(findings: Sequence[LogFinding]) -> list[LogFinding]:
    """What is found alike in several joints, told once: where it differs in its numbers only, it has one cause."""
    alike: dict[tuple, list[LogFinding]] = {}
    for number, one in enumerate(findings):
        joint, _, channel = (one.column or "").rpartition(".")
        words = tuple(re.sub(r"(?<!\w)-?\d[\d.e+-]*", "#", text) for text in (one.problem, one.remedy))
        key = (one.check, one.severity, one.set_aside, channel, *words) if joint else (number,)
        alike.setdefault(key, []).append(one)
    told = []
    for first, *others in alike.values():
        joints = ", ".join(dict.fromkeys((one.column or "").rpartition(".")[0] for one in others))
        told.append(replace(first, problem=f"{first.problem} (also in {joints})") if others else first)
    return told


def _findings(view: View) -> Iterator[LogFinding]:
    aside = {finding.column for finding in view.log.findings if finding.set_aside}
    told: set[str] = set()
    for name, function in CHECKS.items():
        wrong_clock = False
        if told.intersection(UNLESS[name]):
            continue
        for finding in function(view):
            if finding.column in aside:
                continue  # why it is not used has been said
            if finding.set_aside:
                aside.add(finding.column)
            wrong_clock |= finding.severity == ERROR and finding.column == "time"
            told.add(name)
            yield replace(finding, check=name)
        if wrong_clock:
            return  # rates and delays by a wrong clock say nothing
