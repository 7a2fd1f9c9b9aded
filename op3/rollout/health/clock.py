"""Checks of the clock."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import (
    ERROR,
    FORCE,
    ORIENTATION,
    POSITION,
    RATE,
    VELOCITY,
    WARNING,
    LogFinding,
    View,
    check,
)
from op3.rollout.health.match import delayed, fitted, longest_run
from op3.rollout.validate import GAP, holes

RATE_TOLERANCE = 0.06
"""Largest relative difference between the clock and the metadata's rate."""

CHANGE = 1.8
"""No recorder's usual interval at the end is so many times that at the beginning, or the other way round."""

SLOWEST, FASTEST = 2.0, 20e3
"""No log of a robot has fewer rows per second, or more [Hz]."""

_UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}

LONGEST, AHEAD = 1.0, -1.0
"""A position follows its command by at most so long [s], and one so far ahead of it is looked for."""

USUAL = 0.2
"""Servos follow their commands by at most so long [s], or so slowly that no one delay explains it."""

_SPLIT = "split the file there, or write `split: true` into its YAML to read the parts"


@check("time jumps")
def jumps(view: View) -> Iterator[LogFinding]:
    """The clock was set during the recording, or rows are missing."""
    for row in holes(view.time)[:3]:
        before, now = view.time[row - 1], view.time[row]
        text = f"time jumps from {before:.10g} s to {now:.10g} s"
        if now - before > 60 or _goes_on(view, int(row)):
            text += " while the motion goes on: the clock was set here"
        else:
            missing = round(float(now - before) / view.interval) - 1
            text += f": about {missing} rows are missing, and nothing can be computed across the hole"
        yield view.found(ERROR, "time", text, _SPLIT, row)


def _goes_on(view: View, row: int) -> bool:
    """Whether the joints move across a jump no further than from row to row beside it, while they move."""
    table = np.concatenate([view.position, view.command], axis=1)
    near = np.abs(np.diff(table[max(0, row - 11) : row + 10], axis=0))
    across, usual = np.abs(table[row] - table[row - 1]).sum(), np.median(near.sum(1))
    return bool(usual > 1e-3 and across < 3 * usual)


@check("rate")
def rate(view: View) -> Iterator[LogFinding]:
    """The rows come at another rate than the metadata says, or at one that no robot has."""
    if len(view.time) < 3:
        return
    steps, said = np.diff(view.time), view.metadata.rate
    row, unit, remedy = 1, None, "correct the rate or the time"
    # The mean suits a clock that alternates between two intervals, the median one with gaps.
    if min(abs(view.interval * said - 1), abs(float(steps.mean()) * said - 1)) > RATE_TOLERANCE:
        problem = f"the median interval of {view.interval:.6g} s is {1 / view.interval:.6g} Hz, but the metadata says "
        problem += f"rate: {said:g} Hz"
        unit = next((name for scale, name in _UNITS.items() if 0.5 < view.interval * said / scale < 2), None)
        row = int(np.argmax(np.abs(steps * said - 1) > RATE_TOLERANCE)) + 1
        interval = next(
            (name for s, name in {1.0: "seconds", **_UNITS}.items() if 0.9 < view.interval * s / said < 1.1), None
        )
        if interval:
            remedy = f"that is the interval in {interval}; write rate: {1 / view.interval:.4g}"
    elif not SLOWEST < 1 / view.interval < FASTEST:
        problem = f"the median interval of {view.interval:.6g} s is that of no robot"
        unit = next((name for scale, name in _UNITS.items() if SLOWEST < scale / view.interval < FASTEST), None)
        fast = {1e-3: ("a thousand", "milliseconds"), 1e-6: ("a million", "seconds")}
        for times, read in (how for size, how in fast.items() if SLOWEST < size / view.interval < FASTEST):
            remedy = f"the clock runs {times} times too fast, as if {read} had been read as microseconds; name "
            remedy += "the unit of the times under `columns:`"
    else:
        return
    remedy = f"the time looks like {unit}, convert it to seconds" if unit else remedy
    if np.all(steps == 1):
        remedy = f"it counts rows{', or ' + unit if unit else ''}: write the time of every row [s]"
    yield view.found(ERROR, "time", problem, remedy, row)


