"""Checks of possible values of angles and other channels: turns, limits, zeros, steps and speeds."""

from __future__ import annotations

import numpy as np

from op3.robot.robot import Robot
from op3.rollout.health.log_view import Found, View, check
from op3.rollout.health.numbers import TURN, are_radians
from op3.rollout.health.tracking_faults import exchanged
from op3.rollout.keys import COMMAND, CURRENT, P_GAIN, POSITION, VELOCITY
from op3.rollout.match import GIVES, SURE, fitted
from op3.rollout.metadata import HOLDING
from op3.rollout.schema import CHANNELS
from op3.rollout.units import likely_unit

_ASIDE = ("velocity", "current", "duty", "voltage", "temperature")  # joint channels that may be excluded
_ROUGHEST = {VELOCITY: 100 * np.pi / 4096, CURRENT: 0.0065}  # steps of the coarsest servos: Feetech STS and HLS
_RARELY, _SMOOTH = 0.1, 0.5  # largest share of rows beyond the bound, and movement per row [rad], of a turning joint
_FASTEST, _JUMP = 40.0, 0.15  # reported speed [rad/s] and excess [rad]; missed readings may accumulate in one row
_SPIKE = 0.12  # reported difference between a change and its neighbours, unless these differ too [rad]
_SHORT = 0.025  # during a longer interval [s] a joint may move and stop


@check("limits of the robot")
def beyond_limits(view: View) -> Found:
    """A joint is mostly outside the limits in the robot file: its sign or zero is wrong."""
    if (known := view.robot) is None:
        return
    names = [name for name in view.joints if name in known.joints]
    angles, (low, high) = dict(zip(view.joints, view.position.T, strict=True)), known.limits[known.indices(names)].T
    table = np.stack([angles[name] for name in names], axis=1) if names else np.zeros((1, 0))
    out, back = (((x < low - 0.1) | (x > high + 0.1)).mean(0) for x in (table, -table))
    mirrored = [name for name, share, other in zip(names, out, back, strict=True) if share > 0.5 and other < 0.05]
    for at in np.flatnonzero(out > 0.5):
        problem = f"{out[at]:.0%} of the positions lie outside {low[at]:.2f} to {high[at]:.2f} rad, the limits of "
        problem, remedy = f"{problem}{known.name}", "check the sign and the zero"
        if names[at] in mirrored:
            problem += f"; with reversed signs, the positions would be inside{_turned_round(known, angles, mirrored)}"
            remedy = "write `sign: -1` for positions, targets, velocities and currents of these joints"
        yield view.found((POSITION, view.joints.index(names[at])), problem, remedy)


def _turned_round(robot: Robot, angles: dict[str, np.ndarray], wrong: list[str]) -> str:
    """Text about other joints of the same sides whose angles have the opposite sign of their partners' mirror images,
    and about joints too close to 0 to decide."""
    sides, turned, unseen = {name.split("_")[0] for name in wrong}, [], []
    for name in (n for n in angles if n in robot.joints and n not in wrong and n.split("_")[0] in sides):
        partner, sign = robot.mirror[name] if robot.partners else (name, 1)
        if name == partner or partner not in angles:
            continue
        mean, other = float(angles[name].mean()), sign * float(angles[partner].mean())
        if max(abs(mean), abs(other)) < 0.1:
            unseen.append(name)
        elif abs(mean + other) < 0.3 * abs(mean - other):
            turned.append(name)
    text = f"; compared with their mirror joints, {', '.join(turned)} are reversed too" if turned else ""
    return text + (f" ({', '.join(unseen)} are too close to 0 to decide)" if turned and unseen else "")


