"""Checks of single channels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import ERROR, WARNING, Finding, View, check
from op3.rollout.health.match import longest_run, step
from op3.rollout.schema import CHANNELS

_FASTEST, _JUMP = 60.0, 0.35
"""A position that changes from row to row by more than this speed allows [rad/s], and this much beside it [rad], has
jumped: replies lost for a few rows are made up for in one."""

_ASIDE = ("velocity", "current", "duty", "voltage", "temperature")
"""Channels of a joint that a log can do without."""


@check("bounds")
def bounds(view: View) -> Iterator[Finding]:
    """A value is beyond what its unit allows."""
    for key in view.log.channels:
        quantity = CHANNELS[key].quantity
        if quantity.binary or not np.isfinite(quantity.bound):
            continue
        values = view.log.array(key)
        if -quantity.bound <= values.min() and values.max() <= quantity.bound:
            continue
        wrong = np.abs(values) > quantity.bound
        names = np.flatnonzero(wrong.any(0))
        few = key[0] == "joint" and key[1] in _ASIDE and 2 * len(names) < wrong.shape[1]
        for index in map(int, names if few else names[:1]):
            row = int(wrong[:, index].argmax())
            problem = f"{values[row, index]:.10g} is beyond {quantity.bound:g} {quantity.unit}".rstrip()
            problem += f" and {quantity.mistake}"
            severity = WARNING if few else ERROR
            yield Finding(severity, problem, quantity.remedy, view.column(key, index), **view.where(row), set_aside=few)


@check("impossible speed")
def impossible_speed(view: View) -> Iterator[Finding]:
    """A position moves further from row to row than any servo does."""
    steps = np.diff(view.log.array(("joint", "position")), axis=0)
    limit = _FASTEST * np.diff(view.time)[:, None] + _JUMP
    for row, joint in np.argwhere(np.abs(steps) > limit)[:1]:
        problem = f"position jumps by {steps[row, joint]:+.3f} rad in one row, faster than a servo moves"
        remedy = "leave out the row, or repair the encoder or the bus"
        column = view.column(("joint", "position"), int(joint))
        yield Finding(ERROR, problem, remedy, column, **view.where(int(row) + 1))


@check("stands still")
def stands_still(view: View) -> Iterator[Finding]:
    """A velocity keeps one number while the joint moves otherwise, or a position while its command travels far."""
    position, velocity = view.log.array(("joint", "position")), view.get(("joint", "velocity"))
    rows = round(0.2 / view.interval) if len(view.time) > 20 else 0
    if velocity is not None and rows:
        start, length = longest_run(np.diff(velocity, axis=0) == 0)
        steps = step(velocity)
        for joint in np.flatnonzero(length > 2 * rows):
            first, last = int(start[joint]), int(start[joint] + length[joint])
            moved = position[first + rows : last + 1, joint] - position[first : last + 1 - rows, joint]
            speed = moved / (view.time[first + rows : last + 1] - view.time[first : last + 1 - rows])
            fastest = speed[np.abs(speed - velocity[first, joint]).argmax()]
            # a velocity may rightly keep a number while the joint is slower than its step
            if abs(fastest - velocity[first, joint]) > max(0.15, 3 * steps[joint]):
                problem = f"velocity stands at {velocity[first, joint]:.4g} rad/s for {last - first} rows, while the "
                problem += f"joint moves at up to {fastest:.3g} rad/s"
                column, where = view.column(("joint", "velocity"), int(joint)), view.where(first, last)
                yield Finding(WARNING, problem, "the channel is not used", column, **where, set_aside=True)
    start, length = longest_run(np.diff(position, axis=0) == 0)
    command = view.log.array(("command", "position"))
    for joint in np.flatnonzero(length * view.interval > 0.5) if rows else ():
        first, last = int(start[joint]), int(start[joint] + length[joint])
        moved = float(np.abs(np.diff(command[first : last + 1, joint])).sum())
        if moved > 1.2 and view.driven[first : last + 1, joint].all():
            problem = f"position stands at {position[first, joint]:.4g} rad while its command moves by {moved:.3g} rad"
            remedy = "look whether the joint is blocked or its sensor dead"
            column = view.column(("joint", "position"), int(joint))
            yield Finding(WARNING, problem, remedy, column, **view.where(first, last))


@check("saturated")
def saturated(view: View) -> Iterator[Finding]:
    """A rate or acceleration is cut off at its largest number."""
    for key in (("joint", "velocity"), ("imu", "angular_velocity"), ("imu", "linear_acceleration")):
        values = view.get(key)
        if values is None or len(values) < 20:
            continue
        steps = step(values)
        for index, column in enumerate(values.T):
            top = np.abs(column).max()
            flat = np.abs(column) == top
            if flat.mean() < 0.005 or not top:
                continue
            start, length = longest_run(flat[:, None])
            first, last = int(start[0]), int(start[0] + length[0] - 1)
            beside = [
                abs(column[i] - column[j]) for i, j in ((first, first - 1), (last, last + 1)) if 0 <= j < len(column)
            ]
            if length[0] >= 5 and min(beside, default=0) > max(5 * steps[index], 0.05 * top):
                problem = (
                    f"the value stays at {top:.4g} for {length[0]} rows, where it came and left fast: it is cut off"
                )
                remedy = "choose a larger range of the sensor, or slower motions"
                yield Finding(WARNING, problem, remedy, view.column(key, index), **view.where(first, last))


@check("copied channels")
def copied(view: View) -> Iterator[Finding]:
    """Two joints have the same numbers in every row."""
    for key in (("joint", "position"), ("joint", "velocity"), ("joint", "current")):
        values = view.get(key)
        if values is None or view.metadata.robot == "simulated":
            continue
        seen: dict[bytes, int] = {}
        for index, column in enumerate(values.T):
            first = seen.setdefault(np.ascontiguousarray(column).tobytes(), index)
            if first != index and np.ptp(column) > 0.05 and len(np.unique(column)) > 20:
                problem = f"every row has the numbers of {view.column(key, first)}"
                aside = key[1] != "position"
                yield Finding(WARNING, problem, "look which of the two it is", view.column(key, index), set_aside=aside)
