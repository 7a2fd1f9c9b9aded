"""Checks of angles: against the command, turns, zeros and steps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import linear_sum_assignment

from op3.robot.robot import Robot
from op3.rollout.errors import LogError
from op3.rollout.health.finding import (
    COMMAND,
    CURRENT,
    ERROR,
    POSITION,
    VELOCITY,
    WARNING,
    LogFinding,
    View,
    check,
)
from op3.rollout.health.match import GIVES, SURE, delayed, fitted, match, match_rates
from op3.rollout.metadata import HOLDING
from op3.rollout.units import UNITS, likely_unit

_TURN = 2 * np.pi

_MORE, _MOST = 1.4, 1.9
"""A servo that follows its command moves less than the first times as far, 1.18 in 3,400 joints of sound logs; none by
the second."""

_SOFT = 0.3
"""Servos that follow their commands at all move so far, in parts of what is asked for: the softest of a bench."""

_SIGNS = "write `sign: -1` under `columns:` in the YAML for its position and velocity, or for its target"
_GEAR = "look at the resolution and the gear ratio by which it was converted"


def _returns(joint: int, leader: np.ndarray, follows: np.ndarray) -> bool:
    """Whether who follows whom leads back to a joint, as where columns were exchanged."""
    at, seen = joint, set()
    while follows[at] and at not in seen:
        seen.add(at)
        at = int(leader[at])
    return bool(seen) and at == joint


def _exchanged(view: View) -> dict[int, int]:
    """Joints that are where others are told to be, round in a circle, and whose command each follows.

    All others follow their own; where commands are alike, whose a position is makes no difference.
    """
    rows = np.flatnonzero(view.driven.all(1))
    rows = rows[:: 1 + len(rows) // 1000]
    if len(rows) < 20:
        return {}
    apart = np.median(np.abs(view.position[rows, :, None] - view.command[rows, None, :]), axis=0)
    own, nearest = np.diagonal(apart), linear_sum_assignment(apart)[1]
    rest, found = own[nearest == np.arange(len(own))], {}
    for joint in range(len(own)):
        circle = [joint]
        while (following := int(nearest[circle[-1]])) != joint:
            circle.append(following)
        off, there = own[circle].mean(), apart[circle, nearest[circle]].mean()
        if there < 0.25 * off and off > max(0.15, 5 * np.quantile(rest, 0.75) if len(rest) else 0.0):
            found[joint] = int(nearest[joint])
    return found


@check("position against command")
def command(view: View) -> Iterator[LogFinding]:
    """Position and command differ in unit or sign, belong to different joints, or the command says how far to go."""
    exchanged = _exchanged(view)
    wrong = WARNING if view.metadata.fallen else ERROR  # limbs of a robot that falls are flung about
    for joint, other in exchanged.items():
        which = "of the two" if exchanged.get(other) == joint else "of several joints"
        problem = f"the position follows the command of {view.joints[other]}: the columns {which} are swapped"
        yield view.found(wrong, (POSITION, joint), problem, "exchange their names under `columns:` in the YAML")
    stride = max(1, round(0.02 / view.interval)) if len(view.time) >= 20 else 1
    angle, target = view.position[::stride], view.command[::stride]
    driven = np.all(view.driven[::stride], axis=1)
    if driven.sum() < 20:
        return
    lags = [n for n in range(0, 26, 2) if n < len(angle) // 4] or [0]
    matches = [match(angle[n:][driven[n:]], target[: len(target) - n][driven[n:]]) for n in lags]
    every = np.stack([m.correlation for m in matches])
    own, best = np.diagonal(every, axis1=1, axis2=2), every.max(0)
    signed = np.where(best >= -every.min(0), best, every.min(0))
    asked, moved = np.ptp(target[driven], axis=0) > 0.05, np.ptp(angle[driven], axis=0) > 0.05
    # whose command explains a position much better than its own; where columns were exchanged, that joint has such a
    # one as well
    foreign = np.where(asked & ~np.eye(len(best), dtype=bool), np.abs(signed), -1.0)
    leader, strength = foreign.argmax(1), foreign.max(1)
    itself = np.diagonal(best)
    turned, wanted = np.ptp(angle[driven], axis=0), np.ptp(target[driven], axis=0)
    follows = (strength > SURE) & (itself < 0.95) & (1 - strength < 0.2 * (1 - itself))
    # the other stands, and this one moves: what is only shaken in step with a command moves by less than that asks for
    alone = ~asked & (turned < 0.5 * wanted)[leader] & (turned > 0.5 * wanted[leader])
    ahead = [n for n in lags if n and driven.all()]
    steps = [match(angle[n:] - angle[:-n], target[:-n]) for n in ahead]
    change = np.max([np.diagonal(m.correlation) for m in steps], axis=0) if steps else np.zeros(len(itself))
    smaller = (wanted > 1e-3) & moved & (target.std(0) < 0.6 * angle.std(0))
    relative = smaller & (change > SURE) & (1 - change < 0.3 * (1 - itself))
    for joint in np.flatnonzero(relative):
        problem = "the command is how far the joint is to move, and not where to"
        yield view.found(wrong, (COMMAND, joint), problem, "record the position plus the command as the target")

    def late(joint: int) -> bool:
        """Whether a command that comes after it explains a position better than its mirror image."""
        most = min(51, len(angle) // 4)
        return max(delayed(target[:, joint], angle[:, joint], n) for n in range(most)) > -own[:, joint].min()

    # of a motion that does not follow well; on the feet of a robot the weight may turn soft joints so
    against = asked & moved & (own[0] < -0.7) & (own[:6].max(0) < -0.3) & (view.metadata.mount in HOLDING)
    explained = {*exchanged, *np.flatnonzero(relative)}  # what else there is to say follows from that
    for joint in (int(j) for j in np.flatnonzero(asked | moved) if j not in explained):
        sure, ratio = float(best[joint, joint]), float(matches[int(own[:, joint].argmax())].ratio[joint, joint])
        where = POSITION, joint
        whose = int(leader[joint])
        # one that is shaken by another's motion is no swap: that other follows its own command, or a third one's
        both = _returns(joint, leader, follows) or alone[joint]
        other = view.joints[whose] if follows[joint] and both else None
        if asked[joint] and sure > 0.95 and (ratio > _MOST or ratio < 1 / 30):
            unit = _unit(view, joint, ratio) if ratio > 0 else None
            cause = f", as if {unit}" if unit else ""
            problem = f"the position moves {ratio:.3g} times as far as its command{cause}"
            remedy = "convert both to radians (57.3 is degrees)" if unit else _GEAR
            yield view.found(wrong, where, problem, remedy)
        elif asked[joint] and sure > 0.97 and ratio > _MORE:
            yield view.found(WARNING, where, f"the position moves {ratio:.3g} times as far as its command", _GEAR)
        elif asked[joint] and own[:, joint].min() < -0.95 and sure < 0.8 and not late(joint):
            problem = "the position moves against its command: the sign of one of them is turned round"
            problem += f", or it was swapped with that of {other}" if other else ""
            yield view.found(wrong, where, problem, _SIGNS)
        elif against[joint] and not late(joint):
            problem = f"the position moves against its command (correlation {own[0, joint]:.2f})"
            yield view.found(WARNING, where, problem, _SIGNS)
        elif other:
            problem = f"the position follows the command of {other}: the columns of the two are swapped"
            problem += ", and the sign of one is turned round" if signed[joint, whose] < 0 else ""
            yield view.found(wrong, where, problem, "exchange their names under `columns:` in the YAML")


def _unit(view: View, joint: int, ratio: float) -> str | None:
    """Whether a position or its command is in another unit, in words; None where no unit or more than one fits.

    A soft servo moves less than it is told, but its velocity tells how far, and so do the steps of its encoder.

    Args:
        view: of the log.
        joint: number.
        ratio: how many times as far as its command the position moves.
    """
    sizes = {name: size for name, size in UNITS["rad"].items() if size != 1.0}
    own = [name for name, size in sizes.items() if _SOFT < ratio * size < _MORE]
    told = [name for name, size in sizes.items() if _SOFT < ratio / size < _MORE]
    step, rate = float(view.steps(POSITION)[joint]), view.get(VELOCITY)
    found = None if rate is None else match_rates(view.time, rate[:, [joint]], view.position[:, [joint]])
    if found is not None and found.correlation[0, 0] > SURE:
        speed = float(found.ratio[0, 0])
        own = [name for name in own if abs(np.log(speed / sizes[name])) < 0.1]
        told = told if abs(np.log(speed)) < 0.1 else []
    if len(own) > 1 and step:
        own = [name for name in own if abs(np.log(step * sizes[name] / view.position_unit)) < 0.01] or own
    causes = [*(("it", name) for name in own), *(("the command", name) for name in told)]
    if len(causes) > 1:
        nearest = likely_unit(max(ratio, 1 / ratio), "rad", 0.2)
        causes = [one for one in causes if one[1] == nearest]
    return f"{causes[0][0]} were in {causes[0][1]}" if causes else None


def _small(values: np.ndarray) -> np.ndarray:
    """Which columns are angles in rad at all: others are said by checks of the unit."""
    steps = np.abs(np.diff(values, axis=0))
    return (np.abs(values).max(0) < 50) & ((steps > 1).mean(0) < 0.05 if len(steps) else True)


@check("lost turns")
def lost_turns(view: View) -> Iterator[LogFinding]:
    """A position or target jumps by whole turns: it was wrapped, or the encoder lost count."""
    for key, values in ((POSITION, view.position), (COMMAND, view.command)):
        steps = np.diff(values, axis=0)
        if max(steps.max(initial=0.0), -steps.min(initial=0.0)) < _TURN - 1.0:
            continue
        turns = np.round(steps / _TURN)
        jumps = (turns != 0) & (np.abs(steps - turns * _TURN) < 1.0) & _small(values)
        for row, joint in np.argwhere(jumps)[:1]:
            count = int(abs(turns[row, joint]))
            problem = f"{'position' if key == POSITION else 'target'} jumps by "
            problem += (
                f"{'one turn' if count == 1 else f'{count} turns'} ({steps[row, joint]:+.3f} rad) at row {row + 2}"
            )
            remedy = "write `unwrap: true` into its YAML, or `shift: {joint: rad}` to move its zero as well"
            yield view.found(ERROR, (key, joint), problem, remedy, row + 1)


@check("a turn off")
def a_turn_off(view: View) -> Iterator[LogFinding]:
    """A position is whole turns away from its command."""
    error = view.position - view.command
    if not view.driven.all() and view.driven.any(0).all():
        error = np.where(view.driven, error, np.nan)
    offset = np.median(error, axis=0) if view.driven.all() else np.nanmedian(error, axis=0)
    span = np.nanmax(error, axis=0) - np.nanmin(error, axis=0)
    turns = np.round(offset / _TURN)
    follows = (span < np.pi) & _small(view.position) & _small(view.command)
    for joint in np.flatnonzero((turns != 0) & follows & (np.abs(offset - turns * _TURN) < 1.0)):
        problem = f"the position is {offset[joint]:+.3f} rad away from the command, about {turns[joint]:+.0f} turn"
        yield view.found(ERROR, (POSITION, joint), problem, "write `unwrap: true` into its YAML")


@check("limits of the robot")
def beyond_limits(view: View) -> Iterator[LogFinding]:
    """A joint is mostly where its robot's file says that it cannot go: its sign or its zero is another."""
    if view.metadata.robot_file is None:
        return
    try:
        known = view.log.named_robot
    except LogError:  # told by the check of the robot
        return
    names = [name for name in view.joints if name in known.joints]
    rows, angles = known.indices(names), view.position[:, [view.joints.index(name) for name in names]]
    low, high = known.limits[rows].T
    shares = {sign: ((sign * angles < low - 0.1) | (sign * angles > high + 0.1)).mean(0) for sign in (1, -1)}
    wrong = {name: bool(back < 0.05) for name, out, back in zip(names, *shares.values(), strict=True) if out > 0.5}
    turned = _turned_round(
        known, dict(zip(names, angles.mean(0).tolist(), strict=True)), [n for n in wrong if wrong[n]]
    )
    for name, mirrored in wrong.items():
        at = names.index(name)
        problem = f"{shares[1][at]:.0%} of the positions lie outside {low[at]:.2f} to {high[at]:.2f} rad, where "
        problem += f"{known.name} ends"
        remedy = "look at its sign and its zero"
        if mirrored:
            problem += f"; with its sign turned round they would not{turned}"
            remedy = "write `sign: -1` for positions, targets, velocities and currents of these joints"
        yield view.found(WARNING, (POSITION, view.joints.index(name)), problem, remedy)


