"""Checks of channels that stand still, or at the largest number that their sensor has."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.signal import detrend

from op3.rollout.health.finding import (
    COMMAND,
    CURRENT,
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
from op3.rollout.health.match import GIVES, SURE, delayed, integral, longest_run
from op3.rollout.schema import CHANNELS

_SHAKEN = 0.1
"""The accelerations of a trunk that is held spread by no more [m/s2]; by 0.08 in 179 logs, and 0.44 on the feet."""

_SETTLES = 0.5
"""A servo has reached a target that stands [s]."""


@check("saturated", unless=("stale readings",))
def saturated(view: View) -> Iterator[LogFinding]:
    """A rate or acceleration is cut off at its largest number."""
    for key, index, column in view.columns(VELOCITY, RATE, FORCE):
        top, size = np.abs(column).max(), float(view.steps(key)[index])
        flat = np.abs(column) == top
        within = flat[1:-1] & flat[:-2] & flat[2:]
        first, length = longest_run(flat)
        if top < 3 * size or not top or not max(0.002, 3 / len(flat)) < within.mean() < 0.6:
            continue
        last, faster = first + length - 1, 0.0
        if key == VELOCITY and (np.diff(within.astype(int)) == 1).sum() > 1:  # one stretch is a channel that stood
            turned = np.abs(view.position[2:, index] - view.position[:-2, index])[within]
            count = float(view.steps(POSITION)[index]) * np.sqrt(len(turned))
            faster = float((turned.sum() - count) / (view.time[2:] - view.time[:-2])[within].sum())
        aside = faster > 1.15 * top + size  # less may be a scale
        ends = ((first, first - 1), (last, last + 1))
        beside = min((abs(column[i] - column[j]) for i, j in ends if 0 <= j < len(column)), default=0)
        if aside or (key != VELOCITY and beside > max(5 * size, 0.05 * top)):
            how = f"while the joint moves at {faster:.3g} rad/s" if aside else "where it came and left fast"
            problem = f"the value stays at {top:.4g} for up to {length} rows, {how}: it is cut off"
            remedy = "choose a larger range of the sensor, or slower motions"
            yield view.found(WARNING, (key, index), problem, remedy, first, last, aside=aside)


@check("stands still")
def stands_still(view: View) -> Iterator[LogFinding]:
    """A channel keeps one number while the joint moves, or a position while its command travels far."""
    rows = round(0.2 / view.interval) if len(view.time) > 20 else 0
    if rows:
        yield from _dead(view)
        yield from _stops(view, rows)
        for joint, (first, last, moved) in commands_stop(view).items():
            problem = f"the target does not change for {last - first} rows, while the joint goes on by {moved:.3g} rad"
            remedy = "record what was sent, or cut the log here; look for a torque that was off"
            yield view.found(WARNING, (COMMAND, joint), problem, remedy, first, last)
        for _, joint, velocity in view.columns(VELOCITY):
            yield from _velocity_stands(view, joint, velocity, rows)
        switch = view.get(("command", "torque_enable"))
        for joint, position in enumerate(view.position.T):
            yield from _position_stands(view, joint, position)
            if np.ptp(view.command[:, joint]) == 0 and view.driven[:, joint].all() and np.ptp(position) > GIVES:
                problem = f"target stands at {view.command[0, joint]:.4g} rad in every row while the joint moves by "
                problem += f"{np.ptp(position):.3g} rad"
                remedy = "record what was sent, or `torque_enable: 0` where it was pushed by hand"
                yield view.found(WARNING, (COMMAND, joint), problem, remedy)
            off = np.zeros(len(view.time), bool) if switch is None else switch[:, joint] == 0
            if off.sum() * view.interval > 1 and _follows(view, joint, off):
                problem = "the joint follows its target while the log says that its torque is off"
                yield view.found(WARNING, (COMMAND, joint), problem, "correct the switch")


def _follows(view: View, joint: int, rows: np.ndarray) -> bool:
    """Whether a joint comes after its target in these rows: one that is led by hand may have targets after it."""
    told, angle = view.command[rows, joint], view.position[rows, joint]
    late = max(1, round(0.05 / view.interval))
    if len(told) < 10 * late or min(np.ptp(told), np.ptp(angle)) < 0.2:
        return False
    after, before = delayed(angle, told, late), delayed(told, angle, late)
    return after > SURE and 1 - after < 0.5 * (1 - before) and 0.5 < np.ptp(angle) / np.ptp(told) < 2


def commands_stop(view: View) -> dict[int, tuple[int, int, float]]:
    """Joints whose targets do not change any more, and that go on as before: first row, last row, and how far [rad]."""
    stopped, found = np.diff(view.command, axis=0) == 0, {}
    told, error = np.ptp(view.command, axis=0), np.abs(view.position - view.command)
    for joint in np.flatnonzero(told > 0.1).tolist():
        first, length = longest_run(stopped[:, joint])
        last = first + length
        settled = slice(first + round(_SETTLES / view.interval), last + 1)
        if length + 1 < round(2 * _SETTLES / view.interval) or not view.driven[first : last + 1, joint].all():
            continue
        moved = float(np.ptp(view.position[settled, joint]))
        goes_on = length * view.interval > 3 * _SETTLES and moved > 0.5 * told[joint]
        # where it is told again, it is told to be where it is
        resumes = last + 1 < len(error) and error[last, joint] > 4 * max(error[[first, last + 1], joint])
        if moved > 0.1 and (goes_on or resumes):
            found[joint] = first, last, moved
    return found


def _velocity_stands(view: View, joint: int, velocity: np.ndarray, rows: int) -> Iterator[LogFinding]:
    first, length = longest_run(np.diff(velocity) == 0)
    if length <= 2 * rows:
        return
    part = slice(first, first + length + 1)
    angle, time = view.position[part, joint], view.time[part]
    speed = (angle[rows:] - angle[:-rows]) / (time[rows:] - time[:-rows])
    fastest = speed[np.abs(speed - velocity[first]).argmax()]
    # a velocity may rightly keep a number while the joint is slower than its step
    if abs(fastest - velocity[first]) > max(0.15, 3 * view.steps(VELOCITY)[joint]):
        problem = f"velocity stands at {velocity[first]:.4g} rad/s for {length} rows, while the joint moves at up to "
        problem += f"{fastest:.3g} rad/s"
        where = VELOCITY, joint
        yield view.found(WARNING, where, problem, "the channel is not used", first, first + length, aside=True)


def _position_stands(view: View, joint: int, position: np.ndarray) -> Iterator[LogFinding]:
    first, length = longest_run(np.diff(position) == 0)
    last = first + length
    rows = slice(first, last + 1)
    # how far, not how much: a soft joint rightly stands while a policy dithers about it; and time to act on it
    heeded = slice(first, max(last - round(0.2 / view.interval), first) + 1)
    told = float(np.ptp(view.command[heeded, joint])) if view.driven[rows, joint].all() else 0.0
    rate, half = view.get(VELOCITY), max(1, round(0.5 / view.interval))
    rate = np.zeros(length + 1) if rate is None else rate[rows, joint]
    rate = np.where(np.abs(rate) > CHANNELS[VELOCITY].quantity.bound, 0.0, rate)  # told as beyond its bound
    turned = integral(view.time[rows], rate)
    said = float(np.abs(turned[half:] - turned[:-half]).max(initial=0.0)) if np.ptp(rate) else 0.0
    dead = length >= len(position) - 2
    moves = told > 0.4 or _follows_elsewhere(view, joint, rows, told, dead)
    if length * view.interval <= 0.5 or not (moves or said > 0.5):
        return
    problem = f"position stands at {position[first] + 0.0:.4g} rad while "
    problem += f"its command moves by {told:.3g} rad" if moves else f"its velocity says {said:.3g} rad in 0.5 s"
    all_dead = dead and bool((np.ptp(view.position, axis=0) == 0).all())
    remedy = "look whether the joint is blocked or its sensor dead"
    severity, aside = ERROR if all_dead else WARNING, dead and not all_dead
    yield view.found(severity, (POSITION, joint), problem, remedy, first, last, aside=aside)


def _follows_elsewhere(view: View, joint: int, stands: slice, told: float, dead: bool) -> bool:
    """Whether what was told while a joint stood is far more than its error spans where it is told as much, and moves.

    A weak servo sticks while its command moves by the span of its error. Where a joint stands throughout, the others
    say how well this robot follows.
    """
    if told < 0.1:
        return False
    moving = np.ones(len(view.time), bool)
    moving[stands] = dead
    joints = [j for j in range(len(view.joints)) if (j != joint) == dead and np.ptp(view.position[:, j])]
    command, angle, driven = (table[moving][:, joints] for table in (view.command, view.position, view.driven))
    if angle.size < 20 or not driven.all():
        return False
    asked, error = np.ptp(command, axis=0), np.ptp(command - angle, axis=0)
    return bool(asked.max() > 0.7 * told and told > 1.5 * error.max())


def _stops(view: View, rows: int) -> Iterator[LogFinding]:
    """Currents and inertial sensors that keep their numbers for far longer than ever else, while a joint moves."""
    turned = turned_by_gyroscope(view)
    for key in (CURRENT, ORIENTATION, RATE, FORCE):
        values = view.get(key)
        parts = [] if values is None else np.split(values, values.shape[1] if key == CURRENT else 1, axis=1)
        for index, part in enumerate(parts):
            same = (np.diff(part, axis=0) == 0).all(1)
            first, length = longest_run(same)
            run = slice(first, first + length + 1)
            through = turned if key == ORIENTATION else view.position[:, [index]] if key == CURRENT else view.position
            # of turning only what goes to and fro counts, as a gyroscope has a zero of its own
            path = detrend(through[run], axis=0) if key == ORIENTATION else through[run]
            moved = np.ptp(path, axis=0).max() > (0.05 if key == ORIENTATION else 0.2)
            limited = key == CURRENT and abs(part[first, 0]) == np.abs(part).max()
            limited |= key == CURRENT and part[first, 0] == 0 and not view.driven[run, index].any()  # it is off
            if length <= 2 * rows or length == len(same) or not moved or limited:
                continue
            same[run] = False
            if key == ORIENTATION or length > 5 * max(longest_run(same)[1], 1):
                problem = f"{key[1].replace('_', ' ')} keeps its numbers for {length} rows, while the robot moves"
                for column in [index] if key == CURRENT else range(3):
                    remedy = "the channel is not used"
                    yield view.found(WARNING, (key, column), problem, remedy, first, first + length, aside=True)


def held(view: View) -> bool:
    """Whether the accelerometer is so still that the trunk is held, and turns no further than its orientation says."""
    force = view.get(FORCE)
    return force is not None and 0 < float(force.std(0).max()) < _SHAKEN


def turned_by_gyroscope(view: View) -> np.ndarray:
    """Integral of the gyroscope [time, axis] without its bias, which is no turning, and single wrong readings.

    The bias is the median: the mean of a robot that falls in the end is its fall.
    """
    rates = view.get(RATE)
    if rates is None:
        return np.zeros((len(view.time), 3))
    rates = rates.copy()
    rates[1:-1] = np.median([rates[:-2], rates[1:-1], rates[2:]], axis=0)
    return integral(view.time, rates - np.median(rates, axis=0))


def _dead(view: View) -> Iterator[LogFinding]:
    """Channels that hold one number throughout, where they cannot."""
    moves = np.ptp(view.position, axis=0) > 0.2
    angles = view.get(ORIENTATION)
    tilted = angles is not None and bool((np.ptp(angles, axis=0) > 0.1).any())
    turns = bool((np.ptp(turned_by_gyroscope(view), axis=0) > 0.05).any()) and not held(view)
    for key in (CURRENT, ("joint", "voltage"), ("joint", "temperature"), ORIENTATION, RATE, FORCE):
        values = view.get(key)
        if values is None:
            continue
        still, zero = np.ptp(values, axis=0) == 0, values[0] == 0
        if key[0] == "joint":
            dead = still & (moves & view.driven.any(0) if key == CURRENT else zero)
        elif key == FORCE:
            dead = still.all() & (zero.all() | tilted)
        else:  # a robot that does not turn has no rates, and keeps its orientation
            dead = still.all() & (tilted if key == RATE else turns)
        for index in np.flatnonzero(np.broadcast_to(dead, still.shape)):
            problem = f"{key[1].replace('_', ' ')} stands at {values[0, index]:.4g} in every row"
            yield view.found(WARNING, (key, index), problem, "the channel is not used", aside=True)
