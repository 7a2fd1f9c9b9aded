"""Checks of one channel against another: factor, sign, delay, and whose it really is."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import CURRENT, ERROR, VELOCITY, WARNING, Finding, View, check
from op3.rollout.health.match import Match, delayed, integral, match, step, windows
from op3.rollout.units import likely_unit

SURE = 0.9
"""Correlation above which a factor and a sign mean something."""


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
    moves = found.size_b > np.maximum(4 * step(angle), 0.03 * span)
    moving = np.flatnonzero(moves & ((found.size_a > 3 * step(rate) * span) | (found.size_b > 0.3 * span)))
    findings = [(int(joint), *f) for joint in moving if (f := _judge(view, found, int(joint), summed, turned, span))]
    # where most joints are wrong by a factor, the channel is in another unit
    refuse = 2 * sum(_impossible(ratio) for _, _, ratio in findings) > len(moving)
    for joint, problem, ratio in findings:
        if refuse and _impossible(ratio):
            remedy = "convert both to radians and the same sign, or write `scale:` into its YAML"
            yield view.found(ERROR, (VELOCITY, joint), problem, remedy, np.abs(rate[:, joint]).argmax())
        else:
            remedy = "the channel is not used; correct it where you know how"
            yield view.found(WARNING, (VELOCITY, joint), problem, remedy, aside=True)


def _impossible(ratio: float | None) -> bool:
    """Whether a factor is a unit or a sign, and not a filter or a rough sensor."""
    if ratio is None:
        return False
    return ratio < 0 or not 0.2 < ratio < 5 or likely_unit(ratio, "rad/s", 0.05) is not None


def _judge(
    view: View, found: Match, joint: int, summed: np.ndarray, turned: np.ndarray, span: float
) -> tuple[str, float | None] | None:
    """What is wrong with a joint's velocity, and the factor where it is one."""
    own, ratio = found.correlation[joint, joint], float(found.ratio[joint, joint])
    sure = np.abs(found.correlation[joint])
    fits = sure > 0.97 if abs(own) < SURE or ratio < 0 else np.zeros(len(sure), bool)
    other = next((int(k) for k in np.argsort(-sure) if k != joint and fits[k] and found.ratio[joint, k] > 0), None)
    if abs(own) > SURE:
        if 0.6 < ratio < 1.6:
            return None
        whose = f", or it is that of {view.joints[other]}" if other is not None else ""
        return f"the velocity is {ratio:.3g} times the change of position per second{_says(ratio)}{whose}", ratio
    if found.size_a[joint] < 0.02 * found.size_b[joint]:
        return "velocity stands still while the joint moves", None
    if summed[:, joint].min() >= 0 and delayed(np.abs(turned[:, joint]), summed[:, joint], 0) > SURE:
        return "velocity has lost its sign", None
    # a joint that shakes faster than the windows are long, seen through a filter
    rate, change = view.log.array(VELOCITY)[:, joint], np.gradient(view.position[:, joint], view.time)
    if max(delayed(rate, change, n) for n in range(round(0.05 / view.interval) + 1)) > 0.85:
        return None
    stride = span / 2
    lags = range(1, min(round(1.0 / stride), len(summed) // 2))
    late = [delayed(summed[:, joint], turned[:, joint], n) for n in lags]
    if late and max(late) > max(0.95, own + 0.1):
        return f"velocity comes {(int(np.argmax(late)) + 1) * stride:.2g} s after the position's change", None
    if other is not None and abs(own) < 0.7:
        return f"velocity is that of {view.joints[other]}", None
    if abs(own) < 0.3:
        return f"velocity does not follow the position (correlation {own:.2f})", None
    return None


@check("current against position error")
def drive(view: View) -> Iterator[Finding]:
    """Current or duty drives away from the target, or is in another unit than gain times error says."""
    gain, error = view.get(("command", "p_gain")), view.command - view.position
    rows = view.driven.all(1)
    for key in (CURRENT, ("joint", "duty")):
        values = view.get(key)
        if values is None or rows.sum() < 20:
            continue
        known = gain is not None and key == CURRENT
        values, wanted = values[rows], (error * gain if known else error)[rows]
        found, sizes = match(values, wanted), match(np.abs(values), np.abs(wanted))
        sure, ratio = np.diag(found.correlation), np.diag(found.ratio)
        moving = (found.size_b > 0.01) & (found.size_a > 0)
        signless = moving & (values.min(0) >= 0) & (wanted.min(0) < -0.3 * wanted.max(0))
        signless &= np.diag(sizes.correlation) > np.maximum(0.8, sure + 0.2)
        off = moving & (sure > 0.8) & known & ((ratio > 20) | (ratio < 0.01))
        factor = np.median(ratio[off]) if off.any() else 0.0
        for problem, wrong, remedy in (
            (f"{key[1]} has lost its sign", signless, "record it with its sign"),
            (f"{key[1]} drives away from the target", moving & (sure < -0.8) & ~signless, "turn its sign round"),
            (f"current is {factor:.3g} times gain times error, as mA or counts would be", off, "convert it to A"),
        ):
            # what most joints show that show anything is the channel's, not a joint's
            all_of_them = 2 * wrong.sum() > (moving & (np.abs(sure) > 0.5) | wrong).sum() and wrong.sum() > 1
            for joint in np.flatnonzero(wrong | all_of_them) if wrong.any() else ():
                yield view.found(WARNING, (key, joint), problem, remedy, aside=True)
