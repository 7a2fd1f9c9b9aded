"""Absolute deadlines on an injected clock."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from op3.deploy.ticker import PERIOD, Ticker


class StandingClock:
    """Time that passes only when someone sleeps or says so."""

    def __init__(self, start: float = 0.0):
        self.time = start

    def now(self) -> float:
        return self.time

    def sleep_until(self, time: float) -> None:
        self.time = max(self.time, time)


@given(st.lists(st.floats(0.0, 0.0079), min_size=1, max_size=200), st.floats(0, 1e6))
def test_work_does_not_shift_deadlines(work, start):
    """Whatever a tick takes, as long as it is less than a period, tick k begins at start + 8 ms k exactly."""
    clock = StandingClock(start)
    ticker = Ticker(clock)
    for index, duration in enumerate(work):
        tick = ticker.wait()
        assert tick.index == index
        assert clock.time == max(clock.time, start + index * PERIOD)
        assert tick.lateness < 1e-9 * max(start, 1)
        clock.time += duration
    assert ticker.misses == 0


def test_missed_deadlines_are_skipped():
    """A tick of 30 ms loses the three deadlines that passed, and the next one is on the old grid."""
    clock = StandingClock()
    ticker = Ticker(clock)
    assert ticker.wait().index == 0
    clock.time += 0.030
    late = ticker.wait()
    # Deadlines 8, 16 and 24 ms: the last of them is 6 ms late and is run, the two before are lost.
    assert late.index == 3
    assert late.lateness == pytest.approx(0.006)
    assert ticker.misses == 2
    assert ticker.wait().deadline == pytest.approx(0.032)


def test_statistics():
    """Of 200 ticks, four 1 ms late: median 0, p99 and maximum 1 ms."""
    clock = StandingClock()
    ticker = Ticker(clock)
    for index in range(200):
        tick = ticker.wait()
        clock.time = tick.deadline + (0.009 if index % 50 == 10 else 0.001)
    timing = ticker.timing()
    assert (timing.ticks, timing.misses) == (200, 0)
    assert timing.p50 == pytest.approx(0.0, abs=1e-9)
    assert timing.p99 == pytest.approx(0.001, rel=0.01)
    assert timing.max == pytest.approx(0.001)
