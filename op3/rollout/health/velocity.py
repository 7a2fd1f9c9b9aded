"""Checks of velocities against the change of position: factor, sign, delay, zero, noise, and joint."""

from __future__ import annotations

import numpy as np

from op3.rollout.health.log_view import Found, View, check
from op3.rollout.keys import POSITION, VELOCITY
from op3.rollout.match import OVERLAP, SURE, WINDOW, Match, as_if, delays, fitted, integral, is_unit, longest_run, match
from op3.rollout.units import likely_unit

# The values in sound logs are from 614 logs (robots with hidden effects, policies on an emulated robot, five kinds of
# real servos) and joints that move over ten encoder steps.
_SCALED = 0.06  # reported relative error of a velocity, beyond 4 standard errors; sound logs: 0.03
_EARLY, _LATE = -0.007, 0.027  # reported delays of a velocity [s], not filtering; sound logs: 0.000 to 0.021
_SMOOTHED = 0.15  # reported averaging time [s]; sound logs: at most 0.07
_DRIFT = 0.08  # reported mean error [rad/s]; sound logs: at most 0.036
_PARTED = 0.06  # reported divergence of velocity and position in a window [rad]; sound logs: at most 0.051
_SIDED = 0.12  # reported difference of the factor between falling and rising positions
_NOISE = 2.5  # reported scatter relative to that of the position, or to steps; sound logs: at most 1.3
_FILTER, _LOSS = 1e-3, 2.5e-4  # typical and largest second-order coefficient of a filter [s^2]

_ABSURD = 1e9  # other checks reject larger numbers
_SLOWEST = 0.04  # longest row interval [s]; beyond it, integration errors are as large as faults

_CORRECT = "correct the velocity if its conversion is known"
_LAGS = "velocity {} the change of position by {:.2g} s"


@check("velocity against position", VELOCITY, rows=20)
def velocity(view: View) -> Found:
    """Velocity and the derivative of position differ in factor, sign, delay or zero, diverge briefly, or are of
    different joints."""
    if (fit := view.rates) is None:
        return
    rate, (_, _, span) = view.log.array(VELOCITY), view.windows
    summed, steps = view.summed(rate), view.steps(POSITION)
    moving = fit.size_b > np.maximum(4 * steps, 0.03 * span)
    # errors that rounding to sensor steps explains are not reported
    odd = np.sqrt(((summed - view.turned(view.position)) ** 2).mean(0)) > 1.5 * view.steps(VELOCITY) * span
    faults = {joint: _gross(view, fit, joint, summed[:, joint]) for joint in np.flatnonzero(moving & odd).tolist()}
    wrong = {joint: fault for joint, fault in faults.items() if fault}
    # if a factor is wrong in most joints, the channel has another unit
    bad = sum(is_unit(ratio) for _, ratio in wrong.values())
    refuse = 2 * bad > moving.sum() and (bad > 1 or len(view.joints) == 1)
    factors, clock = [ratio for _, ratio in wrong.values() if ratio and ratio > 0], ""
    if len(factors) == len(wrong) == moving.sum() > 1 and max(factors) < 1.1 * min(factors):
        clock = f"; all joints agree, as if the clock ran at {factors[0]:.3g} times its speed or positions were scaled"
    for joint, (problem, ratio) in wrong.items():
        sent = match(view.position[:, [joint]], view.command[:, [joint]])
        moves = float(sent.ratio[0, 0])  # the velocity may match the command, with a scaled position
        if refuse and is_unit(ratio):
            unit = likely_unit(ratio or 0.0, "rad/s", 0.05)
            remedy = "convert both to radians with the same sign, or write `scale:` into the log's YAML"
            remedy = f"write `unit: {unit}` for it under `columns:` in the YAML" if unit else remedy
            yield view.found((VELOCITY, joint), problem, remedy, np.abs(rate[:, joint]).argmax(), error=True)
        elif ratio and not refuse and sent.correlation[0, 0] > SURE and abs(np.log(max(moves * ratio, 1e-9))) < 0.15:
            problem = f"the position moves {moves:.3g} times as far as its command, and the velocity agrees with "
            problem += "the command"
            remedy = "check the encoder resolution and the gear ratio with which the position was converted"
            yield view.found((POSITION, joint), problem, remedy)
        else:
            yield view.found((VELOCITY, joint), problem + clock, _CORRECT, aside=True)
    for joint in np.flatnonzero(np.ptp(rate, axis=0)).tolist():
        if joint not in wrong:
            yield from _mild(view, joint, rate[:, joint], bool(fit.size_b[joint] > max(10 * steps[joint], 0.03 * span)))


