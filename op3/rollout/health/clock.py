"""Checks of the clock."""

from __future__ import annotations

import numpy as np

from op3.rollout.health.log_view import Found, View, check
from op3.rollout.keys import FORCE, ORIENTATION, POSITION, RATE, VELOCITY
from op3.rollout.match import delays, longest_run, unexplained
from op3.rollout.validate import GAP, holes

_TOLERANCE = 0.06  # largest accepted relative difference between the clock and the metadata's rate
_CHANGE = 1.8  # smallest ratio between the usual intervals at the two ends that is reported
_SLOWEST, _FASTEST = 2.0, 20e3  # plausible range of the row rate of a robot log [Hz]
_UNITS = {1.0: "seconds", 1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}
_AHEAD, _LONGEST = -1.0, 1.0  # range of searched delays of a position after its command [s]
_USUAL = 0.2  # longest constant delay with which servos follow commands [s]; slower servos have no constant delay
_SPLIT = "split the file there, or write `split: true` into the log's YAML to read its parts"


def _unit(times: float, least: float, most: float) -> str | None:
    """The time unit for which `times` units are within these bounds; None if there is none."""
    return next((name for size, name in _UNITS.items() if size > 1 and least < size * times < most), None)


@check("time jumps")
def jumps(view: View) -> Found:
    """The clock was adjusted during the recording, or rows are missing."""
    table = np.concatenate([view.position, view.command], axis=1)
    for row in holes(view.time)[:3].tolist():
        before, now = view.time[row - 1], view.time[row]
        # whether moving joints change as little across the jump as between the rows beside it
        beside = np.abs(np.diff(table[max(0, row - 11) : row + 10], axis=0)).sum(1)
        across, usual = np.abs(table[row] - table[row - 1]).sum(), np.median(beside)
        text = f"time jumps from {before:.10g} s to {now:.10g} s"
        if now - before > 60 or (usual > 1e-3 and across < 3 * usual):
            text += " while the motion continues: the clock was adjusted here"
        else:
            missing = round(float(now - before) / view.interval) - 1
            text += f": about {missing} rows are missing, and no signal can be interpolated across the gap"
        yield view.found("time", text, _SPLIT, row, error=True)


@check("rate", rows=3)
def rate(view: View) -> Found:
    """The rate of the rows differs from the metadata, or is implausible for a robot."""
    steps, said, interval = np.diff(view.time), view.metadata.rate, view.interval
    row, unit, remedy = 1, None, "correct the rate or the time"
    # The mean suits a clock with two alternating intervals, and the median a clock with gaps.
    if min(abs(interval * said - 1), abs(float(steps.mean()) * said - 1)) > _TOLERANCE:
        problem = f"the median interval of {interval:.6g} s is {1 / interval:.6g} Hz, but the metadata state "
        problem += f"rate: {said:g} Hz"
        unit = _unit(1 / (interval * said), 0.5, 2)
        row = int(np.argmax(np.abs(steps * said - 1) > _TOLERANCE)) + 1
        for name in (name for size, name in _UNITS.items() if 0.9 < interval * size / said < 1.1):
            remedy = f"`rate` contains the interval in {name}; write rate: {1 / interval:.4g}"
    elif not _SLOWEST < 1 / interval < _FASTEST:
        problem = f"the median interval of {interval:.6g} s is implausible for a robot"
        unit = _unit(1 / interval, _SLOWEST, _FASTEST)
        fast = {1e-3: ("a thousand", "milliseconds"), 1e-6: ("a million", "seconds")}
        for times, name in (how for size, how in fast.items() if _SLOWEST < size / interval < _FASTEST):
            remedy = f"the clock runs {times} times too fast, as if {name} had been read as microseconds; write "
            remedy += "the unit of the times under `columns:`"
    else:
        return
    remedy = f"the time looks like {unit}; convert it to seconds" if unit else remedy
    if np.all(steps == 1):
        remedy = f"the column counts rows{', or ' + unit if unit else ''}; write the time of every row [s]"
    yield view.found("time", problem, remedy, row, error=True)


