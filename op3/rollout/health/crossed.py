"""Checks of one channel against another: factor, sign, delay, and whose it really is."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import median_filter

from op3.rollout.health.finding import CURRENT, ERROR, VELOCITY, WARNING, Finding, View, check
from op3.rollout.health.match import (
    SURE,
    WINDOW,
    Match,
    delayed,
    integral,
    longest_run,
    match,
    no_sensor,
    step,
    windows,
)
from op3.rollout.units import likely_unit

SCALED = 0.06
"""Half the joints of no sound robot tell velocities that are so far from the change of position: of 286 logs of five
kinds of servo none was further than 0.033."""

_ZERO = 0.1
"""No current sensor is so far off at nothing [A]; 0.03 in sound logs of robots that squat."""

DRIFT = 0.25
"""No sensor of a velocity is so far off at rest [rad/s]."""


def _says(ratio: float) -> str:
    """What a factor between velocity and the change of position means, in words."""
    if abs(ratio + 1) < 0.25:
        return " with the sign turned round"
    turned = " with the sign turned round" if ratio < 0 else ""
    # registers count in steps of a velocity, a derivative of positions in their unit per second
    for unit, whose, size in (("rad/s", "it", ratio), ("rad", "the position", 1 / ratio)):
        if name := likely_unit(size, unit, 0.05) or likely_unit(size, unit):
            return f", as if {whose} were in {name}{turned}"
    return turned


@check("velocity against position")
def velocity(view: View) -> Iterator[Finding]:
    """Velocity and the derivative of position differ in factor, sign or delay, or belong to different joints."""
    rate, angle = view.get(VELOCITY), view.position
    if rate is None or len(view.time) < 20:
        return
    first, last, span = windows(view.time)
    if len(first) < 8:
        return
    turned, summed = angle[last] - angle[first], integral(view.time, rate)
    found = match(summed := summed[last] - summed[first], turned)
    moving = np.flatnonzero(found.size_b > np.maximum(4 * step(angle), 0.03 * span))
    # what rounding to the sensor's steps explains is none of its faults
    odd = np.sqrt(((summed - turned) ** 2).mean(0)) > 1.5 * step(rate) * span
    bias, findings = np.median(summed - turned, axis=0) / span, []
    for joint in map(int, moving[odd[moving]]):
        if fault := _judge(view, found, joint, summed[:, joint]):
            findings.append((joint, *fault))
        elif abs(bias[joint]) > DRIFT:
            findings.append((joint, f"velocity is {bias[joint]:+.3g} rad/s off the change of position", None))
    # where most joints are wrong by a factor, the channel is in another unit
    bad = sum(no_sensor(ratio) for _, _, ratio in findings)
    refuse = 2 * bad > len(moving) and (bad > 1 or len(view.joints) == 1)
    told = {joint for joint, *_ in findings}
    # of motions over many steps, which tell a factor well
    clear = (found.size_b > 10 * step(angle)) & (np.diagonal(found.correlation) > 0.97)
    ratios = {joint: float(found.ratio[joint, joint]) for joint in map(int, moving[clear[moving]]) if joint not in told}
    most = np.ptp(view.time) > 10 * WINDOW and 2 * len(ratios) > len(moving)
    usual = float(np.median([*ratios.values()])) if most else 1.0
    for joint in ratios if abs(usual - 1) > SCALED else ():
        problem = f"the velocity is {ratios[joint]:.3g} times the change of position per second, alike in most joints"
        remedy = "look whether angles, velocities or times were scaled, and write `scale:` into its YAML"
        yield view.found(WARNING, (VELOCITY, joint), problem, remedy)
    yield from _odd_ones(view, ratios)
    for joint, problem, ratio in findings:
        if refuse and no_sensor(ratio):
            remedy = "convert both to radians and the same sign, or write `scale:` into its YAML"
            yield view.found(ERROR, (VELOCITY, joint), problem, remedy, np.abs(rate[:, joint]).argmax())
        else:
            remedy = "the channel is not used; correct it where you know how"
            yield view.found(WARNING, (VELOCITY, joint), problem, remedy, aside=True)


def _odd_ones(view: View, ratios: dict[int, float]) -> Iterator[Finding]:
    """Joints whose velocity is another part of the change of position than in all others, which agree."""
    for joint, ratio in ratios.items():
        others = np.array([other for k, other in ratios.items() if k != joint])
        if len(others) < 3:
            return
        usual, apart = float(np.median(others)), float(np.ptp(others))
        if abs(ratio / usual - 1) > max(SCALED, 4 * apart):
            problem = (
                f"the velocity is {ratio:.3g} times the change of position per second, and {usual:.3g} times in the "
            )
            problem += "other joints: one of the two has another scale"
            remedy = "look which it is (a position that is scaled is off its command), and write `scale:` into its YAML"
            yield view.found(WARNING, (VELOCITY, joint), problem, remedy)


def _judge(view: View, found: Match, joint: int, summed: np.ndarray) -> tuple[str, float | None] | None:
    """What is wrong with a joint's velocity, and the factor where it is one."""
    own, ratio = found.correlation[joint, joint], float(found.ratio[joint, joint])
    sure = np.abs(found.correlation[joint])
    fits = sure > 0.97 if abs(own) < SURE or ratio < 0 else np.zeros(len(sure), bool)
    other = next((int(k) for k in np.argsort(-sure) if k != joint and fits[k] and found.ratio[joint, k] > 0), None)
    if abs(own) > SURE and not 0.6 < ratio < 1.6:
        whose = f", or it is that of {view.joints[other]}" if other is not None else ""
        return f"the velocity is {ratio:.3g} times the change of position per second{_says(ratio)}{whose}", ratio
    if found.size_a[joint] < 0.02 * found.size_b[joint]:
        return "velocity stands still while the joint moves", None
    lag, best, least = _late(view, view.position[:, joint], summed)
    # what shakes is in step with itself a period later again, but not between
    if abs(lag) > 0.08 and best > 0.95 and 1 - best < 0.3 * (1 - own) and (own < 0.5 or least > own - 0.05):
        return f"velocity comes {abs(lag):.2g} s {'after' if lag > 0 else 'before'} the position's change", None
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


