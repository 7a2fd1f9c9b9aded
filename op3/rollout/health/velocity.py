"""Checks of velocities against the change of position: factor, sign, delay, zero, noise, and whose they really are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from op3.rollout.health.finding import ERROR, POSITION, VELOCITY, WARNING, LogFinding, View, check
from op3.rollout.health.match import (
    SURE,
    WINDOW,
    Match,
    delayed,
    fitted,
    integral,
    longest_run,
    match,
    no_sensor,
    windows,
)
from op3.rollout.units import likely_unit

# Of 614 sound logs (whole robots with hidden effects, policies on an emulated one, five kinds of real servos), and of
# joints that move over ten steps of their encoder:
SCALED = 0.06
"""No velocity is so far from the change of position, in parts of it, beyond four standard errors; 0.03 at most."""

LATE, EARLY = 0.027, -0.007
"""No estimator of a servo is a row later than this, or ahead [s]; 0.000 to 0.021. What filters more is not used."""

SMOOTHED = 0.15
"""No estimator of a servo averages over so long [s]; 0.07 at most."""

_FILTER, _LOSS = 1e-3, 2.5e-4
"""What a filter adds of the change of a rate's slope is of this order, and in sound logs at most the second [s^2]."""

_ABSURD = 1e9
"""Numbers beyond it are refused elsewhere."""

_SLOWEST = 0.04
"""In a longer time from row to row differences, stamps and the trapezoid rule are as much as any fault [s]."""

DRIFT = 0.08
"""No velocity is so far off on average [rad/s]; 0.036 at most."""

PARTED = 0.06
"""Within a window no velocity and position part by so much [rad]; 0.051 at most."""

PARTED_SIGNS = 0.12
"""Between rising and falling positions no velocity's factor differs by so much."""

NOISE = 2.5
"""No velocity scatters from row to row by so many times what its position does, or by so many steps; 1.3 at most."""


@dataclass(frozen=True)
class Trace:
    """How a joint's velocity follows the change of its position, by least squares over windows of `WINDOW`.

    The sum of velocities in a window is explained by the position's change, by what a delay and a filter of the
    estimator leave of it, and by a constant; windows that are far off do not count.

    Attributes:
        ratio: Of velocity to the position's rate.
        delay: Of the velocity [s].
        smoothed: Time over which the velocity is an even average [s].
        bias: Of the velocity [rad/s].
        errors: Standard errors of ratio, delay and bias.
        share: Of the sums that is explained.
        counted: Share of the windows that count.
        halves: The ratio where the position falls, and where it rises; NaN where it does so in few windows.
        scatter: Velocity against its neighbours in time, median [rad/s], and the least that its position explains.
        parted: What is left in each window [rad], and the window's first and last row.
    """

    ratio: float
    delay: float
    smoothed: float
    bias: float
    errors: np.ndarray
    share: float
    counted: float
    halves: tuple[float, float]
    scatter: tuple[float, float]
    parted: tuple[np.ndarray, np.ndarray, np.ndarray]


