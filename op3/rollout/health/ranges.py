"""Checks of what numbers can be at all."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import COMMAND, CURRENT, ERROR, POSITION, VELOCITY, WARNING, LogFinding, View, check
from op3.rollout.health.match import SURE, match_rates
from op3.rollout.schema import CHANNELS
from op3.rollout.units import likely_unit

_ASIDE = ("velocity", "current", "duty", "voltage", "temperature")
"""Channels of a joint that a log can do without."""

_FASTEST, _JUMP = 40.0, 0.15
"""A position that changes from row to row by more than this speed allows [rad/s], and this much beside it [rad], has
jumped; what was not read for some rows may come in one."""

_SPIKE = 0.12
"""No change from row to row differs from those beside it by more, unless they differ among themselves [rad]."""

_RARELY, _SMOOTH = 0.1, 0.5
"""A joint that turns on and on is beyond the bound in fewer of its rows, and moves by less from row to row [rad]."""

_SHORT = 0.025
"""In a longer time from row to row [s] a joint may come to a new place and stop there."""


_ROUGHEST = {VELOCITY: 100 * np.pi / 4096, CURRENT: 0.0065}
"""Steps in which the roughest servos tell: Feetech STS [rad/s], and HLS [A]."""


@check("coarse steps")
def coarse(view: View) -> Iterator[LogFinding]:
    """Numbers lie on another grid than the sensor's: they were rounded, or are in another unit."""
    make = view.make
    exact = view.position_unit
    own = {} if make is None else {POSITION: exact, VELOCITY: make.counts.velocity and make.counts.velocity.si}
    for key, usual, least in (
        (POSITION, exact, 0.008 if make is None else 4 * exact),
        *((k, u, 4 * u) for k, u in _ROUGHEST.items()),
    ):
        steps = view.steps(key) if key in view.log else np.zeros(0)
        most = CHANNELS[key].quantity.bound
        for joint in np.flatnonzero(steps):
            if key != POSITION and np.abs(view.log.array(key)[:, joint]).max() > most:
                continue  # in another unit, which its bound tells
            unit = likely_unit(float(steps[joint] / exact), "rad", 0.003) if key == POSITION else None
            parts = float(steps[joint] / count) if (count := own.get(key)) else 1.0
            whole = round(parts) if parts > 1 else 1 / round(1 / parts)
            decimal = abs(np.log10(steps[joint]) - np.round(np.log10(steps[joint]))) < 1e-3
            if unit and not exact / 2 < steps[joint] <= least:  # else of a finer encoder, or this one
                problem, remedy = f"{usual:.4g} or less, as if they were in {unit}", "convert them to radians"
            elif steps[joint] > least or (decimal and parts > 1):
                problem, remedy = f"{usual:.4g} or less", "write them with more digits"
            elif abs(parts / whole - 1) > 0.03 and not decimal:
                problem, remedy = f"{count:.4g}: scaled, or another servo's", "look at their unit"
            else:
                continue
            problem = f"the numbers come in steps of {steps[joint]:.4g}, where a servo's are {problem}"
            yield view.found(ERROR if unit else WARNING, (key, joint), problem, remedy)


@check("bounds")
def bounds(view: View) -> Iterator[LogFinding]:
    """A value is beyond what its unit allows, in single rows or throughout."""
    for key in view.log.channels:
        quantity, values = CHANNELS[key].quantity, view.log.array(key)
        if quantity.binary or (-quantity.bound <= values.min() and values.max() <= quantity.bound):
            continue
        wrong = np.abs(values) > quantity.bound
        if key in (POSITION, COMMAND):
            counts = (view.position - view.position[0]) / view.position_unit
            exact = np.abs(counts - np.round(counts)).max(0) < 0.02  # an encoder's in rad, as in no other unit
            near = np.median(np.abs(view.position - view.command), axis=0) < 1.0
            wrong &= ~(_goes_round(view, quantity.bound) | (exact & near))
        if not len(names := np.flatnonzero(wrong.any(0))):
            continue
        single = float(wrong[:, names].mean()) < 0.02 and len(values) > 50
        few = key[0] == "joint" and key[1] in _ASIDE and (2 * len(names) < wrong.shape[1] or single)
        for index in names if few else names[:1]:
            row = int(wrong[:, index].argmax())
            column, remedy = values[:, index], quantity.remedy
            if key in (POSITION, COMMAND) and view.metadata.robot_file is None:
                remedy += ", or give robot=<file> where a robot's file says their unit"
            likely = _likely(column, quantity.mistake)
            problem = f"{column[row]:.10g} is beyond {quantity.bound:g} {quantity.unit}".rstrip()
            turns = key in (POSITION, COMMAND) and wrong[:, index].mean() < _RARELY and np.abs(column).max() < 4 * np.pi
            if turns and np.abs(np.diff(column)).max() < _SMOOTH:
                likely, remedy = "goes there without a jump", "look whether its unit is the radian"
            elif single:
                likely, remedy = "stands there in single rows", "leave these rows out"
            elif key in (POSITION, COMMAND) and _opens(values, int(index), quantity.bound):
                likely = "looks like percent of a gripper's opening, as no other joint is"
                remedy = "write its range in rad over 100 as `unit:` of the column under `columns:` in the YAML"
            severity = WARNING if few or likely.startswith("goes") else ERROR
            yield view.found(severity, (key, index), f"{problem} and {likely}", remedy, row, aside=few)