@check("slips")
def slips(view: View) -> Iterator[Finding]:
    """Position and summed velocity part within a fraction of a second and stay apart: readings were wrong there."""
    rate = view.get(VELOCITY)
    beside, within = (max(3, round(span / view.interval)) for span in (0.1, 0.3))
    if rate is None or len(view.time) < 10 * (2 * beside + within):
        return
    summed = integral(view.time, rate)
    for joint, angle in enumerate(view.position.T):
        own = float(np.ptp(summed[:, joint]) / max(np.ptp(angle), 1e-9))
        if np.ptp(angle) < 0.2 or not 0.7 < own < 1.4:  # a factor is another check's
            continue
        # what an estimator that is late leaves goes with the velocity, and what rounding leaves with the time
        causes = np.column_stack([np.ones(len(angle)), view.time, rate[:, joint]])
        apart = summed[:, joint] - angle
        apart = apart - causes @ np.linalg.lstsq(causes, apart)[0]
        level = median_filter(apart, beside, mode="nearest")
        for width in (beside, beside + within):
            parted = level[width:] - level[:-width]
            row = int(np.abs(parted).argmax())
            if abs(parted[row]) > max(0.1, 12 * float(np.quantile(np.abs(parted), 0.75)), 10 * step(angle[:, None])[0]):
                rows = row + beside // 2, row + width
                problem = f"position and summed velocity part by {abs(parted[row]):.2g} rad there and stay apart"
                remedy = "look which of them has wrong readings there, and leave these rows out"
                yield view.found(WARNING, (VELOCITY, joint), problem, remedy, *rows)
                break


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