def _trace(view: View, joint: int, summed: np.ndarray) -> Trace | None:
    """None for logs that are too short to tell; from the sum of the joint's velocities from the first row on."""
    near = max(1, round(0.02 / view.interval))
    rows = max(2, min(round(WINDOW / view.interval), len(view.time) // 10))
    first = np.arange(near, len(view.time) - rows - near, max(1, min(rows // 3, len(view.time) // 8000)))
    overlap = rows / (first[1] - first[0]) if len(first) > 1 else 1.0
    whole = view.time[first + rows + near] - view.time[first - near] < 2 * (rows + 2 * near) * view.interval
    first = first[whole]
    if len(first) < 8 * overlap:
        return None
    angle, speed = view.position[:, joint], view.log.array(VELOCITY)[:, joint]
    last, beside = first + rows, near * view.interval
    slope = (angle[2 * near :] - angle[: -2 * near]) / (2 * beside)
    bend = (angle[2 * near :] - 2 * angle[near:-near] + angle[: -2 * near]) / beside**2
    span = view.time[last] - view.time[first]
    causes = np.stack([angle[last] - angle[first], *(x[last - near] - x[first - near] for x in (slope, bend)), span], 1)
    told, kept = summed[last] - summed[first], np.ones(len(first), bool)
    if not np.max([np.abs(causes).max(), np.abs(told).max()]) < _ABSURD:  # nor no number at all
        return None
    grid = float(view.steps(VELOCITY)[joint])
    count = grid * WINDOW
    # a single sine bends as it turns, so an estimator's filter is taken for what those of servos are
    found, left = np.zeros(4), told
    for _ in range(4):
        spread = max(float(left[kept].std()), count / 4, 1e-6) * np.sqrt(overlap)
        weighed = np.vstack([causes[kept] / spread, [0, 0, 1 / _FILTER, 0]])
        found = fitted(weighed, np.append(told[kept] / spread, 0.0))
        left = told - causes @ found
        size = np.abs(left)
        kept = size <= max(5 * float(np.median(size)), count, 0.1 * float(told.std()), PARTED / 4)
    errors = np.sqrt(np.maximum(np.diagonal(np.linalg.pinv(weighed.T @ weighed)), 0.0))
    # of a motion at one frequency a filter's loss is a factor
    errors[0] += _LOSS * float(causes[:, 2].std()) / max(float(causes[:, 0].std()), 1e-12) / 4
    scatter = np.abs(speed[1:-1] - (speed[2:] + speed[:-2]) / 2)
    own = np.abs(np.diff(angle, 3)) / (2 * view.interval)  # the same of its position's rate
    return Trace(
        ratio=float(found[0]),
        delay=float(-found[1] / (found[0] or 1.0)),
        smoothed=float(np.sqrt(max(24 * found[2] / (found[0] or 1.0), 0.0))),
        bias=float(found[3]),
        errors=errors[[0, 1, 3]],
        share=1 - float(left[kept].var()) / max(float(told[kept].var()), 1e-24),
        counted=float(kept.mean()),
        halves=_halves(causes[kept], told[kept]),
        scatter=(float(np.median(scatter)), max(float(np.mean(own)), 2 * grid, 0.03)),
        parted=(left, first, last),
    )


def _halves(causes: np.ndarray, told: np.ndarray) -> tuple[float, float]:
    """Velocity's sum over the position's change where it falls, and where it rises, by one fit of both."""
    turned = causes[:, 0]
    apart = np.column_stack([np.minimum(turned, 0), np.maximum(turned, 0), causes[:, 1:]])
    often = min((turned < -0.2 * np.abs(turned).max()).sum(), (turned > 0.2 * np.abs(turned).max()).sum()) > 20
    fit = fitted(apart, told)
    return (float(fit[0]), float(fit[1])) if often else (np.nan, np.nan)


@check("velocity against position")
def velocity(view: View) -> Iterator[LogFinding]:
    """Velocity and the derivative of position differ in factor, sign, delay or zero, part for a moment, or belong to
    different joints."""
    rate, angle = view.get(VELOCITY), view.position
    if rate is None or len(view.time) < 20:
        return
    first, last, span = windows(view.time)
    if len(first) < 8:
        return
    turned, sums = angle[last] - angle[first], integral(view.time, rate)
    found = match(summed := sums[last] - sums[first], turned)
    moving = np.flatnonzero(found.size_b > np.maximum(4 * view.steps(POSITION), 0.03 * span))
    # what rounding to the sensor's steps explains is none of its faults
    odd = np.sqrt(((summed - turned) ** 2).mean(0)) > 1.5 * view.steps(VELOCITY) * span
    faults = {joint: _judge(view, found, joint, summed[:, joint]) for joint in map(int, moving[odd[moving]])}
    wrong = {joint: fault for joint, fault in faults.items() if fault}
    # where most joints are wrong by a factor, the channel is in another unit
    bad = sum(no_sensor(ratio) for _, ratio in wrong.values())
    refuse = 2 * bad > len(moving) and (bad > 1 or len(view.joints) == 1)
    factors = [ratio for _, ratio in wrong.values() if ratio and ratio > 0]
    alike = len(factors) == len(wrong) == len(moving) > 1 and max(factors) < 1.1 * min(factors)
    clock = (
        f"; in all joints, as if the clock ran at {factors[0]:.3g} times its speed, or all positions were scaled"
        if alike
        else ""
    )
    for joint, (problem, ratio) in wrong.items():
        if ratio and not refuse and (moves := _scaled(view, joint, ratio)):
            problem = f"the position moves {moves:.3g} times as far as its command, and the velocity as that says"
            remedy = "look at the resolution and the gear ratio by which the position was converted"
            yield view.found(WARNING, (POSITION, joint), problem, remedy)
            continue
        if refuse and no_sensor(ratio):
            unit = likely_unit(ratio or 0.0, "rad/s", 0.05)
            remedy = "convert both to radians and the same sign, or write `scale:` into its YAML"
            remedy = f"write `unit: {unit}` for it under `columns:` in the YAML" if unit else remedy
            yield view.found(ERROR, (VELOCITY, joint), problem, remedy, np.abs(rate[:, joint]).argmax())
        else:
            remedy = "the channel is not used; correct it where you know how"
            yield view.found(WARNING, (VELOCITY, joint), problem + clock, remedy, aside=True)
    for joint in range(len(view.joints)):
        if joint not in wrong and np.ptp(rate[:, joint]) and (trace := _trace(view, joint, sums[:, joint])):
            moves = bool(found.size_b[joint] > max(10 * view.steps(POSITION)[joint], 0.03 * span))
            yield from _differs(view, joint, trace, moves)


def _scaled(view: View, joint: int, ratio: float) -> float | None:
    """How many times as far as its command a position moves, where its velocity is that of the command."""
    told = match(view.position[:, [joint]], view.command[:, [joint]])
    moves = float(told.ratio[0, 0])
    return moves if told.correlation[0, 0] > SURE and abs(np.log(max(moves * ratio, 1e-9))) < 0.15 else None


def _differs(view: View, joint: int, trace: Trace, moves: bool) -> Iterator[LogFinding]:
    """What the trace of a joint shows; factor and delay only where it moves."""
    where, unused = (VELOCITY, joint), "the channel is not used; correct it where you know how"
    uncertain, speed = 4 * trace.errors, view.log.array(VELOCITY)[:, joint]
    rounding = float(view.steps(VELOCITY)[joint]) / 2
    whole = trace.counted > 0.9 and (trace.share > SURE or not moves)  # what is so throughout
    clear = whole and moves and view.interval < _SLOWEST
    early, late = (EARLY - uncertain[1] - view.interval, LATE + uncertain[1] + view.interval)
    if clear and not early < trace.delay < late:
        problem = _comes(trace.delay)
        yield view.found(WARNING, where, problem, unused, aside=True)
    elif clear and trace.share > 0.99 and abs(trace.halves[0] - trace.halves[1]) > PARTED_SIGNS:
        wrong = int(abs(trace.halves[1] - 1) > abs(trace.halves[0] - 1))
        problem = f"{('negative', 'positive')[wrong]} velocities are {trace.halves[wrong]:.2g} times the change of "
        problem += f"position per second, and the others {trace.halves[1 - wrong]:.2g} times"
        yield view.found(WARNING, where, problem, unused, aside=True)
    elif clear and abs(trace.ratio - 1) > max(SCALED, rounding / max(float(speed.std()), 1e-9)) + uncertain[0]:
        problem = f"the velocity is {trace.ratio:.3g} times the change of position per second"
        remedy = "look whether angle, velocity or time was scaled (a scaled position is off its command), and write "
        yield view.found(WARNING, where, problem, remedy + "`scale:` into its YAML")
    elif clear and trace.smoothed**2 > SMOOTHED**2 + 8 * view.interval**2:
        problem = f"velocity is smoothed, over {trace.smoothed:.1g} s or more"
        yield view.found(WARNING, where, problem, unused, aside=True)
    elif whole and abs(trace.bias) > DRIFT + uncertain[2] + rounding:
        problem = f"velocity is {trace.bias:+.3g} rad/s off the change of position on average"
        yield view.found(WARNING, where, problem, unused, aside=True)
    elif trace.scatter[0] > NOISE * trace.scatter[1]:
        problem = f"velocity scatters by {trace.scatter[0]:.2g} rad/s from row to row, and its position moves evenly"
        yield view.found(WARNING, where, problem, unused, aside=True)
    else:
        left, first, last = trace.parted
        size = np.abs(left)
        worst = int(size.argmax())
        within = slice(first[worst], last[worst] + 1)
        stops = float(np.abs(np.diff(speed[within])).max()) * view.interval  # between two rows
        count = 10 * float(view.steps(POSITION)[joint])
        if size[worst] > max(PARTED + stops, 8 * float(np.median(size)), count):
            far = np.flatnonzero(size > size[worst] / 2)
            far = far[np.abs(first[far] - first[worst]) < 2 * WINDOW / view.interval]
            problem = f"position and summed velocity part by {size[worst]:.2g} rad within {WINDOW:g} s there"
            remedy = "look which of them has wrong readings there, and leave these rows out"
            yield view.found(WARNING, where, problem, remedy, first[far[0]], last[far[-1]])


def _comes(lag: float) -> str:
    return f"velocity comes {abs(lag):.2g} s {'after' if lag > 0 else 'before'} the position's change"


def _says(ratio: float, interval: float) -> str:
    """What a factor between velocity and the change of position means, in words."""
    if abs(ratio / interval - 1) < 0.03:
        return ", as if it were the difference from row to row"
    if abs(ratio + 1) < 0.25:
        return " with the sign turned round"
    turned = " with the sign turned round" if ratio < 0 else ""
    # registers count in steps of a velocity, a derivative of positions in their unit per second
    for unit, whose, size in (("rad/s", "it", ratio), ("rad", "the position", 1 / ratio)):
        if name := likely_unit(size, unit, 0.05) or likely_unit(size, unit):
            return f", as if {whose} were in {name}{turned}"
    return turned


def _judge(view: View, found: Match, joint: int, summed: np.ndarray) -> tuple[str, float | None] | None:
    """What is wrong with a joint's velocity, and the factor where it is one."""
    own, ratio = found.correlation[joint, joint], float(found.ratio[joint, joint])
    sure = np.abs(found.correlation[joint])
    fits = sure > 0.97 if abs(own) < SURE or ratio < 0 else np.zeros(len(sure), bool)
    other = next((int(k) for k in np.argsort(-sure) if k != joint and fits[k] and found.ratio[joint, k] > 0), None)
    if abs(own) > SURE and not 0.6 < ratio < 1.6 and abs(ratio) > np.finfo(float).tiny:
        whose = f", or it is that of {view.joints[other]}" if other is not None else ""
        return (
            f"the velocity is {ratio:.3g} times the change of position per second{_says(ratio, view.interval)}{whose}",
            ratio,
        )
    if found.size_a[joint] < 0.02 * found.size_b[joint]:
        return "velocity stands still while the joint moves", None
    lag, best, least = _late(view, view.position[:, joint], summed)
    # what shakes is in step with itself a period later again, but not between
    if abs(lag) > 0.08 and best > 0.95 and 1 - best < 0.3 * (1 - own) and (own < 0.5 or least > own - 0.05):
        return _comes(lag), None
    if own > SURE:
        return None
    first, last, _ = windows(view.time)
    sizes = delayed(summed, np.abs(view.position[last, joint] - view.position[first, joint]), 0)
    if summed.min() >= 0 and sizes > SURE:
        return "velocity has lost its sign", None
    rate, change = view.log.array(VELOCITY)[:, joint], np.gradient(view.position[:, joint], view.time)
    near = [delayed(rate, change, n) for n in range(round(0.05 / view.interval) + 1)]
    if max(near) > 0.85:  # it shakes faster than the windows are long, seen through a filter
        return None
    if other is not None and own < 0.7:
        return f"velocity is that of {view.joints[other]}", None
    if own < 0.3 and longest_run(np.diff(rate) == 0)[1] * view.interval < 0.4:  # else it stands still
        return f"velocity does not follow the position (correlation {own:.2f})", None
    return None


def _late(view: View, angle: np.ndarray, summed: np.ndarray) -> tuple[float, float, float]:
    """How long after the position's change velocity comes [s], their correlation then, and the least up to there."""
    first, last, _ = windows(view.time)
    most, found = min(round(1.0 / view.interval), len(view.time) // 3), []
    stride = max(1, round(0.02 / view.interval))
    for lag in range(-(most // stride) * stride, most, stride):
        rows = (first >= lag) & (last - lag < len(angle))
        turned = angle[last[rows] - lag] - angle[first[rows] - lag]
        found.append((delayed(summed[rows], turned, 0), lag * view.interval))
    best, lag = max(found)
    least = min(correlation for correlation, after in found if min(lag, 0) <= after <= max(lag, 0))
    return lag, best, least