@check("constant offset", rows=20, unless="position against command")
def constant_offset(view: View) -> Found:
    """A joint differs from its command by the same angle in every pose: a turn, a homing offset, a wrong zero or sign.

    Nothing is reported if the recorded current equals the gain times this angle, because the joint then yields to its
    load.
    """
    driven = (view.driven.mean(0) > 0.5) & are_radians(view.position) & are_radians(view.command)
    joints = np.setdiff1d(np.flatnonzero(driven), list(exchanged(view))).tolist()
    middle = {joint: float(np.median(view.error[view.driven[:, joint], joint])) for joint in joints}
    sags, gain, current = _sags(view), view.get(P_GAIN), view.get(CURRENT)
    for joint, offset in middle.items():
        rows, sag = view.driven[:, joint], sags[joint]
        off, at, angle, speed = (table[rows, joint] for table in (view.error, view.command, view.position, view.speed))
        others, moves = [abs(other) for name, other in middle.items() if name != joint], np.ptp(np.sin(angle)) > 0.5
        if (turns := round(offset / TURN)) and abs(offset - turns * TURN) < 1.0 and np.ptp(off) < np.pi:
            problem = f"the position is {offset:+.3f} rad away from the command, about {turns:+.0f} turn"
            yield view.found((POSITION, joint), problem, "write `unwrap: true` into the log's YAML", error=True)
            continue
        if len(others) >= 3:
            least = min(max(0.15, 5 * float(np.quantile(others, 0.75))), max(GIVES, 5 * float(off.std())))
        else:  # the error due to gravity depends on the angle, and the error of a slow loop on the speed
            causes = np.stack([np.ones(len(angle)), np.sin(angle), speed], axis=1)
            fit = fitted(causes, off) if moves else np.array([offset, 0.0, 0.0])
            offset = float(fit[0])
            least = max(0.2 if moves else GIVES, 3 * float((off - causes @ fit).std()))
        yields = 0.3 < offset / (sag or np.inf) < 3.0
        if gain is not None and current is not None:  # the mean damping torque is zero
            pulled = -gain[rows, joint] * off
            yields |= abs(np.median(current[rows, joint] - pulled)) < 0.5 * abs(np.median(pulled))
        dead = np.ptp(view.position[:, joint]) == 0 and np.ptp(at) > 0.2  # another check reports a dead sensor
        if dead or yields or not abs(offset) > least:
            continue
        mirrored = np.ptp(at) < 0.05 and abs(offset + 2 * float(np.median(at))) < 0.05
        cause = "its sign is reversed" if mirrored else "its zero differs, or the servo has a homing offset"
        how = "sign: -1" if mirrored else f"offset: {-offset:.4g}"
        remedy = f"write `{how}` for its position under `columns:` in the YAML, or correct it in the servo"
        if np.isnan(sag) and not mirrored:
            cause += ", unless the joint's load causes it"
            remedy += "; a load's effect changes with the pose, a wrong zero's effect does not"
        problem = f"the joint is {offset:+.3f} rad from its command in every pose: {cause}"
        yield view.found((POSITION, joint), problem, remedy)


def _sags(view: View) -> np.ndarray:
    """Deflection of each joint from its command due to gravity, from masses and servo stiffness [joint] in rad; NaN if
    the robot, its servo or its gain is unknown, or if it stands on its feet."""
    robot, rows = view.robot, np.linspace(0, len(view.time) - 1, 9).astype(int)
    if robot is None or view.metadata.mount not in HOLDING or not set(view.joints) <= set(robot.joints):
        return np.full(len(view.joints), np.nan)
    columns, pose = robot.indices(view.joints), np.tile(robot.home, (len(rows), 1))
    pose[:, columns] = view.position[rows]
    weight = np.median([robot.gravity(angles)[columns] for angles in pose], axis=0)
    return np.where(view.stiffness > 0, -weight / view.stiffness, np.nan)


@check("coarse steps")
def coarse(view: View) -> Found:
    """The values do not have the sensor's step size: they were rounded or are in another unit."""
    make, exact = view.make, view.position_unit
    counts = {} if make is None else {POSITION: exact, VELOCITY: make.counts.velocity and make.counts.velocity.si}
    for key, usual in ((key, usual) for key, usual in {POSITION: exact, **_ROUGHEST}.items() if key in view.log):
        steps, most = view.steps(key), np.abs(view.log.array(key)).max(0)
        typical = float(np.median(steps[steps > 0])) if steps.any() else 0.0
        least = 0.008 if key == POSITION and make is None else 4 * usual
        # bounds report rates and currents in another unit
        for joint in np.flatnonzero((steps > 0) & ((key == POSITION) | (most <= CHANNELS[key].quantity.bound))):
            unit = likely_unit(float(steps[joint] / exact), "rad", 0.003) if key == POSITION else None
            parts, others = (size / count if (count := counts.get(key)) else 1.0 for size in (steps[joint], typical))
            whole = round(parts) if parts > 1 else 1.0 if abs(others - 1) < 0.03 else 1 / round(1 / parts)
            decimal = abs(np.log10(steps[joint]) - np.round(np.log10(steps[joint]))) < 1e-3
            if unit and not exact / 2 < steps[joint] <= least:  # otherwise a finer encoder, or this one
                problem, remedy = f"{usual:.4g} or less, as if they were in {unit}", "convert them to radians"
            elif steps[joint] > least or (decimal and parts > 1):
                problem, remedy = f"{usual:.4g} or less", "write them with more digits"
            elif abs(parts / whole - 1) > 0.03 and not decimal:
                problem, remedy = f"{count:.4g}: the values are scaled, or come from another servo", "check their unit"
            else:
                continue
            problem = f"the values come in steps of {steps[joint]:.4g}; a servo's steps are {problem}"
            yield view.found((key, joint), problem, remedy, error=bool(unit))


