"""Checks of frozen or clipped channels, and of joints that lose their torque."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.signal import detrend

from op3.rollout.health.log_view import Found, View, check
from op3.rollout.keys import COMMAND, CURRENT, FORCE, ORIENTATION, POSITION, RATE, TEMPERATURE, VELOCITY, VOLTAGE
from op3.rollout.match import GIVES, SURE, delays, fitted, integral, longest_run, match, runs, unexplained
from op3.rollout.metadata import HOLDING

_SHAKEN = 0.1  # largest spread of a held trunk's accelerations [m/s2]; 0.08 in 179 logs, 0.44 when standing
_SETTLES = 0.5  # time in which a servo reaches a constant target [s]
_REPAIR = "repair the program that reads or writes it"
_PERIOD = 0.02  # row interval at which motions are examined [s]
_UNRELATED = 0.5  # reported correlation with the command at the best delay; at least 0.57 in 3,400 joints of sound logs
_LETS_GO = 0.14  # shortest reported loss of torque [s]
_RECENT = (0.12, 0.25)  # a fast or slow joint that follows stays within the targets of this last time [s]
_STICKS = 1.0  # reported range of commands while a joint of a standing robot sticks [rad]; 0.73 in policies' logs
_NONE = 0.1  # a current below this share of the control law's counts as none
_PUSHES = 0.3  # a servo with this share of its usual current still drives; friction or an obstacle holds it

_FAR, _TIMES = 0.1, 3.0  # a joint that lets go is so far beyond these [rad], and so many times as far as otherwise
_CARRIED = 2.5  # if its range of motion is this many times that distance, the joint only yields to its load
_WITHIN, _PULLS, _SPEEDS = 0.1, 0.15, 0.25  # a driven joint comes nearer by so much of it, or of its fastest, in [s]

_RELATED = "position against command, two clocks"
_LEAVE = "remove this time span, and check the servo's supply, its errors and torque_enable"


@check("saturated", unless="stale readings")
def saturated(view: View) -> Found:
    """A rate or acceleration is clipped at its largest value."""
    for key, index, column in view.columns(VELOCITY, RATE, FORCE):
        top, size = np.abs(column).max(), float(view.steps(key)[index])
        flat = np.abs(column) == top
        within = flat[1:-1] & flat[:-2] & flat[2:]
        first, length = longest_run(flat)
        if top < 3 * size or not top or not max(0.002, 3 / len(flat)) < within.mean() < 0.6:
            continue
        last, faster, leaps = first + length - 1, 0.0, np.abs(np.diff(column))
        if key == VELOCITY and len(runs(within)) > 1:  # a single period is a constant channel
            count = view.steps(POSITION)[index] / (2 * view.interval * np.sqrt(within.sum()))
            faster = float(np.abs(view.speed[1:-1, index][within]).mean() - count)
        aside = faster > 1.15 * top + size  # a smaller excess may be a scale error
        beside = min((leaps[row] for row in (first - 1, last) if 0 <= row < len(leaps)), default=0.0)
        if aside or (key != VELOCITY and beside > max(5 * size, 0.05 * top)):
            how = f"while the joint moves at {faster:.3g} rad/s" if aside else "with fast changes before and after"
            problem = f"the value stays at {top:.4g} for up to {length} rows, {how}: it is clipped"
            remedy = "set a larger sensor range, or record slower motions"
            yield view.found((key, index), problem, remedy, first, last, aside=aside)


@check("stuck value", rows=21)
def stands_still(view: View) -> Found:
    """A channel is constant while the joint moves, or a position is constant while its command changes."""
    rows = max(1, round(0.2 / view.interval))
    yield from _sensors_stand(view, rows)
    for joint, (first, last, moved) in commands_stop(view).items():
        problem = f"the target does not change for {last - first} rows, while the joint moves by {moved:.3g} rad"
        remedy = "record the targets that were sent, or cut the log here; check also whether torque was off"
        yield view.found((COMMAND, joint), problem, remedy, first, last)
    for _, joint, velocity in view.columns(VELOCITY):
        yield from _velocity_stands(view, joint, velocity, rows)
    for joint, (position, target, off) in enumerate(zip(view.position.T, view.command.T, view.off.T, strict=True)):
        yield from _position_stands(view, joint, position)
        if np.ptp(target) == 0 and view.driven[:, joint].all() and (moved := np.ptp(position)) > GIVES:
            problem = f"target stays at {target[0]:.4g} rad in every row while the joint moves by {moved:.3g} rad"
            remedy = "record the targets that were sent, or `torque_enable: 0` if the joint was moved by hand"
            yield view.found((COMMAND, joint), problem, remedy)
        if off.sum() * view.interval > 1 and _follows(target[off], position[off], view.stride(0.05)):
            problem = "the joint follows its target although its torque is off according to the log"
            yield view.found((COMMAND, joint), problem, "correct torque_enable")


def _follows(target: np.ndarray, angle: np.ndarray, late: int) -> bool:
    """Whether a joint follows its target with this delay in rows, rather than the target a joint moved by hand."""
    if len(target) < 10 * late or min(np.ptp(target), np.ptp(angle)) < 0.2:
        return False
    after, before = delays(angle, target, (late, -late))
    return after > SURE and 1 - after < 0.5 * (1 - before) and 0.5 < np.ptp(angle) / np.ptp(target) < 2


def commands_stop(view: View) -> dict[int, tuple[int, int, float]]:
    """Joints that keep moving although their targets stay constant: first row, last row, and movement [rad]."""
    found, settles, asked = {}, round(_SETTLES / view.interval), np.ptp(view.command, axis=0)
    for joint in np.flatnonzero(asked > 0.1).tolist():
        first, length = longest_run(np.diff(view.command[:, joint]) == 0)
        last, off = first + length, np.abs(view.error[:, joint])
        moved = float(np.ptp(view.position[first + settles : last + 1, joint])) if length >= 2 * settles else 0.0
        goes_on = length > 3 * settles and moved > 0.5 * asked[joint]
        # the next target is the joint's position
        resumes = last + 1 < len(off) and off[last] > 4 * max(off[[first, last + 1]])
        if moved > 0.1 and (goes_on or resumes) and view.driven[first : last + 1, joint].all():
            found[joint] = first, last, moved
    return found


def _velocity_stands(view: View, joint: int, velocity: np.ndarray, rows: int) -> Found:
    first, length = longest_run(np.diff(velocity) == 0)
    if length <= 2 * rows:
        return
    part = slice(first, first + length + 1)
    angle, time = view.position[part, joint], view.time[part]
    speed = (angle[rows:] - angle[:-rows]) / (time[rows:] - time[:-rows])
    fastest = speed[np.abs(speed - velocity[first]).argmax()]
    # a velocity may be constant while the joint is slower than one step of it
    if abs(fastest - velocity[first]) > max(0.15, 3 * view.steps(VELOCITY)[joint]):
        stays = f"velocity stays at {velocity[first]:.4g} rad/s for {length} rows"
        problem = f"{stays}, while the joint moves at up to {fastest:.3g} rad/s"
        yield view.found((VELOCITY, joint), problem, _REPAIR, first, first + length, aside=True)


def _position_stands(view: View, joint: int, position: np.ndarray) -> Found:
    first, length = longest_run(np.diff(position) == 0)
    last, dead = first + length, length >= len(position) - 2
    if length * view.interval <= 0.5:
        return
    rows = slice(first, last + 1)
    # distance, not total movement: a soft joint may stand while a policy's targets oscillate around it
    heeded = slice(first, max(last - round(0.2 / view.interval), first) + 1)
    asked = float(np.ptp(view.command[heeded, joint])) if view.driven[rows, joint].all() else 0.0
    others = np.flatnonzero(np.ptp(view.position, axis=0)) if dead and asked > 0.1 else []
    command, error = view.command[:, others], view.error[:, others]  # of joints that follow by less than it should
    follow = error.size >= 20 and view.driven[:, others].all() and np.ptp(command, axis=0).max() > 0.7 * asked
    far = asked > (0.4 if view.metadata.mount in HOLDING else _STICKS)
    if far or (follow and asked > 1.5 * np.ptp(error, axis=0).max()):
        problem = f"position stays at {position[first] + 0.0:.4g} rad while its command moves by {asked:.3g} rad"
        all_dead = dead and bool((np.ptp(view.position, axis=0) == 0).all())
        remedy, aside = "check whether the joint is blocked or its sensor is dead", dead and not all_dead
        yield view.found((POSITION, joint), problem, remedy, first, last, aside=aside, error=all_dead)


def _sensors_stand(view: View, rows: int) -> Found:
    """A sensor has the same implausible value in every row, or the values of a current or inertial sensor are constant
    for much longer than elsewhere while a joint moves."""
    gyroscope, angles = turned_by_gyroscope(view), view.get(ORIENTATION)
    tilted = angles is not None and bool((np.ptp(angles, axis=0) > 0.1).any())
    turns = bool((np.ptp(gyroscope, axis=0) > 0.05).any()) and not held(view)
    for key in (key for key in (CURRENT, VOLTAGE, TEMPERATURE, ORIENTATION, RATE, FORCE) if key in view.log):
        values, trunk, name = view.log.array(key), key[0] == "imu", key[1].replace("_", " ")
        for index, part in enumerate([values] if trunk else values.T[:, :, None]):
            same, zero = (np.diff(part, axis=0) == 0).all(1), not part[0].any()
            first, length = longest_run(same)
            run = slice(first, first + length + 1)
            # only alternating rotation counts, because a gyroscope has a bias
            through = view.position if trunk else view.position[:, [index]]
            path = detrend(gyroscope[run], axis=0) if key == ORIENTATION else through[run]
            moved = np.ptp(path, axis=0).max() > (0.05 if key == ORIENTATION else 0.2)
            driven, most = view.driven[run, index].mean() > 0.1, np.abs(part).max()
            if length == len(same):  # a robot that does not rotate has no rates and a constant orientation
                dead = {CURRENT: moved and driven, ORIENTATION: turns, RATE: tilted, FORCE: zero or tilted}
                problem, when, stuck = f"{name} stays at {{:.4g}} in every row", (), dead.get(key, zero)
            else:
                size, same[run] = abs(part[first, 0]), False
                error = np.abs(view.error[:, index if key == CURRENT else 0])
                limp = not driven or np.median(error[run]) > _TIMES * np.median(error)  # reported as such
                limited = key == CURRENT and (size == most or (size == 0 and limp))
                longer = key == ORIENTATION or length > 5 * max(longest_run(same)[1], 1)
                stuck = length > 2 * rows and moved and not limited and longer and key not in (VOLTAGE, TEMPERATURE)
                problem = f"the values of {name} are constant for {length} rows while the robot moves"
                when = first, first + length
            for column, value in enumerate(part[0]) if stuck else ():
                yield view.found((key, index + column), problem.format(value), _REPAIR, *when, aside=True)


def held(view: View) -> bool:
    """Whether a quiet accelerometer shows a held trunk, which rotates no more than its orientation states."""
    force = view.get(FORCE)
    return force is not None and 0 < float(force.std(0).max()) < _SHAKEN


def turned_by_gyroscope(view: View) -> np.ndarray:
    """Integral of the gyroscope [time, axis] without its bias and single wrong readings."""
    if RATE not in view.log:
        return np.zeros((len(view.time), 3))
    rates = view.log.array(RATE).copy()
    rates[1:-1] = np.median([rates[:-2], rates[1:-1], rates[2:]], axis=0)
    # the bias is the median, because a final fall would dominate the mean
    return integral(view.time, rates - np.median(rates, axis=0))


@check("torque lost", rows=50, unless=f"{_RELATED}, lost turns, time jumps, stale readings")
def lets_go(view: View) -> Found:
    """For some time a joint has no current although its error requires one, or, if no current was measured, stays far
    beyond its recent targets. The latter is not reported within 0.1 rad of these targets, for a single servo, which
    friction may hold, or if another joint of a robot on its feet is displaced too."""
    if view.metadata.fallen:
        return
    reported = {*commands_stop(view)}
    for key, values, gain in view.drives:
        if gain is None:
            continue
        for joint in range(len(view.joints)):
            speed, given = view.speed[:, joint], values[:, joint]
            law = np.column_stack([-gain[:, joint] * view.error[:, joint], speed])
            # at its free speed towards the target a servo takes no current
            fast = (view.error[:, joint] * speed < 0) & (np.abs(speed) > 0.5 * np.quantile(np.abs(speed), 0.98))
            on = view.driven[:, joint] & ~fast
            some = on & (np.abs(given) > _NONE * np.quantile(np.abs(given), 0.95))  # the law holds where it has torque
            wanted = law @ fitted(law[some], given[some])
            for first, last in _without(given, wanted, on, view.interval):
                reported.add(joint)
                worst = first + int(np.abs(wanted[first : last + 1]).argmax())
                problem = f"{key[1]} is {given[worst] + 0.0:.2g} but its control law requires {wanted[worst]:.2g}, for "
                problem += f"{view.time[last] - view.time[first]:.2g} s: the servo had no torque"
                yield view.found((POSITION, joint), problem, _LEAVE, first, last)
    yield from _astray(view, reported)


def _without(given: np.ndarray, wanted: np.ndarray, driven: np.ndarray, interval: float) -> list[tuple[int, int]]:
    """First and last rows of periods without the current that the control law requires, if it flows at other times."""
    size = np.abs(wanted)
    if not driven.any() or (asked := 0.5 * float(np.quantile(size[driven], 0.95))) <= 0:
        return []
    none = driven & (size > asked) & (np.abs(given) < _NONE * size)
    first, length = longest_run(none)
    if length < max(3, round(_LETS_GO / interval)) or (driven & ~none & (size > 0.25 * asked)).sum() <= 10:
        return []
    around = runs(none | (np.abs(given) < _NONE * asked)).tolist()
    return [(start, end - 1) for start, end in around if start <= first < end]


def _astray(view: View, reported: set[int]) -> Found:
    angle, target, driven, stride = view.thinned(_PERIOD)
    period = stride * view.interval
    if len(angle) < 50 or period > 2 * _PERIOD or len(view.joints) == 1:
        return  # friction holds a single servo with a low gain as far away, and no other joint allows a comparison
    for recent in _RECENT:
        past = max(1, round(recent / period))
        before = {"size": past + 1, "axis": 0, "mode": "nearest", "origin": past // 2}  # a row and the rows before it
        least, most = minimum_filter1d(target, **before), maximum_filter1d(target, **before)
        switched = minimum_filter1d(driven.astype(np.int8), **before) == 1
        # another check reports a wrong zero
        mean = angle - np.nanmedian(np.where(switched | ~switched.any(0), angle - target, np.nan), axis=0)
        off = np.where(switched, mean - np.clip(mean, least, most), 0.0)
        for joint in (j for j in range(len(view.joints)) if j not in reported):
            found, usual = _let_go(angle[:, joint], off[:, joint], switched[:, joint], period, past)
            for first, end, far in found[:1]:
                rows = np.s_[first * stride : end * stride, joint]
                holds = False
                for _, values, gain in view.drives:
                    asked = _PUSHES * values[:, joint] if gain is None else _NONE * gain[rows] * view.error[rows]
                    holds |= bool(np.median(np.abs(values[rows])) > np.median(np.abs(asked)))
                shaken = (np.abs(np.delete(off[first:end], joint, axis=1)).max(0) > far / 3).any()
                if holds or (shaken and view.metadata.mount not in HOLDING):
                    continue  # a push, or the weight
                reported.add(joint)
                more = f", and again {len(found) - 1} times," if len(found) > 1 else ""
                problem = f"for {(end - first) * period:.2g} s{more} the joint stays {far:.2g} rad beyond all its "
                problem += f"targets of the last {recent} s, but only {usual:.2g} rad at other times: "
                problem += "its torque was off, or it was blocked"
                last = min((end - 1) * stride, len(view.time) - 1)
                yield view.found((POSITION, joint), problem, _LEAVE, first * stride, last)


def _let_go(angle: np.ndarray, off: np.ndarray, driven: np.ndarray, period: float, past: int) -> tuple[list, float]:
    """Periods in which a joint is much further from its target than at other times, `off` [row], and is not pulled
    back: first row, end row and distance; and its usual distance."""
    ahead, rows = (max(2, round(time / period)) for time in (_WITHIN, _LETS_GO))
    moved = angle[ahead:] - angle[:-ahead]
    back = -np.sign(off[: len(moved)]) * moved
    windows, nearer = (np.lib.stride_tricks.sliding_window_view(x, rows) for x in (off[: len(moved)], back))
    least = np.minimum(_PULLS * np.abs(windows).mean(1), _SPEEDS * np.quantile(np.abs(moved), 0.98))
    stays = np.where(nearer.mean(1) < least, np.maximum(windows.min(1), -windows.max(1)), 0.0)
    # includes targets that pass a hanging joint, and the return
    near, rest, found = maximum_filter1d(np.abs(off), 2 * past + 1), driven.copy(), []
    for first, end in runs(near > max(float(stays.max()), _FAR) / 6).tolist():
        if stays[first:end].max(initial=0.0) > _FAR:
            worst, rest[first:end] = first + int(np.abs(off[first:end]).argmax()), False
            found.append((first, end, float(np.abs(off[worst])), float(np.ptp(angle[first : worst + 1]))))
    usual = float(np.quantile(np.abs(off[rest]), 0.98)) if found and 2 * rest.sum() >= driven.sum() else np.inf
    return [time[:3] for time in found if time[2] > _TIMES * usual and time[3] < _CARRIED * time[2]], usual


@check("position without its command", unless=f"{_RELATED}, lost turns, stuck value, torque lost")
def unrelated(view: View) -> Found:
    """A position does not follow its command at any delay: it belongs to another joint or recording, or the command is
    a torque. This is not checked on the floor, where the robot's weight moves soft joints against their commands."""
    if view.metadata.mount not in HOLDING:
        return
    angle, target, driven, stride = view.thinned(_PERIOD)
    pulled, lost, torques, asked = np.zeros(len(view.joints), bool), dict[int, float](), set[int](), 0
    for key, values, gain in view.drives:
        if key == CURRENT and gain is not None:  # a soft joint that yields with a matching current
            pulled = match(values, -gain * view.error).own > SURE
    for joint, on in enumerate(driven.T):
        a, t = angle[on, joint], target[on, joint]
        if len(a) < 20 or np.ptp(t) < 0.1 or np.ptp(a) < 0.05:
            continue
        asked += 1
        best = delays(a, t, range(0, min(26, len(a) // 4), 2)).max()
        if best < _UNRELATED and not pulled[joint]:
            lost[joint] = best
            torques |= {joint} if on.all() and _is_torque(a, t, stride * view.interval) else set()
    for joint, best in lost.items():
        where = (COMMAND if joint in torques and 2 * len(torques) > asked else POSITION), joint
        problem = f"the position does not follow its command (correlation {best:.2f})"
        remedy = "check whether both belong to this joint and to the same recording"
        if error := where[0] == COMMAND:
            problem += ", and the command depends on acceleration, speed and gravity like a torque"
            remedy = "name the command <joint>.load under `columns:`, and record position targets"
        yield view.found(where, problem, remedy, error=error)


def _is_torque(angle: np.ndarray, command: np.ndarray, period: float) -> bool:
    """Whether the command can be the torque that drives the motion; not decidable from motion at a single frequency."""
    width = max(1, round(0.06 / period))
    speed = np.gradient(np.convolve(angle, np.ones(width) / width, "same"), period)
    ones, inside = np.ones(len(angle)), slice(2 * width, -2 * width)
    causes = np.stack([ones, angle, speed, np.gradient(speed, period), np.tanh(speed / 0.05), np.sin(angle)], axis=1)
    effects = np.stack([ones, command, np.gradient(command, period)], axis=1)
    return unexplained(command[inside], causes[inside]) < 0.2 and unexplained(angle[inside], effects[inside]) > 0.03
