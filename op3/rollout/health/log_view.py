"""One episode of a log with quantities that several checks use, and the registry of checks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, SupportsInt

import numpy as np

from op3.robot.robot import Robot
from op3.robot.servo_make import ServoMake, find_servo
from op3.rollout.errors import LogError
from op3.rollout.finding import ERROR, WARNING, LogFinding
from op3.rollout.keys import COMMAND, CURRENT, DUTY, FIRMWARE_GAIN, P_GAIN, POSITION, SWITCH, VELOCITY, VOLTAGE
from op3.rollout.match import OVERLAP, Match, integral, match, step, windows
from op3.rollout.schema import CHANNELS, Key, column_names

if TYPE_CHECKING:
    from op3.rollout.rollout import Rollout

Where = str | tuple[Key, SupportsInt]


class View:
    """One episode of a log with quantities that several checks use."""

    def __init__(self, log: Rollout):
        self.log, self.metadata, self.joints = log, log.metadata, log.joints
        self.time, self.position, self.command = log.array("time")[:, 0], log.array(POSITION), log.array(COMMAND)
        self.error = self.position - self.command
        """Position minus target [time, joint]."""
        switch, gain = self.get(SWITCH), self.get(P_GAIN)
        self.off = np.zeros(self.command.shape, bool) if switch is None else switch == 0
        """Whether the servo is switched off according to the log [time, joint]."""
        self.driven = ~self.off if gain is None else ~self.off & (gain != 0)
        """Whether the servo drives towards its target [time, joint]."""
        self.interval = float(np.median(np.diff(self.time))) if len(self.time) > 1 else np.inf
        """Usual interval between rows [s]."""
        self._steps: dict[Key, np.ndarray] = {}

    @cached_property
    def make(self) -> ServoMake | None:
        """The make of servo in the metadata; None if unknown."""
        return find_servo(self.metadata.servo)

    @property
    def position_unit(self) -> float:
        """Step of the servo's encoder [rad]; for an unknown make, 4096 per turn."""
        return 2 * np.pi / 4096 if self.make is None else self.make.position_unit

    @cached_property
    def speed(self) -> np.ndarray:
        """Change of position per second [time, joint]; needs at least two rows."""
        return np.gradient(self.position, self.time, axis=0)

    @cached_property
    def duty_gain(self) -> np.ndarray | None:
        """Duty per angle [1/rad] of servos that close the loop themselves [time, joint]; None if unknown."""
        gain = self.get(FIRMWARE_GAIN)
        law = None if self.make is None or self.make.loop != "firmware" else self.make.position_law
        return None if law is None or gain is None else gain * law.error_gain.si

    @property
    def drives(self) -> list[tuple[Key, np.ndarray, np.ndarray | None]]:
        """Key, values [time, joint] and gain [time, joint] of recorded currents and duties; an unknown gain is None."""
        gains = {CURRENT: self.get(P_GAIN), DUTY: self.duty_gain}
        return [(key, self.log.array(key), gain) for key, gain in gains.items() if key in self.log]

    @cached_property
    def robot(self) -> Robot | None:
        """The robot in the metadata; None if there is none, or its file does not exist."""
        try:
            return self.log.named_robot if self.metadata.robot_file else None
        except LogError:  # the check of the robot reports this error
            return None

    @cached_property
    def stiffness(self) -> np.ndarray:
        """Torque per angle of each joint's position loop [N m/rad]; NaN where its servo or its gain is unknown."""
        stiffness = np.full(len(self.joints), np.nan)
        for joint, make in enumerate(self.log.servos):
            gain = self.get(P_GAIN if make is not None and make.loop == "current" else FIRMWARE_GAIN)
            if make is not None and gain is not None:
                stiffness[joint] = np.median(gain[:, joint]) * make.stiffness(self.supply(joint))
        return stiffness

    def supply(self, joint: int | slice = slice(None)) -> float | None:
        """Median voltage measured by one joint's servo or all servos, or the bench's supply [V]; None if unknown."""
        volts, bench = self.get(VOLTAGE), self.metadata.mount == "pendulum"
        measured = 0.0 if volts is None else float(np.median(volts[:, joint]))
        return measured or (self.metadata.battery if bench else None)

    @cached_property
    def windows(self) -> tuple[np.ndarray, np.ndarray, float]:
        """See `match.windows`."""
        return windows(self.time)

    @property
    def long(self) -> bool:
        """Whether there are enough windows for meaningful correlations."""
        return len(self.windows[0]) >= 4 * OVERLAP

    def turned(self, angles: np.ndarray) -> np.ndarray:
        """Change of angles [time, name] within each window [window, name]."""
        first, last, _ = self.windows
        return angles[last] - angles[first]

    def summed(self, rates: np.ndarray) -> np.ndarray:
        """Integral of rates [time, name] over each window [window, name]."""
        return self.turned(integral(self.time, rates))

    @cached_property
    def rates(self) -> Match | None:
        """Match of velocities integrated over windows with position changes; None without velocities or few windows."""
        rate = self.get(VELOCITY)
        if rate is None or len(self.time) < 20 or not self.long:
            return None
        return match(self.summed(rate), self.turned(self.position))

    def stride(self, period: float) -> int:
        """Number of rows in a period [s], at least one."""
        return max(1, round(period / self.interval)) if len(self.time) >= 20 else 1

    def thinned(self, period: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
        """Positions, targets and whether joints are driven [row, joint], resampled to about this period [s], and the
        number of original rows per new row."""
        stride = self.stride(period)
        return self.position[::stride], self.command[::stride], self.driven[::stride], stride

    def get(self, key: Key) -> np.ndarray | None:
        """A channel [time, name]; None if absent."""
        return self.log.array(key) if key in self.log else None

    def steps(self, key: Key) -> np.ndarray:
        """Resolution of a channel's columns ``[name]``, see `step`; cached."""
        if key not in self._steps:
            self._steps[key] = step(self.log.array(key))
        return self._steps[key]

    def columns(self, *keys: Key) -> Iterator[tuple[Key, int, np.ndarray]]:
        """Key, index and values [time] of the columns of the existing channels, in a log of at least 20 rows."""
        for key in keys if len(self.time) >= 20 else ():
            values = self.get(key)
            yield from ((key, index, column) for index, column in enumerate(() if values is None else values.T))

    def name(self, key: Key, index: SupportsInt) -> str:
        """Name of one column of a channel."""
        return column_names(CHANNELS[key], self.joints, int(index) + 1)[int(index)]

    def found(
        self, where: Where, problem: str, remedy: str, *rows: SupportsInt, aside: bool = False, error: bool = False
    ) -> LogFinding:
        """A problem in a column (name in the wide CSV, or channel and index), in one row or a range of rows counted
        from 0. With `aside` the column is excluded, as the remedy states; with `error` the log is refused."""
        remedy += "; until then, the channel is not used" if aside else ""
        column = where if isinstance(where, str) else self.name(*where)
        first, last = (int(rows[0]), int(rows[-1])) if rows else (0, 0)
        at = ((first + 1, last + 1), (float(self.time[first]), float(self.time[last]))) if rows else (None, None)
        return LogFinding(ERROR if error else WARNING, problem, remedy, column, *at, aside)


Found = Iterator[LogFinding]
Find = Callable[[View], Found]


class LogCheck(NamedTuple):
    """A check, documented by the docstring of its function. It runs if the log has the required channels and number of
    rows, unless an earlier check named in `unless` has reported a problem."""

    find: Find
    needs: tuple[Key, ...]
    rows: int
    unless: tuple[str, ...]


CHECKS: dict[str, LogCheck] = {}
"""Every check by name, in the order of execution."""


def check(name: str, *needs: Key, rows: int = 0, unless: str = "") -> Callable[[Find], Find]:
    """Register a check; see `LogCheck`. The names in `unless` are separated by commas."""

    def enter(find: Find) -> Find:
        CHECKS[name] = LogCheck(find, needs, rows, tuple(unless.split(", ")))
        return find

    return enter


def examine(log: Rollout) -> tuple[LogFinding, ...]:
    """All problems that the checks report in a log, errors first."""
    with np.errstate(all="ignore"):  # the bounds reject values that overflow
        found = [finding for episode in log.episodes() for finding in _findings(View(episode))]
    return tuple(sorted(found, key=lambda finding: finding.severity != ERROR))


def _findings(view: View) -> Found:
    aside, explained = {finding.column for finding in view.log.findings if finding.set_aside}, set[str]()
    for name, one in CHECKS.items():
        wrong_clock = False
        if explained.intersection(one.unless) or len(view.time) < one.rows or any(k not in view.log for k in one.needs):
            continue
        for finding in one.find(view):
            if finding.column in aside:
                continue  # its exclusion has been reported
            if finding.set_aside:
                aside.add(finding.column)
            wrong_clock |= finding.severity == ERROR and finding.column == "time"
            explained.add(name)
            yield replace(finding, check=name)
        if wrong_clock:
            return  # rates and delays are meaningless with a wrong clock