def _turned_round(robot: Robot, means: dict[str, float], wrong: list[str]) -> str:
    """Which other joints of the same sides stand as their partners' mirror images with the sign turned round, and which
    stand too near to 0 to say, in words."""
    sides, turned, unseen = {name.split("_")[0] for name in wrong}, [], []
    for name in (n for n in means if robot.partners and n not in wrong and n.split("_")[0] in sides):
        partner, sign = robot.mirror[name]
        if name == partner or partner not in means:
            continue
        if max(abs(means[name]), abs(means[partner])) < 0.1:
            unseen.append(name)
        elif abs(means[name] + sign * means[partner]) < 0.3 * abs(means[name] - sign * means[partner]):
            turned.append(name)
    text = f", and by their partners so are those of {', '.join(turned)}" if turned else ""
    return text + (f" ({', '.join(unseen)} stand too near 0 to say)" if turned and unseen else "")


@check("constant offset", unless=("position against command",))
def constant_offset(view: View) -> Iterator[LogFinding]:
    """A joint stands off its command by the same angle in every pose: a homing offset, another zero, or a sign.

    Where the recorded current is the gain times this angle, the joint is just soft, and yields to what it carries.
    """
    told = (view.driven.mean(0) > 0.5) & _small(view.position) & _small(view.command)
    exchanged = _exchanged(view)
    joints = [j for j in np.flatnonzero(told).tolist() if j not in exchanged] if len(view.time) >= 20 else []
    error, gain, current = view.position - view.command, view.get(("command", "p_gain")), view.get(CURRENT)
    middle = np.array([np.median(error[view.driven[:, joint], joint]) for joint in joints])
    sags = _sags(view)
    for place, joint in enumerate(joints):
        driven = view.driven[:, joint]
        off, at, angle = (table[driven, joint] for table in (error, view.command, view.position))
        others, offset = np.delete(np.abs(middle), place), float(middle[place])
        if len(others) >= 3:
            odd = abs(offset) > max(0.15, 5 * float(np.quantile(others, 0.75)))
            odd |= abs(offset) > max(GIVES, 5 * float(off.std()))
        else:  # what gravity and a soft loop leave goes with the angle, and what a slow one leaves with the speed
            speed = np.gradient(view.position[:, joint], view.time)[driven]
            causes = np.stack([np.ones(len(angle)), np.sin(angle), speed], axis=1)
            fit = fitted(causes, off) if np.ptp(causes[:, 1]) > 0.5 else np.array([offset, 0.0, 0.0])
            least = 0.2 if np.ptp(causes[:, 1]) > 0.5 else GIVES
            odd, offset = abs(fit[0]) > max(least, 3 * float((off - causes @ fit).std())), float(fit[0])
        yields = False
        if gain is not None and current is not None:
            pulled = -gain[driven, joint] * off  # damping has no mean
            yields = abs(np.median(current[driven, joint] - pulled)) < 0.5 * abs(np.median(pulled))
        if sags is not None and np.isfinite(sags[joint]):
            yields |= 0.3 < offset / (sags[joint] or np.inf) < 3.0
        dead = np.ptp(view.position[:, joint]) == 0 and np.ptp(at) > 0.2  # a dead sensor is another check's
        if dead or yields or not odd:
            continue
        mirrored = np.ptp(at) < 0.05 and abs(offset + 2 * float(np.median(at))) < 0.05
        cause = "its sign is turned round" if mirrored else "another zero, or a homing offset in the servo"
        unweighed = sags is None or not np.isfinite(sags[joint])
        cause += ", where it is not what the joint carries" if unweighed and not mirrored else ""
        problem = f"the joint stands {offset:+.3f} rad off its command in every pose: {cause}"
        mends = "sign: -1" if mirrored else f"offset: {-offset:.4g}"
        remedy = f"write `{mends}` for its position under `columns:` in the YAML, or correct it in the servo"
        if unweighed and not mirrored:
            remedy += "; what it carries changes with the pose, and a zero does not"
        yield view.found(WARNING, (POSITION, joint), problem, remedy)