def _gross(view: View, fit: Match, joint: int, summed: np.ndarray) -> tuple[str, float | None] | None:
    """The fault in the velocity of a moving joint, and the factor if it is a wrong factor."""
    own, ratio = fit.own[joint], float(fit.ratio[joint, joint])
    sure = np.where(np.arange(len(fit.own)) == joint, 0.0, fit.correlation[joint])
    other = view.joints[sure.argmax()] if sure.max() > 0.97 and (abs(own) < SURE or ratio < 0) else None
    if abs(own) > SURE and not 0.6 < ratio < 1.6 and abs(ratio) > np.finfo(float).tiny:
        words = f"the velocity is {ratio:.3g} times the derivative of the position{_says(ratio, view.interval)}"
        return words + (f", or it belongs to {other}" if other else ""), ratio
    if fit.size_a[joint] < 0.02 * fit.size_b[joint]:
        return "velocity hardly changes while the joint moves", None
    rate, change = view.log.array(VELOCITY)[:, joint], view.speed[:, joint]
    lag, best, least = _late(view, view.position[:, joint], rate)
    # a vibration matches itself after a full period, but not in between
    if abs(lag) > 0.08 and best > 0.95 and 1 - best < 0.3 * (1 - own) and (own < 0.5 or least > own - 0.05):
        return _LAGS.format("lags" if lag > 0 else "leads", abs(lag)), None
    if own > SURE:
        return None
    if summed.min() >= 0 and delays(summed, np.abs(view.turned(view.position[:, joint])), [0])[0] > SURE:
        return "velocity was recorded without its sign", None
    if delays(rate, change, range(round(0.05 / view.interval) + 1)).max() > 0.85:
        return None  # the vibration is faster than the windows and filtered
    if other and own < 0.7:
        return f"velocity belongs to {other}", None
    follows = own >= 0.3 or longest_run(np.diff(rate) == 0)[1] * view.interval >= 0.4  # or it is constant
    return None if follows else (f"velocity does not follow the position (correlation {own:.2f})", None)


def _says(ratio: float, interval: float) -> str:
    """The meaning of a factor between velocity and the change of position, as text."""
    if abs(ratio / interval - 1) < 0.03:
        return ", as if it were the difference from row to row"
    # registers count velocity steps; derivatives of positions have the position's unit per second
    readings = (("it", ratio, "rad/s"), ("the position", 1 / ratio, "rad"))
    causes = (as_if(reading, tolerance=near) for reading in readings for near in (0.05, 0.12) if abs(ratio + 1) >= 0.25)
    return next(filter(None, causes), "") + " with the sign reversed" * (ratio < 0)