def _opens(values: np.ndarray, joint: int, bound: float) -> bool:
    """Whether one of several joints alone leaves the bound, between 0 and 100."""
    far, column = np.abs(values).max(0) > bound, values[:, joint]
    return bool(far.sum() == 1 < len(far) - 1 and column.min() >= -1 and bound < column.max() <= 101)


def _goes_round(view: View, bound: float) -> np.ndarray:
    """Which joints turn more than once: their targets, and their velocities in rad/s, say so too, and most joints do
    not, ``[joint]``."""
    far, rate = np.abs([view.position, view.command]).max((0, 1)) > bound, view.get(VELOCITY)
    told = None if rate is None else match_rates(view.time, rate, view.position)
    if told is None or 2 * far.sum() >= len(far):
        return np.zeros(len(far), bool)
    agree = (np.diagonal(told.correlation) > SURE) & (np.abs(np.diagonal(told.ratio) - 1) < 0.1)
    return far & agree & (np.median(np.abs(view.position - view.command), axis=0) < 1.0)


def _likely(values: np.ndarray, mistake: str) -> str:
    """What values beyond their bound look like."""
    whole = bool((values == np.round(values)).all())
    counts = "degrees" in mistake and "per second" not in mistake and whole and np.abs(values).max() > 360
    return "looks like counts of an encoder" if counts else mistake


@check("impossible speed", unless=("bounds",))
def impossible_speed(view: View) -> Iterator[LogFinding]:
    """A position moves further from row to row than any servo does, or leaps where it moves evenly before and after."""
    steps, taken = np.diff(view.position, axis=0), np.diff(view.time)
    if not len(steps):
        return
    row = np.arange(len(steps))[:, None]
    moved = np.maximum.accumulate(np.where(steps != 0, row, -1), axis=0)
    stood = np.concatenate([np.zeros((1, steps.shape[1])), row[:-1] - moved[:-1]])  # rows before with nothing new
    far = np.abs(steps) > _FASTEST * taken[:, None] * (1 + stood) + _JUMP
    rows, joints = np.nonzero(np.abs(steps[3:-3]) > _SPIKE)
    rows = rows + 3
    beside = steps[rows[:, None] + np.array([-3, -2, -1, 1, 2, 3]), joints[:, None]]
    usual = np.median(beside, axis=1)
    # the largest difference beside it may be that of the way back
    spread = np.sort(np.abs(beside - usual[:, None]), axis=1)[:, -2]
    typical = np.array([np.quantile(np.abs(s[s != 0]), 0.95) if s.any() else 0.0 for s in steps.T])
    spread = np.where(spread > 0, spread, typical[joints])  # where it stands, or is read more rarely
    leap = np.abs(steps[rows, joints] / (1 + stood[rows, joints]) - usual)
    back = np.abs(beside[:, 2:4] + steps[rows, joints][:, None]).min(1) < 0.3 * np.abs(steps[rows, joints])
    even = (taken < 1.5 * view.interval)[rows]
    alone = (np.abs(steps[rows, joints] - usual) > _SPIKE) & (leap > 8 * spread)
    far[rows, joints] |= alone & even & (back | (view.interval < _SHORT))
    for at, joint in np.argwhere(far)[:1]:
        returns = at > 0 and abs(steps[at - 1, joint] + steps[at, joint]) < 0.3 * abs(steps[at, joint])
        at = at - 1 if returns else at
        problem = f"position jumps by {steps[at, joint]:+.3f} rad in one row, faster than a servo moves"
        remedy = "leave out the row, or repair the encoder or the bus"
        told = np.abs(np.diff(view.command, axis=0)[max(at - 10, 0) : at + 10, joint])
        if (
            not returns
            and told.max() == abs(view.command[at + 1, joint] - view.command[at, joint]) > 5 * np.median(told) > 0
        ):
            problem += ", and its command with it: rows are missing there, and the times do not say so"
            remedy = "look for lost rows, and write the times that were measured"
        yield view.found(ERROR, (POSITION, joint), problem, remedy, at + 1)
