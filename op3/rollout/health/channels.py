"""Checks of single channels."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import CURRENT, ERROR, POSITION, VELOCITY, WARNING, Finding, View, check
from op3.rollout.health.match import longest_run, step
from op3.rollout.schema import CHANNELS

_ASIDE = ("velocity", "current", "duty", "voltage", "temperature")
"""Channels of a joint that a log can do without."""

_INERTIAL = (("imu", "angular_velocity"), ("imu", "linear_acceleration"))

_FASTEST, _JUMP = 40.0, 0.15
"""A position that changes from row to row by more than this speed allows [rad/s], and this much beside it [rad], has
jumped; what was not read for some rows may come in one."""

_SPIKE = 0.12
"""A position does not go out and back within two rows by more [rad]."""

_SHORT = 0.025
"""In a longer time from row to row [s] a joint may come to a new place and stop there."""


@check("bounds")
def bounds(view: View) -> Iterator[Finding]:
    """A value is beyond what its unit allows, in single rows or throughout."""
    for key in view.log.channels:
        quantity, values = CHANNELS[key].quantity, view.log.array(key)
        if quantity.binary or (-quantity.bound <= values.min() and values.max() <= quantity.bound):
            continue
        wrong = np.abs(values) > quantity.bound
        names = np.flatnonzero(wrong.any(0))
        single = float(wrong[:, names].mean()) < 0.02 and len(values) > 50
        few = key[0] == "joint" and key[1] in _ASIDE and (2 * len(names) < wrong.shape[1] or single)
        for index in names if few else names[:1]:
            row = int(wrong[:, index].argmax())
            likely = "stands there in single rows" if single else _likely(values[:, index], quantity.mistake)
            problem = f"{values[row, index]:.10g} is beyond {quantity.bound:g} {quantity.unit}".rstrip()
            remedy = "leave these rows out" if single else quantity.remedy
            severity = WARNING if few else ERROR
            yield view.found(severity, (key, index), f"{problem} and {likely}", remedy, row, aside=few)


def _likely(values: np.ndarray, mistake: str) -> str:
    """What values beyond their bound look like."""
    whole = bool((values == np.round(values)).all())
    counts = "degrees" in mistake and "per second" not in mistake and whole and np.abs(values).max() > 360
    return "looks like counts of an encoder" if counts else mistake


@check("stands still")
def stands_still(view: View) -> Iterator[Finding]:
    """A channel keeps one number while the joint moves, or a position while its command travels far."""
    rows = round(0.2 / view.interval) if len(view.time) > 20 else 0
    if rows:
        yield from _dead(view)
        for _, joint, velocity in view.columns(VELOCITY):
            yield from _velocity_stands(view, joint, velocity, rows)
        for joint, position in enumerate(view.position.T):
            yield from _position_stands(view, joint, position)


def _velocity_stands(view: View, joint: int, velocity: np.ndarray, rows: int) -> Iterator[Finding]:
    first, length = longest_run(np.diff(velocity) == 0)
    if length <= 2 * rows:
        return
    part = slice(first, first + length + 1)
    angle, time = view.position[part, joint], view.time[part]
    speed = (angle[rows:] - angle[:-rows]) / (time[rows:] - time[:-rows])
    fastest = speed[np.abs(speed - velocity[first]).argmax()]
    # a velocity may rightly keep a number while the joint is slower than its step
    if abs(fastest - velocity[first]) > max(0.15, 3 * step(velocity[:, None])[0]):
        problem = f"velocity stands at {velocity[first]:.4g} rad/s for {length} rows, while the joint moves at up to "
        problem += f"{fastest:.3g} rad/s"
        where = VELOCITY, joint
        yield view.found(WARNING, where, problem, "the channel is not used", first, first + length, aside=True)


def _position_stands(view: View, joint: int, position: np.ndarray) -> Iterator[Finding]:
    first, length = longest_run(np.diff(position) == 0)
    last = first + length
    moved = float(np.abs(np.diff(view.command[first : last + 1, joint])).sum())
    if length * view.interval <= 0.5 or moved <= 1.2 or not view.driven[first : last + 1, joint].all():
        return
    problem = f"position stands at {position[first] + 0.0:.4g} rad while its command moves by {moved:.3g} rad"
    dead = length >= len(position) - 2
    all_dead = dead and bool((np.ptp(view.position, axis=0) == 0).all())
    remedy = "look whether the joint is blocked or its sensor dead"
    severity, aside = ERROR if all_dead else WARNING, dead and not all_dead
    yield view.found(severity, (POSITION, joint), problem, remedy, first, last, aside=aside)


def _dead(view: View) -> Iterator[Finding]:
    """Channels that hold one number throughout, where they cannot."""
    moves = np.ptp(view.position, axis=0) > 0.2
    angles = view.get(("imu", "orientation"))
    tilted = angles is not None and bool((np.ptp(angles, axis=0) > 0.1).any())
    for key in (CURRENT, ("joint", "voltage"), ("joint", "temperature"), *_INERTIAL):
        values = view.get(key)
        if values is None:
            continue
        still, zero = np.ptp(values, axis=0) == 0, values[0] == 0
        dead = still & zero & (moves | (key != CURRENT)) if key[0] == "joint" else still.all() & (zero.all() | tilted)
        if key == _INERTIAL[0]:  # a robot that does not turn has no rates
            dead &= tilted
        for index in np.flatnonzero(np.broadcast_to(dead, still.shape)):
            problem = f"{key[1].replace('_', ' ')} stands at {values[0, index]:.4g} in every row"
            yield view.found(WARNING, (key, index), problem, "the channel is not used", aside=True)


@check("saturated")
def saturated(view: View) -> Iterator[Finding]:
    """A rate or acceleration is cut off at its largest number."""
    for key, index, column in view.columns(VELOCITY, *_INERTIAL):
        top = np.abs(column).max()
        flat = np.abs(column) == top
        first, length = longest_run(flat)
        if flat.mean() < 0.005 or not top or length < 5:
            continue
        last, size = first + length - 1, float(step(column[:, None])[0])
        ends = ((first, first - 1), (last, last + 1))
        beside = min((abs(column[i] - column[j]) for i, j in ends if 0 <= j < len(column)), default=0)
        faster = 0.0
        if key == VELOCITY:
            turned = view.position[last, index] - view.position[first, index]
            faster = abs(float(turned / (view.time[last] - view.time[first])))
        aside = length * view.interval > 0.05 and faster > 1.2 * top + 3 * size + 0.05
        if aside or beside > max(5 * size, 0.05 * top):
            how = f"while the joint moves at {faster:.3g} rad/s" if aside else "where it came and left fast"
            problem = f"the value stays at {top:.4g} for {length} rows, {how}: it is cut off"
            remedy = "choose a larger range of the sensor, or slower motions"
            yield view.found(WARNING, (key, index), problem, remedy, first, last, aside=aside)


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
    for row, joint in np.argwhere((np.abs(steps) > limit) | back | _alone(view, steps, stood))[:1]:
        single = " and back" if back[row, joint] else ""
        problem = f"position jumps by {steps[row, joint]:+.3f} rad in one row{single}, faster than a servo moves"
        yield view.found(
            ERROR, (POSITION, joint), problem, "leave out the row, or repair the encoder or the bus", row + 1
        )


def _alone(view: View, steps: np.ndarray, stood: np.ndarray) -> np.ndarray:
    """Which steps are far larger than all beside them, as where a counter is set anew, [row, joint]."""
    alone = np.zeros(steps.shape, bool)
    if len(steps) < 7 or view.interval > _SHORT:
        return alone
    size, count = np.abs(steps), len(steps) - 6
    beside = functools.reduce(np.maximum, (size[i : i + count] for i in (0, 1, 2, 4, 5, 6)))
    even = (np.diff(view.time) < 1.5 * view.interval)[3:-3, None]
    leap = size[3:-3] / (1 + stood[3:-3])
    alone[3:-3] = (size[3:-3] > _SPIKE) & (leap > 8 * beside) & (beside > 0) & even
    return alone