def _sags(view: View) -> np.ndarray | None:
    """How far gravity takes each joint off its command, by the robot's masses and its servos' stiffness [joint] in rad.

    NaN where a servo or its gain is unknown; None where the robot is, or stands on its feet.
    """
    if view.metadata.robot_file is None or view.metadata.mount not in HOLDING:
        return None
    try:
        robot, volts = view.log.robot, view.get(("joint", "voltage"))
    except LogError:  # told by the check of the robot
        return None
    if not set(view.joints) <= set(robot.joints):
        return None
    sags = np.full(len(view.joints), np.nan)
    columns = robot.indices(view.joints)
    rows = np.linspace(0, len(view.time) - 1, 9).astype(int)
    pose = np.tile(robot.home, (len(rows), 1))
    pose[:, columns] = view.position[rows]
    weight = np.median([robot.gravity(angles)[columns] for angles in pose], axis=0)
    for joint, make in enumerate(view.log.servos):
        gain = view.get(("command", "p_gain" if make is not None and make.loop == "current" else "firmware_gain"))
        if make is None or gain is None:
            continue
        stiffness = float(np.median(gain[:, joint])) * make.output_constant
        if make.loop == "firmware":
            assert make.position_law is not None
            supply = make.supply.si if volts is None or not volts[:, joint].any() else float(np.median(volts[:, joint]))
            stiffness *= make.position_law.error_gain.si * supply / make.motor.terminal_resistance.si
        sags[joint] = -weight[joint] / stiffness if stiffness else np.nan
    return sags
