"""Absolute deadlines, their statistics, and their clock."""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from time import monotonic, sleep
from typing import Protocol

import numpy as np

from op3.common.settings import CONTROL_PERIOD

PERIOD = CONTROL_PERIOD
"""Period of the control loop [s]."""

POLICY_TICKS = 4
"""Ticks per policy step: 31.25 Hz (paper Sec. robot setup)."""


class Clock(Protocol):
    """A clock in seconds since a fixed instant; all waiting in this package uses it."""

    def now(self) -> float:
        """The time [s]; it never decreases."""
        ...

    def sleep_until(self, time: float) -> None:
        """Wait until `now` is at least this time [s]; return at once if it has passed."""
        ...


class MonotonicClock:
    """The machine's monotonic clock. Waiting yields the processor instead of spinning."""

    def now(self) -> float:
        """Monotonic time [s]."""
        return monotonic()

    def sleep_until(self, time: float) -> None:
        """Wait until a time [s]."""
        while (remaining := time - monotonic()) > 0:
            sleep(remaining)


@dataclass(frozen=True)
class Tick:
    """One deadline: its number, counting skipped ones, its time [s, clock], and its lateness [s]."""

    index: int
    deadline: float
    lateness: float


@dataclass(frozen=True)
class Timing:
    """Statistics of the deadlines.

    Attributes:
        ticks: number of ticks that were run.
        misses: number of ticks that were skipped because their time had passed.
        p50: median lateness [s]; `p99` and `max` are the 99 % quantile and the maximum.
    """

    ticks: int = 0
    misses: int = 0
    p50: float = 0.0
    p99: float = 0.0
    max: float = 0.0

    def __str__(self) -> str:
        late = "p50 {:.2f} ms, p99 {:.2f} ms, max {:.2f} ms".format(*(1e3 * t for t in (self.p50, self.p99, self.max)))
        return f"{self.ticks} ticks, {self.misses} missed; lateness {late}"


class Ticker:
    """Deadlines at integer multiples of the period after the first tick.

    Waiting for the next tick never shifts the later ones. Deadlines that passed while a tick ran are skipped and
    counted, so that a slow tick is not followed by a burst of fast ones.
    """

    def __init__(self, clock: Clock):
        self.misses = 0
        self._clock = clock
        self._start = clock.now()
        self._index = -1
        self._lateness = array("d")

    def wait(self) -> Tick:
        """Sleep until the next deadline that is not late by a whole period."""
        self._index += 1
        behind = int((self._clock.now() - self._deadline) / PERIOD)
        if behind > 0:
            self._index += behind
            self.misses += behind
        self._clock.sleep_until(self._deadline)
        lateness = max(0.0, self._clock.now() - self._deadline)
        self._lateness.append(lateness)
        return Tick(self._index, self._deadline, lateness)

    @property
    def _deadline(self) -> float:
        return self._start + self._index * PERIOD

    def timing(self, last: int | None = None) -> Timing:
        """Statistics of all ticks so far, or of the last ones; `ticks` and `misses` count all."""
        chosen = self._lateness if last is None else self._lateness[-last:]
        values = np.array(chosen) if len(chosen) else np.zeros(1)
        p50, p99 = np.percentile(values, [50, 99])
        return Timing(len(self._lateness), self.misses, float(p50), float(p99), float(values.max()))
