"""Checks of single channels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import ERROR, WARNING, Finding, View, check
from op3.rollout.health.match import longest_run, step
from op3.rollout.schema import CHANNELS

_ASIDE = ("velocity", "current", "duty", "voltage", "temperature")
"""Channels of a joint that a log can do without."""


_FASTEST, _JUMP = 40.0, 0.15
"""A position that changes from row to row by more than this speed allows [rad/s], and this much beside it [rad], has
jumped; what was not read for some rows may come in one."""

_SPIKE = 0.12
"""A position does not go out and back within two rows by more [rad]."""


@check("bounds")
def bounds(view: View) -> Iterator[Finding]:
    """A value is beyond what its unit allows, in single rows or throughout."""
    for key in view.log.channels:
        quantity = CHANNELS[key].quantity
        if quantity.binary or not np.isfinite(quantity.bound):
            continue
        values = view.log.array(key)
        if -quantity.bound <= values.min() and values.max() <= quantity.bound:
            continue
        wrong = np.abs(values) > quantity.bound
        names = np.flatnonzero(wrong.any(0))
        single = float(wrong[:, names].mean()) < 0.02 and len(values) > 50
        few = key[0] == "joint" and key[1] in _ASIDE and (2 * len(names) < wrong.shape[1] or single)
        for index in map(int, names if few else names[:1]):
            row = int(wrong[:, index].argmax())
            likely = "stands there in single rows" if single else _unit(values[:, index], quantity.mistake)
            problem = f"{values[row, index]:.10g} is beyond {quantity.bound:g} {quantity.unit}".rstrip()
            remedy = "leave these rows out" if single else quantity.remedy
            severity = WARNING if few else ERROR
            problem = f"{problem} and {likely}"
            yield Finding(severity, problem, remedy, view.column(key, index), **view.where(row), set_aside=few)


def _unit(values: np.ndarray, mistake: str) -> str:
    """What values beyond their bound look like."""
    whole = bool((values == np.round(values)).all())
    if "degrees" in mistake and "per second" not in mistake and whole and np.abs(values).max() > 360:
        return "looks like counts of an encoder"
    return mistake


@check("stands still")
def stands_still(view: View) -> Iterator[Finding]:
    """A channel keeps one number while the joint moves, or a position while its command travels far."""
    rows = round(0.2 / view.interval) if len(view.time) > 20 else 0
    if not rows:
        return
    yield from _dead(view)
    position, velocity = view.position, view.get(("joint", "velocity"))
    if velocity is not None:
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
    for joint in np.flatnonzero(length * view.interval > 0.5):
        first, last = int(start[joint]), int(start[joint] + length[joint])
        moved = float(np.abs(np.diff(view.command[first : last + 1, joint])).sum())
        if moved > 1.2 and view.driven[first : last + 1, joint].all():
            problem = (
                f"position stands at {position[first, joint] + 0.0:.4g} rad while its command moves by {moved:.3g} rad"
            )
            dead, alone = last - first >= len(position) - 2, len(view.joints) == 1
            severity = ERROR if dead and (alone or (length >= len(position) - 2).all()) else WARNING
            remedy = "look whether the joint is blocked or its sensor dead"
            column, aside = view.column(("joint", "position"), int(joint)), dead and severity == WARNING
            yield Finding(severity, problem, remedy, column, **view.where(first, last), set_aside=aside)


def _dead(view: View) -> Iterator[Finding]:
    """Channels that hold one number throughout, where they cannot."""
    moves = np.ptp(view.position, axis=0) > 0.2
    angles = view.get(("imu", "orientation"))
    tilted = angles is not None and bool((np.ptp(angles, axis=0) > 0.1).any())
    for key in (("joint", "current"), ("joint", "voltage"), ("joint", "temperature"), *_INERTIAL):
        values = view.get(key)
        if values is None:
            continue
        still = np.ptp(values, axis=0) == 0
        if key[0] == "joint":
            dead = still & (values[0] == 0) & (moves | (key[1] != "current"))
        else:
            dead = np.full(
                3, bool(still.all()) and (tilted or (key[1] == "linear_acceleration" and not values[0].any()))
            )
        for index in np.flatnonzero(dead):
            problem = f"{key[1].replace('_', ' ')} stands at {values[0, index]:.4g} in every row"
            yield Finding(WARNING, problem, "the channel is not used", view.column(key, int(index)), set_aside=True)


_INERTIAL = (("imu", "angular_velocity"), ("imu", "linear_acceleration"))


@check("saturated")
def saturated(view: View) -> Iterator[Finding]:
    """A rate or acceleration is cut off at its largest number."""
    for key in (("joint", "velocity"), *_INERTIAL):
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
            ends = ((first, first - 1), (last, last + 1))
            beside = min((abs(column[i] - column[j]) for i, j in ends if 0 <= j < len(column)), default=0)
            faster = 0.0
            if key[0] == "joint" and last > first:
                turned = view.position[last, index] - view.position[first, index]
                faster = abs(float(turned / (view.time[last] - view.time[first])))
            aside = length[0] * view.interval > 0.05 and faster > 1.2 * top + 3 * steps[index] + 0.05
            if length[0] >= 5 and (aside or beside > max(5 * steps[index], 0.05 * top)):
                problem = f"the value stays at {top:.4g} for {length[0]} rows"
                problem += (
                    f", while the joint moves at {faster:.3g} rad/s" if aside else ", where it came and left fast"
                )
                remedy, where = "choose a larger range of the sensor, or slower motions", view.where(first, last)
                yield Finding(
                    WARNING, f"{problem}: it is cut off", remedy, view.column(key, index), **where, set_aside=aside
                )


@check("impossible speed")
def impossible_speed(view: View) -> Iterator[Finding]:
    """A position moves further from row to row than any servo does, or out and back at once."""
    steps = np.diff(view.position, axis=0)
    if not len(steps):
        return
    row = np.arange(len(steps))[:, None]
    moved = np.maximum.accumulate(np.where(steps != 0, row, -1), axis=0)
    stood = np.concatenate([np.zeros((1, steps.shape[1])), row[:-1] - moved[:-1]])  # rows before with nothing new
    limit = _FASTEST * np.diff(view.time)[:, None] * (1 + stood) + _JUMP
    back = np.zeros(steps.shape, bool)
    out, home = steps[:-1], steps[1:]
    back[:-1] = (np.minimum(np.abs(out), np.abs(home)) > _SPIKE) & (np.abs(out + home) < 0.3 * np.abs(out))
    for row, joint in np.argwhere((np.abs(steps) > limit) | back)[:1]:
        single = " and back" if back[row, joint] else ""
        problem = f"position jumps by {steps[row, joint]:+.3f} rad in one row{single}, faster than a servo moves"
        remedy = "leave out the row, or repair the encoder or the bus"
        yield Finding(
            ERROR, problem, remedy, view.column(("joint", "position"), int(joint)), **view.where(int(row) + 1)
        )