def _late(view: View, angle: np.ndarray, rate: np.ndarray) -> tuple[float, float, float]:
    """Delay of the velocity after the change of position [s], the correlation at it, and the smallest up to it."""
    rows, stride = int(view.windows[1][0] - view.windows[0][0]), view.stride(0.02)
    most = min(round(1.0 / view.interval), len(view.time) // 3)
    turned, summed = (x[rows:] - x[:-rows] for x in (angle, integral(view.time, rate)))
    lags = np.arange(-(most // stride) * stride, most, stride)
    curve = delays(summed, turned, lags.tolist())
    lag = int(lags[curve.argmax()])
    between = (lags >= min(lag, 0)) & (lags <= max(lag, 0))
    return lag * view.interval, float(curve.max()), float(curve[between].min())


def _weighed(causes: np.ndarray, summed: np.ndarray, count: float) -> tuple[np.ndarray, ...]:
    """Least-squares weights of the causes, their standard errors, and which windows are used; outliers are excluded."""
    weights, weighed, left, counts = np.zeros(4), causes, summed, np.ones(len(causes), bool)
    for _ in range(4):
        spread = max(float(left[counts].std()), count / 4, 1e-6) * np.sqrt(OVERLAP)
        # the filter is not identifiable from a single sine, so a typical servo filter is assumed
        weighed = np.vstack([causes[counts] / spread, [0, 0, 1 / _FILTER, 0]])
        weights = fitted(weighed, np.append(summed[counts] / spread, 0.0))
        left = summed - causes @ weights
        size = np.abs(left)
        counts = size <= max(5 * float(np.median(size)), count, 0.1 * float(summed.std()), _PARTED / 4)
    errors = np.sqrt(np.maximum(np.diagonal(np.linalg.pinv(weighed.T @ weighed)), 0.0))
    # in motion at one frequency a filter acts as a factor
    errors[0] += _LOSS * float(causes[:, 2].std()) / max(float(causes[:, 0].std()), 1e-12) / 4
    return weights, errors, counts


def _mild(view: View, joint: int, speed: np.ndarray, moves: bool) -> Found:
    """Differences between a joint's velocities [time] and its change of position; factor and delay only if it moves."""
    angle, near, interval, grid = view.position[:, joint], view.stride(0.02), view.interval, view.steps(VELOCITY)[joint]
    inside = (view.windows[0] >= near) & (view.windows[1] < len(angle) - near)
    first, last = (rows[inside] for rows in view.windows[:2])
    # change of position, effects of the estimator's delay and filter, and a constant
    ahead, behind, beside = np.roll(angle, -near), np.roll(angle, near), near * interval
    slope, bend = (ahead - behind) / (2 * beside), (ahead - 2 * angle + behind) / beside**2
    every, total = view.turned(np.stack([angle, slope, bend, view.time], axis=1))[inside], view.summed(speed)[inside]
    # few windows, or huge or missing numbers
    if len(first) < 6 * OVERLAP or not np.max([np.abs(every).max(), np.abs(total).max()]) < _ABSURD:
        return
    weights, errors, counts = _weighed(every, total, grid * WINDOW)
    ratio, delay, loss, bias = weights / [1.0, -(weights[0] or 1.0), (weights[0] or 1.0) / 24, 1.0]
    uncertain, causes, summed, left = 4 * errors, every[counts], total[counts], total - every @ weights
    share = 1 - float(left[counts].var()) / max(float(summed.var()), 1e-24)
    whole = counts.mean() > 0.9 and (share > SURE or not moves)  # faults that persist throughout
    clear = whole and moves and interval < _SLOWEST
    turned, sides = causes[:, 0], np.ones(2)
    if min((sign * turned > 0.2 * np.abs(turned).max()).sum() for sign in (-1, 1)) > 20:  # falling and rising positions
        sides = fitted(np.column_stack([np.minimum(turned, 0), np.maximum(turned, 0), causes[:, 1:]]), summed)[:2]
    scatter = float(np.median(np.abs(speed[1:-1] - (speed[2:] + speed[:-2]) / 2)))  # relative to neighbouring rows
    of_position = float(np.mean(np.abs(np.diff(angle, 3)))) / (2 * interval)
    size, remedy, rows, worst = np.abs(left), _CORRECT, (), int(np.abs(left).argmax())
    stops = float(np.abs(np.diff(speed[first[worst] : last[worst] + 1])).max()) * interval  # between two rows
    if clear and not _EARLY - uncertain[1] - interval < delay < _LATE + uncertain[1] + interval:
        problem = _LAGS.format("lags" if delay > 0 else "leads", abs(delay))
    elif clear and share > 0.99 and abs(sides[0] - sides[1]) > _SIDED:
        wrong = int(abs(sides[1] - 1) > abs(sides[0] - 1))
        problem = f"{('negative', 'positive')[wrong]} velocities are {sides[wrong]:.2g} times the rate of change of "
        problem += f"position, and the others {sides[1 - wrong]:.2g} times"
    elif clear and abs(ratio - 1) > max(_SCALED, grid / 2 / max(float(speed.std()), 1e-9)) + uncertain[0]:
        problem = f"the velocity is {ratio:.3g} times the derivative of the position"
        remedy = "check whether position, velocity or time was scaled (a scaled position differs from its command), "
        remedy += "and write `scale:` into the log's YAML"
    elif clear and loss > _SMOOTHED**2 + 8 * interval**2:
        problem = f"velocity is smoothed over {np.sqrt(loss):.1g} s or more"
    elif whole and abs(bias) > _DRIFT + uncertain[3] + grid / 2:
        problem = f"velocity differs from the change of position by {bias:+.3g} rad/s on average"
    elif scatter > _NOISE * max(of_position, 2 * grid, 0.03):
        problem = f"velocity scatters by {scatter:.2g} rad/s from row to row, but the position moves smoothly"
    elif size[worst] > max(_PARTED + stops, 8 * float(np.median(size)), 10 * float(view.steps(POSITION)[joint])):
        far = np.flatnonzero(size > size[worst] / 2)
        far = far[np.abs(first[far] - first[worst]) < 2 * WINDOW / interval]
        rows = first[far[0]], last[far[-1]]
        problem = f"position and integrated velocity diverge by {size[worst]:.2g} rad within {WINDOW:g} s"
        remedy = "check which of the two is wrong there, and remove these rows"
    else:
        return
    yield view.found((VELOCITY, joint), problem, remedy, *rows, aside=remedy == _CORRECT)
