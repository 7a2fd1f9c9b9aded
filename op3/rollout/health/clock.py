"""Checks of the clock."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import ERROR, WARNING, Finding, View, check
from op3.rollout.health.match import delayed
from op3.rollout.importing import holes

RATE_TOLERANCE = 0.1
"""Largest relative difference between the clock and the metadata's rate."""

_SPLIT = "split the file there, or write `split: true` into its YAML to read the parts"


@check("time jumps")
def jumps(view: View) -> Iterator[Finding]:
    """The clock was set during the recording, or rows are missing."""
    for row in holes(view.time)[:3]:
        before, now = view.time[row - 1], view.time[row]
        text = f"time jumps from {before:.10g} s to {now:.10g} s"
        if now - before > 60 or _goes_on(view, int(row)):
            text += " while the motion goes on: the clock was set here"
        else:
            missing = round(float(now - before) / view.interval) - 1
            text += f": about {missing} rows are missing, and nothing can be computed across the hole"
        yield Finding(ERROR, text, _SPLIT, "time", **view.where(int(row)))


def _goes_on(view: View, row: int) -> bool:
    """Whether the joints move across a jump no further than from row to row beside it, while they move."""
    positions = [v for v in (view.get(("joint", "position")), view.get(("command", "position"))) if v is not None]
    table = np.concatenate(positions, axis=1)
    near = np.abs(np.diff(table[max(0, row - 11) : row + 10], axis=0))
    across, usual = np.abs(table[row] - table[row - 1]).sum(), np.median(near.sum(1))
    return bool(usual > 1e-3 and across < 3 * usual)


@check("rate")
def rate(view: View) -> Iterator[Finding]:
    """The rows come at another rate than the metadata says."""
    if len(view.time) < 2:
        return
    steps, said = np.diff(view.time), view.metadata.rate
    # The mean suits a clock that alternates between two intervals, the median one with gaps.
    if min(abs(view.interval * said - 1), abs(float(steps.mean()) * said - 1)) <= RATE_TOLERANCE:
        return
    ratio = view.interval * said
    unit = next((u for scale, u in ((1e3, "milli"), (1e6, "micro"), (1e9, "nano")) if 0.5 < ratio / scale < 2), None)
    problem = (
        f"the median interval of {view.interval:.6g} s is {1 / view.interval:.6g} Hz, but the metadata says rate: "
    )
    problem += f"{said:g} Hz"
    remedy = f"the time looks like {unit}seconds, convert it to seconds" if unit else "correct the rate or the time"
    row = int(np.argmax(np.abs(steps * said - 1) > RATE_TOLERANCE)) + 1
    yield Finding(ERROR, problem, remedy, "time", **view.where(row))


@check("uneven rows")
def uneven(view: View) -> Iterator[Finding]:
    """Many intervals are several times the usual one."""
    steps = np.diff(view.time)
    long = steps > 4 * view.interval
    if len(steps) > 50 and long.mean() > 0.02:
        row = int(steps.argmax()) + 1
        problem = (
            f"{long.sum()} intervals are over four times the usual {view.interval:.4g} s, up to {steps.max():.4g} s"
        )
        yield Finding(WARNING, problem, "record with a clock that keeps its rate", "time", **view.where(row))


@check("two clocks")
def two_clocks(view: View) -> Iterator[Finding]:
    """The delay between command and position grows: they were stamped by clocks that run apart."""
    command, position = view.get(("command", "position")), view.get(("joint", "position"))
    third = len(view.time) // 3
    if command is None or position is None or third * view.interval < 3:
        return
    joint = int(np.ptp(command, axis=0).argmax())
    lags = range(0, round(0.8 / view.interval), max(1, round(0.02 / view.interval)))
    best = []
    for part in (slice(0, third), slice(-third, None)):
        pair = position[part, joint : joint + 1], command[part, joint : joint + 1]
        found = [float(delayed(*pair, rows)[0]) for rows in lags]
        best.append((max(found, default=0.0), lags[int(np.argmax(found))] * view.interval if found else 0.0))
    (sure, early), (sure_too, late) = best
    if min(sure, sure_too) > 0.98 and abs(late - early) > 0.2:
        problem = f"the position follows the command by {early:.2f} s at the beginning and {late:.2f} s at the end"
        problem += ": they were stamped by clocks that run apart"
        remedy = "stamp both by one clock, or cut the log into short parts"
        yield Finding(WARNING, problem, remedy, view.column(("joint", "position"), joint))