@check("current against position error", unless=("two clocks",))
def drive(view: View) -> Iterator[Finding]:
    """Current or duty drives away from the target, is another joint's, or is in another unit than gain times error."""
    error, rows = view.command - view.position, np.array(view.driven.all(1))
    rows &= np.arange(len(view.time)) % (1 + len(view.time) // 20_000) == 0  # so many tell
    speed = np.gradient(view.position, view.time, axis=0) if len(view.time) > 1 else error
    for key, gain in ((CURRENT, view.get(("command", "p_gain"))), (("joint", "duty"), view.duty_gain)):
        values = view.get(key)
        if values is None or rows.sum() < 20:
            continue
        values, moved = values[rows], speed[rows]
        wanted = (error if gain is None else error * gain)[rows]
        asked = error[rows].std(0) > 0.002
        sure, factor, zero = _law(values, wanted, moved)
        sure_of_sizes, grows, _ = _law(values, np.abs(wanted), moved * np.sign(wanted))
        sure = np.where(asked, sure, 0.0)
        signless = (values.min(0) >= 0) & (wanted.min(0) < -0.3 * wanted.max(0)) & asked
        signless &= (grows > 0) & (sure_of_sizes > np.maximum(0.4, sure + 0.25))
        both = asked & (wanted.min(0) < -0.3 * wanted.max(0)) & (wanted.max(0) > -0.3 * wanted.min(0))
        if both.sum() > 1 and signless.any() and (values.min(0) >= 0).all():
            signless = both
        away = (sure > 0.6) & (factor < 0) & ~signless
        # where the supply or a limit decides, currents are less than was wanted: small ones are asked as well
        some = np.where(np.abs(wanted) >= 1e-3 * np.abs(wanted).max(0), 1.0, np.nan)
        small, its = (np.nanquantile(some * np.abs(one), 0.25, axis=0) for one in (values, wanted))
        typical = small / np.maximum(its, 1e-9)
        least, most = np.fmin(factor, typical), np.fmax(factor, typical)
        told = (gain is not None) & (sure > 0.8) & ~away & ~signless
        clear = (sure > 0.94) & (not view.metadata.fallen)  # arms that are flung about are limited otherwise
        off = told & np.where(clear, (least > 1.6) | (most < 0.6), (least > 2.5) | (most < 0.4))
        # a sensor's zero: what the law leaves on average, where it explains nearly all
        shifted = told & clear & ~off & (np.abs(zero) > _ZERO) & (key == CURRENT)
        for joint in np.flatnonzero(shifted):
            problem = f"current is {zero[joint]:+.2g} A off gain times error on average: its sensor has another zero"
            yield view.found(WARNING, (key, joint), problem, "write `columns: {...: {offset: ...}}` into its YAML")
        usual = float(np.median(factor[off])) if off.any() else 1.0
        units = {"it": likely_unit(usual, "A"), "the gain": likely_unit(1 / usual if usual else 0.0, "A/rad")}
        cause = next((f", as if {what} were in {unit}" for what, unit in units.items() if unit), "")
        for problem, wrong, remedy in (
            (f"{key[1]} has lost its sign", signless, "record it with its sign"),
            (f"{key[1]} drives away from the target", away, "turn its sign round"),
            (f"{key[1]} is {usual:.3g} times gain times error{cause}", off, "convert it and the gain to SI"),
        ):
            # what most joints show that show anything is the channel's, not a joint's
            all_of_them = 2 * wrong.sum() > (sure > 0.5).sum() and wrong.sum() > 1
            for joint in np.flatnonzero(wrong | all_of_them) if wrong.any() else ():
                yield view.found(WARNING, (key, joint), problem, remedy, aside=True)
        weak = [int(joint) for joint in np.flatnonzero((sure < 0.6) & asked & (values.std(0) > 0))]
        fits = {joint: _law(values[:, [joint]], wanted, moved)[0] for joint in weak}
        whose = {joint: int(fit.argmax()) for joint, fit in fits.items() if 1 - fit.max() < 0.5 * (1 - sure[joint])}
        for joint, other in whose.items():  # of those that were exchanged none is its own; copies are told elsewhere
            if fits[joint][other] > 0.5 and other in whose:
                problem = f"{key[1]} is that of {view.joints[other]}"
                yield view.found(WARNING, (key, joint), problem, "swap the columns back", aside=True)


def _law(values: np.ndarray, wanted: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Share of currents [row, joint] that a proportional and a damping term explain, the factor of the first, and what
    both leave on average."""
    v, w, s = (x - x.mean(0) for x in (values, wanted, speed))
    vw, vs, ws, ww, ss = ((x * y).mean(0) for x, y in ((v, w), (v, s), (w, s), (w, w), (s, s)))
    spread = np.maximum(ww * ss - ws * ws, 1e-24)
    factor, damping = (vw * ss - vs * ws) / spread, (vs * ww - vw * ws) / spread
    zero = values.mean(0) - factor * wanted.mean(0) - damping * speed.mean(0)
    return (factor * vw + damping * vs) / np.maximum((v * v).mean(0), 1e-24), factor, zero