@check("bounds")
def bounds(view: View) -> Found:
    """A value is outside the plausible range of its unit, in single rows or throughout."""
    near = np.median(np.abs(view.error), axis=0) < 1.0
    for key in view.log.channels:
        quantity, values, angles = CHANNELS[key].quantity, view.log.array(key), key in (POSITION, COMMAND)
        if quantity.binary or (-quantity.bound <= values.min() and values.max() <= quantity.bound):
            continue
        wrong, most = np.abs(values) > quantity.bound, np.abs(values).max(0)
        if angles:
            counts = (view.position - view.position[0]) / view.position_unit
            exact = np.abs(counts - np.round(counts)).max(0) < 0.02  # encoder counts fit rad but no other unit
            wrong &= ~((_goes_round(view, quantity.bound) | exact) & near)
        if not len(names := np.flatnonzero(wrong.any(0))):
            continue
        single = float(wrong[:, names].mean()) < 0.02 and len(values) > 50
        few = key[0] == "joint" and key[1] in _ASIDE and (2 * len(names) < wrong.shape[1] or single)
        for index in names if few else names[:1]:
            row, column = int(wrong[:, index].argmax()), values[:, index]
            likely, remedy, error = quantity.mistake, quantity.remedy, not few
            if angles and view.metadata.robot_file is None:
                remedy += ", or give robot=<file> if a robot file states their unit"
            alone = (most > quantity.bound).sum() == 1 < len(most) - 1
            rarely = wrong[:, index].mean() < _RARELY and most[index] < 4 * np.pi
            if angles and rarely and np.abs(np.diff(column)).max() < _SMOOTH:
                likely, remedy, error = "is reached without a jump", "check whether the column is in radians", False
            elif single:
                likely, remedy = "occurs in single rows only", "remove these rows"
            elif angles and alone and column.min() >= -1 and quantity.bound < column.max() <= 101:
                likely = "looks like percent of a gripper's opening, since no other joint exceeds its bound"
                remedy = "write the gripper's range [rad] divided by 100 as `unit:` of the column in the YAML"
            elif "degrees" in likely and "per second" not in likely and most[index] > 360 and not (column % 1).any():
                likely = "looks like counts of an encoder"
            problem = f"{column[row]:.10g} is beyond {quantity.bound:g} {quantity.unit}".rstrip()
            yield view.found((key, index), f"{problem} and {likely}", remedy, row, aside=few, error=error)


def _goes_round(view: View, bound: float) -> np.ndarray:
    """Which joints turn more than once, confirmed by their velocities in rad/s, provided that most joints do not,
    ``[joint]``."""
    far, fit = np.abs([view.position, view.command]).max((0, 1)) > bound, view.rates
    if fit is None or 2 * far.sum() >= len(far):
        return np.zeros(len(far), bool)
    return far & (fit.own > SURE) & (np.abs(np.diagonal(fit.ratio) - 1) < 0.1)


@check("impossible speed", rows=2, unless="bounds, lost turns")
def impossible_speed(view: View) -> Found:
    """A position changes faster between rows than any servo can move, or jumps between periods of smooth motion."""
    steps, taken = np.diff(view.position, axis=0), np.diff(view.time)
    row = np.arange(len(steps))[:, None]
    moved = np.maximum.accumulate(np.where(steps != 0, row, -1), axis=0)
    stood = np.concatenate([np.zeros((1, steps.shape[1])), row[:-1] - moved[:-1]])  # preceding rows without new values
    far = np.abs(steps) > _FASTEST * taken[:, None] * (1 + stood) + _JUMP
    rows, joints = np.nonzero(np.abs(steps[3:-3]) > _SPIKE)
    rows = rows + 3
    leap, beside = steps[rows, joints], steps[rows[:, None] + np.array([-3, -2, -1, 1, 2, 3]), joints[:, None]]
    usual = np.median(beside, axis=1)
    # the largest neighbouring difference may be the jump back
    spread = np.sort(np.abs(beside - usual[:, None]), axis=1)[:, -2]
    typical = np.array([np.quantile(np.abs(s[s != 0]), 0.95) if s.any() else 0.0 for s in steps.T])
    spread = np.where(spread > 0, spread, typical[joints])  # for a joint that stands still or is read less often
    back = np.abs(beside[:, 2:4] + leap[:, None]).min(1) < 0.3 * np.abs(leap)
    alone = (np.abs(leap - usual) > _SPIKE) & (np.abs(leap / (1 + stood[rows, joints]) - usual) > 8 * spread)
    far[rows, joints] |= alone & (taken < 1.5 * view.interval)[rows] & (back | (view.interval < _SHORT))
    for at, joint in np.argwhere(far)[:1]:
        returns = at > 0 and abs(steps[at - 1, joint] + steps[at, joint]) < 0.3 * abs(steps[at, joint])
        at = at - 1 if returns else at
        problem = f"position jumps by {steps[at, joint]:+.3f} rad in one row, faster than a servo moves"
        remedy = "remove the row, or repair the encoder or the bus"
        sent, near = np.abs(np.diff(view.command[:, joint])), slice(max(at - 10, 0), at + 10)
        if not returns and sent[near].max() == sent[at] > 5 * np.median(sent[near]) > 0:
            problem += ", and so does its command: rows are missing there without a gap in the times"
            remedy = "find out why rows are lost, and record the measured times"
        yield view.found((POSITION, joint), problem, remedy, at + 1, error=True)