@check("uneven rows")
def uneven(view: View) -> Iterator[LogFinding]:
    """Rows are missing, many intervals are several times the usual one, the rate changes, or rows come in bursts."""
    steps = np.diff(view.time)
    if len(steps) <= 50:
        return
    third = len(steps) // 3
    long, lost = steps > 4 * view.interval, 1 - view.interval * len(steps) / float(steps.sum())
    even = np.abs(steps / view.interval - np.round(steps / view.interval)) < 0.25
    row, remedy = int(steps.argmax()) + 1, "record with a clock that keeps its rate, and look what loses rows"
    if long.mean() > 0.02:
        text = f"{long.sum()} intervals are over four times the usual {view.interval:.4g} s, up to {steps.max():.4g} s"
        yield view.found(WARNING, "time", text, remedy, row)
    elif not 1 / CHANGE < (change := float(np.median(steps[-third:]) / np.median(steps[:third]))) < CHANGE:
        text = f"the intervals become {change:.2g} times as long in the course of the recording"
        yield view.found(WARNING, "time", text, "look whether the clock or the rate was changed", row)
    elif lost > 0.05 and even.mean() > 0.9:
        yield view.found(WARNING, "time", f"about {lost:.0%} of the rows are missing, singly", remedy, row)
    elif (short := float((steps < 0.5 * view.interval).mean())) > 0.05:
        text = f"{short:.0%} of the intervals are shorter than half the usual {view.interval:.4g} s"
        yield view.found(WARNING, "time", text, "stamp rows when they are read, not when they are written", row)
    elif (8.5 if np.quantile(steps, 0.98) > 1.2 * view.interval else 4.5) * view.interval < steps.max() <= GAP:
        # what is longer is a hole
        text = f"about {round(steps.max() / view.interval) - 1} rows are missing before this one"
        yield view.found(WARNING, "time", text, remedy, row)


@check("repeated rows")
def repeated(view: View) -> Iterator[LogFinding]:
    """All sensors keep their numbers while a joint moves: the recorder wrote one reading again and again."""
    same = np.ones(max(len(view.time) - 1, 0), bool)
    for key in (key for key in view.log.channels if key[0] in ("joint", "imu")):
        rows, values = np.flatnonzero(same), view.log.array(key)  # most are told apart by the first
        same[rows] = (values[rows + 1] == values[rows]).all(1)
    first, length = longest_run(same)
    if length < 8 or length * view.interval < 0.15 or length == len(same):
        return
    last = first + length
    steps = np.abs(np.diff(view.position, axis=0)).sum(1)
    out = max((steps[row] for row in (first - 1, last) if 0 <= row < len(steps)), default=0.0)
    moving = np.median(steps[steps > 0]) if steps.any() else np.inf
    velocity = view.get(VELOCITY)
    speed = 0.0 if velocity is None else float(np.abs(velocity[first]).max())
    # a servo that rests may keep a speed in its register, and goes on from where it was
    fast = speed > 0.15 and length < 0.9 * len(same) and out > 0.1 * speed * length * view.interval
    heeded = slice(first, max(last - round(0.1 / view.interval), first) + 1)
    told = np.ptp(view.command[heeded], axis=0).max() > 0.02  # else they may all have stood
    if fast or (told and out > max(5 * moving, 0.03 * length * view.interval)):
        problem = f"all sensors keep their numbers for {length + 1} rows, while the robot moves"
        yield view.found(ERROR, "time", problem, "leave these rows out; the recorder had no new reading", first, last)


@check("stale readings")
def stale(view: View) -> Iterator[LogFinding]:
    """A position, or a sensor of the trunk, gets new numbers only in every so many rows: it was read more rarely."""
    remedy = "read it in every row, or record fewer rows"
    trunk = {key: values for key in (ORIENTATION, RATE, FORCE) if (values := view.get(key)) is not None}
    rarely = {key: every for key, values in trunk.items() if (every := _new_in_every(values)) >= 3}
    if rarely and len(rarely) == len(trunk):
        problem = f"the trunk's sensors have new numbers only in every {min(rarely.values())} rows"
        yield view.found(WARNING, "imu", problem, remedy)
    for key, every in rarely.items() if len(rarely) < len(trunk) else ():
        problem = f"the {key[1].replace('_', ' ')} has new numbers only in every {every} rows"
        yield view.found(WARNING, (key, 0), problem, remedy)
    if _new_in_every(view.position) == 2 and np.ptp(view.position, axis=0).max() > 0.2:
        yield view.found(WARNING, "time", "positions have new numbers only in every second row", remedy)
    for key, joint, column in view.columns(POSITION):
        jumps, every = np.diff(column), _new_in_every(column[:, None])
        # a slow joint changes by one step of its encoder at a time
        if every >= 3 and np.median(np.abs(jumps[jumps != 0])) > 4 * view.steps(key)[joint]:
            problem = f"the position has a new number only in every {every} rows"
            yield view.found(WARNING, (key, joint), problem, remedy)