@check("uneven rows", rows=52)
def uneven(view: View) -> Found:
    """Rows are missing, many intervals are several times the usual one, the rate changes, or rows come in bursts."""
    steps, usual = np.diff(view.time), view.interval
    third, longest = len(steps) // 3, float(steps.max())
    lost, short = 1 - usual * len(steps) / float(steps.sum()), float((steps < 0.5 * usual).mean())
    change = float(np.median(steps[-third:]) / np.median(steps[:third]))
    remedy = "record with a steady clock, and find out why rows are lost"
    if (long := steps > 4 * usual).mean() > 0.02:
        problem = f"{long.sum()} intervals are over four times the usual {usual:.4g} s, up to {longest:.4g} s"
    elif not 1 / _CHANGE < change < _CHANGE:
        problem = f"the intervals become {change:.2g} times as long during the recording"
        remedy = "check whether the clock was adjusted or the rate was changed"
    elif lost > 0.05 and (np.abs(steps / usual - np.round(steps / usual)) < 0.25).mean() > 0.9:
        problem = f"about {lost:.0%} of the rows are missing, one at a time"
    elif short > 0.05:
        problem = f"{short:.0%} of the intervals are shorter than half the usual {usual:.4g} s"
        remedy = "timestamp rows when they are read, not when they are written"
    elif (8.5 if np.quantile(steps, 0.98) > 1.2 * usual else 4.5) * usual < longest <= GAP:  # a longer one is a gap
        problem = f"about {round(longest / usual) - 1} rows are missing before this one"
    else:
        return
    yield view.found("time", problem, remedy, steps.argmax() + 1)


@check("repeated rows")
def repeated(view: View) -> Found:
    """All sensor values stay the same while a joint moves: the recorder repeated one reading."""
    same = np.ones(max(len(view.time) - 1, 0), bool)
    for key in (key for key in view.log.channels if key[0] in ("joint", "imu")):
        rows, values = np.flatnonzero(same), view.log.array(key)  # few rows remain after the first condition
        same[rows] = (values[rows + 1] == values[rows]).all(1)
    first, length = longest_run(same)
    if length < 8 or length * view.interval < 0.15 or length == len(same):
        return
    last, rates = first + length, view.get(VELOCITY)
    steps = np.abs(np.diff(view.position, axis=0)).sum(1)
    out = max((steps[row] for row in (first - 1, last) if 0 <= row < len(steps)), default=0.0)
    moving = np.median(steps[steps > 0]) if steps.any() else np.inf
    speed = 0.0 if rates is None else float(np.abs(rates[first]).max())
    # the register of a resting servo may keep a speed, and the motion continues without a jump
    fast = speed > 0.15 and length < 0.9 * len(same) and out > 0.1 * speed * length * view.interval
    heeded = slice(first, max(last - round(0.1 / view.interval), first) + 1)
    commanded = np.ptp(view.command[heeded], axis=0).max() > 0.02  # otherwise all joints may have stood still
    if fast or (commanded and out > max(5 * moving, 0.03 * length * view.interval)):
        problem = f"all sensor values are constant for {length + 1} rows while the robot moves"
        remedy = "remove these rows, for which the recorder had no new readings"
        yield view.found("time", problem, remedy, first, last, error=True)


@check("stale readings")
def stale(view: View) -> Found:
    """A position or a trunk sensor has new values only in every n-th row, because it was read less often."""
    remedy = "read it in every row, or record at the lower rate"
    for key in (key for key in (ORIENTATION, RATE, FORCE) if key in view.log):
        if (every := _new_in_every(view.log.array(key))) >= 3:
            yield view.found((key, 0), f"the trunk's sensor has new values only every {every} rows", remedy)
    if _new_in_every(view.position) == 2 and np.ptp(view.position, axis=0).max() > 0.2:
        yield view.found("time", "positions have new values only every second row", remedy)
    for key, joint, column in view.columns(POSITION):
        jumps, every = np.diff(column), _new_in_every(column[:, None])
        # the position of a slow joint changes by one encoder step at a time
        if every >= 3 and np.median(np.abs(jumps[jumps != 0])) > 4 * view.steps(key)[joint]:
            yield view.found((key, joint), f"the position has a new value only every {every} rows", remedy)


