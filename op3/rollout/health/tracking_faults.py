"""Checks of positions against commands: joint, unit and sign."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components

from op3.rollout.health.log_view import Found, View, check
from op3.rollout.keys import COMMAND, CURRENT, P_GAIN, POSITION
from op3.rollout.match import SURE, delays, match
from op3.rollout.metadata import HOLDING
from op3.rollout.units import UNITS, likely_unit

_MORE, _MOST = 1.4, 1.9  # suspicious and impossible ratio of motion to command; at most 1.18 in 3,400 sound joints
_SOFT = 0.3  # smallest ratio of motion to command of a servo that follows: the softest servo on a bench
_PERIOD = 0.02  # row interval at which motions are examined [s]
_SIGNS = "write `sign: -1` under `columns:` in the YAML for its position and velocity, or for its target"
_GEAR = "check the encoder resolution and the gear ratio with which the position was converted"


def exchanged(view: View) -> dict[int, int]:
    """Joints that follow each other's commands in a cycle, and the joint whose command each follows. All others follow
    their own command; between equal commands the assignment does not matter."""
    rows = np.flatnonzero(view.driven.all(1))
    rows = rows[:: 1 + len(rows) // 1000]
    if len(rows) < 20:
        return {}
    apart = np.median(np.abs(view.position[rows, :, None] - view.command[rows, None, :]), axis=0)
    if (gain := view.get(P_GAIN)) is not None and (current := view.get(CURRENT)) is not None:  # that of its own error
        pulled = np.median(np.abs(view.error + current / np.maximum(gain, 1e-3))[rows], axis=0)
        np.fill_diagonal(apart, np.minimum(np.diagonal(apart), pulled))
    own, nearest, joints = np.diagonal(apart), linear_sum_assignment(apart)[1], np.arange(len(apart))
    rest = own[nearest == joints]
    _, circle = connected_components(np.eye(len(own))[nearest])
    size = np.bincount(circle)[circle]
    off, there = (np.bincount(circle, distance)[circle] / size for distance in (own, apart[joints, nearest]))
    found = (there < 0.25 * off) & (off > max(0.15, 5 * np.quantile(rest, 0.75) if len(rest) else 0.0))
    return {joint: int(nearest[joint]) for joint in np.flatnonzero(found).tolist()}


@check("position against command", unless="lost turns")
def command(view: View) -> Found:
    """Position and command differ in unit or sign, belong to different joints, or the command is relative."""
    circles, wrong = exchanged(view), not view.metadata.fallen  # limbs of a falling robot move freely
    for joint, other in circles.items():
        which = "of the two" if circles.get(other) == joint else "of several joints"
        problem = f"the position follows the command of {view.joints[other]}: the columns {which} are swapped"
        sure = wrong and (view.metadata.mount in HOLDING or CURRENT in view.log)  # else weight may displace soft joints
        yield view.found((POSITION, joint), problem, "swap their names under `columns:` in the YAML", error=sure)
    angle, target, driven, _ = view.thinned(_PERIOD)
    driven = np.all(driven, axis=1)
    if driven.sum() < 20:
        return
    lags = [n for n in range(0, 26, 2) if n < len(angle) // 4] or [0]
    matches = [match(angle[n:][driven[n:]], target[: len(target) - n][driven[n:]]) for n in lags]
    every = np.stack([m.correlation for m in matches])
    own, best, least = np.diagonal(every, axis1=1, axis2=2), every.max(0), every.min(0)
    itself, signed = np.diagonal(best), np.where(best >= -least, best, least)
    moved, asked = np.array([np.ptp(table[driven], axis=0) for table in (angle, target)])
    # the joint whose command explains a position much better than the own command; if columns were exchanged, that
    # joint has such a partner as well
    foreign = np.where((asked > 0.05) & ~np.eye(len(best), dtype=bool), np.abs(signed), -1.0)
    leader, strength = foreign.argmax(1), foreign.max(1)
    follows = (strength > SURE) & (itself < 0.95) & (1 - strength < 0.2 * (1 - itself))
    # a joint shaken by another is not a swap: the other joint follows its own command or a third joint's command
    _, circle = connected_components(np.eye(len(best))[leader] * follows[:, None], connection="strong")
    # or the other joint stands and this one moves: a joint that is only shaken moves less
    alone = (asked <= 0.05) & (moved < 0.5 * asked)[leader] & (moved > 0.5 * asked[leader])
    swapped = follows & ((np.bincount(circle)[circle] > 1) | alone)
    steps = [match(angle[n:] - angle[:-n], target[:-n]) for n in lags if n and driven.all()]
    change = np.max([m.own for m in steps], axis=0) if steps else np.zeros(len(itself))
    relative = (asked > 1e-3) & (moved > 0.05) & (target.std(0) < 0.6 * angle.std(0))
    relative &= (change > SURE) & (1 - change < 0.3 * (1 - itself))
    for joint in np.flatnonzero(relative):
        problem = "the command is a relative movement, not a target position"
        yield view.found((COMMAND, joint), problem, "record the position plus the command as the target", error=wrong)
    ahead, columns = range(min(51, len(angle) // 4)), (angle.T, target.T, own.min(0))
    # whether a later command explains a position better than the mirrored command
    late = [low < -0.7 and delays(t, a, ahead).max() > -low for a, t, low in zip(*columns, strict=True)]
    # for a motion with poor tracking; the weight of a standing robot may move soft joints this way
    against = (moved > 0.05) & (own[0] < -0.7) & (own[:6].max(0) < -0.3) & (view.metadata.mount in HOLDING)
    mirrored = (own.min(0) < -0.95) & (itself < 0.8)
    explained = {*circles, *np.flatnonzero(relative)}  # further problems follow from that one
    for joint in (int(j) for j in np.flatnonzero((asked > 0.05) | (moved > 0.05)) if j not in explained):
        sure, ratio = float(itself[joint]), float(matches[int(own[:, joint].argmax())].ratio[joint, joint])
        other, error = view.joints[leader[joint]] if swapped[joint] else None, wrong
        turns = ", and one sign is reversed" if signed[joint, leader[joint]] < 0 else ""
        moves = asked[joint] > 0.05
        far = ratio > _MOST or ratio < 1 / 30
        if moves and sure > (0.95 if far else 0.97) and (far or ratio > _MORE):
            unit, error = _unit(view, joint, ratio) if far and ratio > 0 else None, wrong and far
            problem = f"the position moves {ratio:.3g} times as far as its command{f', as if {unit}' if unit else ''}"
            remedy = "convert both to radians (a factor of 57.3 means degrees)" if unit else _GEAR
        elif moves and (mirrored[joint] or against[joint]) and not late[joint]:
            why = ": one of the two signs is reversed" if mirrored[joint] else f" (correlation {own[0, joint]:.2f})"
            why += f", or its column was swapped with that of {other}" if other and mirrored[joint] else ""
            problem, remedy = f"the position moves opposite to its command{why}", _SIGNS
            error = wrong and mirrored[joint]
        elif other:
            problem = f"the position follows the command of {other}: the columns of the two are swapped{turns}"
            remedy = "swap their names under `columns:` in the YAML"
        else:
            continue
        yield view.found((POSITION, joint), problem, remedy, error=error)


def _unit(view: View, joint: int, ratio: float) -> str | None:
    """Text stating that a position or its command is in another unit; None if no unit or several units fit.

    A soft servo moves less than its command, but its velocity and encoder steps show the true distance. The position
    moves `ratio` times as far as its command.
    """
    sizes = [(who, unit, size) for who in ("it", "the command") for unit, size in UNITS["rad"].items()]
    causes = [c for c in sizes if _SOFT < (ratio * c[2] if c[0] == "it" else ratio / c[2]) < _MORE]
    step, fit = float(view.steps(POSITION)[joint]), view.rates
    if fit is not None and fit.own[joint] > SURE:
        speed = fit.ratio[joint, joint]
        causes = [cause for cause in causes if abs(np.log(speed / (cause[2] if cause[0] == "it" else 1.0))) < 0.1]
    if sum(who == "it" for who, *_ in causes) > 1 and step:
        exact = [c for c in causes if c[0] != "it" or abs(np.log(step * c[2] / view.position_unit)) < 0.01]
        causes = exact if any(who == "it" for who, *_ in exact) else causes
    if len(causes) > 1:
        nearest = likely_unit(max(ratio, 1 / ratio), "rad", 0.2)
        causes = [cause for cause in causes if cause[1] == nearest]
    return f"{causes[0][0]} were in {causes[0][1]}" if causes else None