def _new_in_every(values: np.ndarray) -> int:
    """The number of rows that lie between any two of those with new numbers ``[row, name]``; 0 where few have."""
    rows = np.flatnonzero(np.diff(values, axis=0).any(1))
    return int(np.gcd.reduce(np.diff(rows))) if len(rows) >= 20 else 0


@check("two clocks")
def two_clocks(view: View) -> Iterator[LogFinding]:
    """Command and position were stamped by different clocks: their delay is long, or grows."""
    stride = max(1, round(0.02 / view.interval))
    angle, told, period = view.position[::stride], view.command[::stride], stride * view.interval
    third = len(angle) // 3
    if third * period < 1 or view.interval > 0.1:
        return
    first, last, most = slice(0, third), slice(-third, None), third // 2
    lags = np.arange(max(round(AHEAD / period), -most), min(round(LONGEST / period), most))
    ones, remedy = np.ones(len(lags)), "stamp both by one clock, or cut the log into short parts"
    usual = (lags * period > -0.05) & (lags * period < USUAL)

    def best(curve: np.ndarray) -> bool:
        """Whether a delay among these explains nearly all, and no longer one may explain more."""
        return bool(curve[1:-1].min() == curve.min() < 0.05)

    def misfits(*parts: slice) -> dict[int, list[np.ndarray]]:
        """What a position leaves of its command that came so long before ``[lag]``, of the joints that move most."""
        spans = np.min([np.minimum(np.ptp(told[p], axis=0), np.ptp(angle[p], axis=0)) for p in parts], axis=0)
        moving = [int(j) for j in np.argsort(-spans)[:3] if spans[j] > 0.1]
        return {j: [np.maximum(1 - _follows(angle[p, j], told[p, j], lags), 0.0) for p in parts] for j in moving}

    curves = misfits(first, last)
    joint = min(curves, key=lambda j: max(curve.min() for curve in curves[j]), default=0)
    if all(best(curve) for curve in curves.get(joint, [ones])):
        start, end = (curve.argmin() for curve in curves[joint])
        other = all(c[n] > 4 * c.min() + 0.02 for c, n in zip(curves[joint], (end, start), strict=True))
        if other and abs(lags[end] - lags[start]) * period > 0.15:
            problem = f"the position follows the command by {lags[start] * period:.2f} s at the beginning and "
            problem += f"{lags[end] * period:.2f} s at the end: they were stamped by clocks that run apart"
            yield view.found(WARNING, (POSITION, joint), problem, remedy)
            return
    curves = misfits(slice(None))
    joint = min(curves, key=lambda j: curves[j][0].min(), default=0)
    (curve,) = curves.get(joint, [ones])
    if best(curve) and curve[usual].min() > 3 * curve.min():
        lag = float(lags[curve.argmin()] * period)
        if lag > 0 and _as_friction(angle[:, joint], told[:, joint], period) < 4 * curve.min():
            return
        problem = f"the position {'comes before' if lag < 0 else 'follows'} its command by {abs(lag):.2f} s throughout"
        yield view.found(WARNING, (POSITION, joint), f"{problem}: their clocks differ, or one is shifted", remedy)


def _as_friction(angle: np.ndarray, told: np.ndarray, period: float) -> float:
    """What friction in a soft loop, with damping and gravity, leaves of a position, as a share: a delay of slow motions
    is like it. Friction holds a joint until its command is so far away, and then keeps it as far behind."""
    best = np.inf
    for width in np.quantile(np.abs(told - angle), [0.25, 0.5, 0.75, 0.9, 0.97]):
        held, at = np.empty(len(told)), float(angle[0])
        for row, goal in enumerate(told.tolist()):
            held[row] = at = min(max(at, goal - width), goal + width)
        speed = np.gradient(held, period)
        causes = np.stack([held, np.ones(len(held)), speed, np.sin(held), np.cos(held)], axis=1)
        left = angle - causes @ fitted(causes, angle)
        best = min(best, float(left.var() / max(angle.var(), 1e-12)))
    return best


def _follows(angle: np.ndarray, told: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """How well a position follows its command by so many rows, ``[lag]``."""
    return np.array([delayed(angle, told, int(n)) if n >= 0 else delayed(told, angle, -int(n)) for n in lags])