def _new_in_every(values: np.ndarray) -> int:
    """Number of rows between new values ``[row, name]``; 0 if there are few new values."""
    rows = np.flatnonzero(np.diff(values, axis=0).any(1))
    return int(np.gcd.reduce(np.diff(rows))) if len(rows) >= 20 else 0


@check("two clocks")
def two_clocks(view: View) -> Found:
    """Command and position have timestamps from different clocks: the delay between them is long or grows."""
    angle, target, _, stride = view.thinned(0.02)
    period, third = stride * view.interval, len(angle) // 3
    if third * period < 1 or view.interval > 0.1:
        return
    most = third // 2
    lags = np.arange(max(round(_AHEAD / period), -most), min(round(_LONGEST / period), most))
    remedy = "timestamp both with one clock, or cut the log into short parts"
    usual = (lags * period > -0.05) & (lags * period < _USUAL)

    def clearest(*parts: slice) -> tuple[int, list[np.ndarray]]:
        """The most mobile joint whose position a delay explains best in all parts of the log, and the unexplained share
        of each part at every delay ``[lag]``; an empty list if no delay explains nearly all motion."""
        spans = np.min([np.minimum(np.ptp(target[p], axis=0), np.ptp(angle[p], axis=0)) for p in parts], axis=0)
        joints = [j for j in np.argsort(-spans)[:3].tolist() if spans[j] > 0.1]
        curves = {j: [np.fmax(1 - delays(angle[p, j], target[p, j], lags.tolist()), 0) for p in parts] for j in joints}
        joint = min(curves, key=lambda j: max(curve.min() for curve in curves[j]), default=0)
        sharp = curves and all(curve[1:-1].min() == curve.min() < 0.05 for curve in curves[joint])
        return joint, curves[joint] if sharp else []

    joint, ends = clearest(slice(0, third), slice(-third, None))
    if ends:
        first, last = (int(curve.argmin()) for curve in ends)
        other = all(c[n] > 4 * c.min() + 0.02 for c, n in zip(ends, (last, first), strict=True))
        if other and abs(lags[last] - lags[first]) * period > 0.15:
            problem = f"the position follows the command by {lags[first] * period:.2f} s at the beginning and "
            problem += f"{lags[last] * period:.2f} s at the end: their timestamps come from two clocks that drift apart"
            yield view.found((POSITION, joint), problem, remedy)
            return
    joint, curves = clearest(slice(None))
    for curve in curves:
        lag = float(lags[curve.argmin()] * period)
        late = lag < 0 or _after_friction(angle[:, joint], target[:, joint], period) > 4 * curve.min()
        if curve[usual].min() > 3 * curve.min() and late:
            problem = f"the position {'comes before' if lag < 0 else 'follows'} its command by {abs(lag):.2f} s "
            yield view.found((POSITION, joint), problem + "throughout: their clocks or time origins differ", remedy)


def _after_friction(angle: np.ndarray, target: np.ndarray, period: float) -> float:
    """Share of a position that friction in a soft loop, with damping and gravity, does not explain. In slow motions
    friction resembles a delay: the joint stays until its command is some distance away, then follows at it."""
    left = []
    for width in np.quantile(np.abs(target - angle), [0.25, 0.5, 0.75, 0.9, 0.97]):
        held, at = np.empty(len(target)), float(angle[0])
        for row, goal in enumerate(target.tolist()):
            held[row] = at = min(max(at, goal - width), goal + width)
        speed = np.gradient(held, period)
        causes = np.stack([held, np.ones(len(held)), speed, np.sin(held), np.cos(held)], axis=1)
        left.append(unexplained(angle, causes))
    return min(left)
