"""Checks of whether joints follow their commands: throughout, and at every time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import maximum_filter1d

from op3.rollout.health.finding import COMMAND, CURRENT, ERROR, POSITION, WARNING, LogFinding, View, check
from op3.rollout.health.match import SURE, delayed, fitted, longest_run, match
from op3.rollout.health.still import commands_stop
from op3.rollout.metadata import HOLDING

_UNRELATED = 0.5
"""Correlation with its command, at the best delay, that a position is not below: 0.57 in 3,400 joints of sound logs,
where a late and undamped loop swings by three times what it is told."""

_PERIOD = 0.02
"""Time from row to row in which motions are looked at [s]."""

_LEAVE = "leave this time out, and look at the servo's supply, its errors and its torque switch"

_LETS_GO = 0.14
"""Shortest time for which a joint that lets go is reported [s]."""

_RECENT = (0.12, 0.25)
"""A joint that follows is between the least and the largest of the targets of so long, quick or slow as it is [s]."""

_FAR, _TIMES, _CARRIED = 0.1, 3.0, 2.5
"""A joint that lets go is beyond its recent targets by at least the first [rad], and by the second times as much as at
other times. If its range of motion on the way there is the third times that distance, it only yields to its load."""

_PUSHES = 0.3
"""A servo that gives so much of its usual current or duty has not let go, but friction or an obstacle holds it."""

_PULLS, _SPEEDS, _WITHIN = 0.15, 0.25, 0.1
"""A joint that is driven comes nearer to its targets by this share of its distance, or of what it moves at its fastest,
within this time [s] at least."""


@check("lets go", unless=("position against command", "two clocks", "time jumps", "stale readings"))
def lets_go(view: View) -> Iterator[LogFinding]:
    """For a while a joint takes no current where its error asks for it, or stays beyond all its recent targets and is
    not pulled towards them, much further off than at other times. Without a current it is not reported within 0.1 rad
    of its recent targets, nor where it moves the others as well, nor of a lone servo, which friction may hold."""
    if len(view.time) < 50 or view.metadata.fallen:
        return
    reported: set[int] = set()
    for key, gain in ((CURRENT, view.get(("command", "p_gain"))), (("joint", "duty"), view.duty_gain)):
        values = view.get(key)
        for joint in range(len(view.joints)) if values is not None and gain is not None else ():
            assert values is not None
            assert gain is not None
            wanted, on = gain[:, joint] * (view.command - view.position)[:, joint], view.driven[:, joint]
            law = np.column_stack([wanted, np.gradient(view.position[:, joint], view.time)])
            wanted = law @ fitted(law[on], values[on, joint])
            run = _without(values[:, joint], wanted, on, view.interval)
            if run is not None:
                reported.add(joint)
                first, last = run
                worst = first + int(np.abs(wanted[first : last + 1]).argmax())
                problem = f"{key[1]} is {values[worst, joint] + 0.0:.2g} where its law gives {wanted[worst]:.2g}, for "
                problem += f"{view.time[last] - view.time[first]:.2g} s: the servo had let go"
                yield view.found(WARNING, (POSITION, joint), problem, _LEAVE, first, last)
    yield from _astray(view, reported | commands_stop(view).keys())


def _without(values: np.ndarray, wanted: np.ndarray, driven: np.ndarray, interval: float) -> tuple[int, int] | None:
    """First and last row in which nothing is given, where much is asked for in some, and at other times it is given."""
    size = np.abs(wanted)
    if not driven.any() or (asked := 0.5 * float(np.quantile(size[driven], 0.95))) <= 0:
        return None
    much = driven & (size > asked)
    none = much & (np.abs(values) < 0.1 * size)
    first, length = longest_run(none)
    rest = driven & ~none & (size > 0.25 * asked)
    others = np.abs(values[rest]) / size[rest]
    given = len(others) > 10 and float(np.median(others)) > 0.3
    if not given or length < max(3, round(_LETS_GO / interval)):
        return None
    start, end = _around(np.abs(values) < 0.1 * asked, first)
    return min(start, first), max(end, first + length) - 1


def _around(rows: np.ndarray, row: int) -> tuple[int, int]:
    """The run of truths [row] in which a row lies, and the row behind it."""
    away = np.flatnonzero(~rows)
    before, behind = away[away < row], away[away >= row]
    return int(before[-1] + 1) if len(before) else 0, int(behind[0]) if len(behind) else len(rows)


def _astray(view: View, reported: set[int]) -> Iterator[LogFinding]:
    stride = max(1, round(_PERIOD / view.interval))
    angle, target, period = view.position[::stride], view.command[::stride], stride * view.interval
    if len(angle) < 50 or period > 2 * _PERIOD or len(view.joints) == 1:
        return  # friction holds a lone servo with a low gain as far, and no other joint says that it should go on
    most_shaken = len(view.joints) / 2 if view.metadata.mount in HOLDING else 1
    drives = [view.get(CURRENT), view.get(("joint", "duty"))]
    ahead, rows = (max(2, round(time / period)) for time in (_WITHIN, _LETS_GO))
    driven = view.driven[::stride]
    for recent in _RECENT:
        past = max(1, round(recent / period))
        (least, most), (switched, _) = _recent(target, past), _recent(driven, past)
        # another zero is another check's
        error = np.where(switched | ~switched.any(0), angle - target, np.nan)
        mean = angle - np.nanmedian(error, axis=0)
        off = np.where(switched, mean - np.clip(mean, least, most), 0.0)
        for joint in (j for j in range(len(view.joints)) if j not in reported):
            found, usual = _let_go(angle[:, joint], off[:, joint], switched[:, joint], ahead, rows, past)
            if not found:
                continue
            first, end, far = found[0]
            given = [np.abs(values[::stride, joint]) for values in drives if values is not None]
            if any(np.median(size[first:end]) > _PUSHES * np.median(size) for size in given):
                continue
            if (np.abs(np.delete(off[first:end], joint, axis=1)).max(0) > far / 3).sum() >= most_shaken:
                continue  # a push, or on its feet the weight
            reported.add(joint)
            more = f" and {len(found) - 1} times more" if len(found) > 1 else ""
            problem = f"the joint stays {far:.2g} rad beyond all its targets of {recent} s, for "
            problem += f"{(end - first) * period:.2g} s{more}, and {usual:.2g} rad otherwise: "
            problem += "its torque was off, or it was blocked"
            last = min((end - 1) * stride, len(view.time) - 1)
            yield view.found(WARNING, (POSITION, joint), problem, _LEAVE, first * stride, last)


def _recent(values: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest of a row's values and those of so many rows before [row, joint]."""
    before = np.pad(values, ((rows, 0), (0, 0)), "edge")
    windows = np.lib.stride_tricks.sliding_window_view(before, rows + 1, axis=0)
    return windows.min(-1), windows.max(-1)


def _let_go(
    angle: np.ndarray, off: np.ndarray, driven: np.ndarray, ahead: int, rows: int, past: int
) -> tuple[list[tuple[int, int, float]], float]:
    """Where a joint that is so far off [row] is not pulled back in the next rows, and much further off than otherwise:
    first row, the row behind, and how far off, of each time; and how far it is off otherwise."""
    moved = angle[ahead:] - angle[:-ahead]
    windows, nearer = (np.lib.stride_tricks.sliding_window_view(x[: len(moved)], rows) for x in (off, -np.sign(off)))
    nearer = (nearer * np.lib.stride_tricks.sliding_window_view(moved, rows)).mean(1)
    least = np.minimum(_PULLS * np.abs(windows).mean(1), _SPEEDS * np.quantile(np.abs(moved), 0.98))
    stays = np.where(nearer < least, np.maximum(windows.min(1), -windows.max(1)), 0.0)
    # a target that passes by a joint that hangs, and the way back, belong to it
    near, away, found = maximum_filter1d(np.abs(off), 2 * past + 1), np.zeros(len(off), bool), []
    while (most := float(stays.max())) > _FAR:
        first, end = _around(near > most / 6, int(stays.argmax()))
        worst = first + int(np.abs(off[first:end]).argmax())
        found.append((first, end, float(np.abs(off[worst])), float(np.ptp(angle[first : worst + 1]))))
        away[first:end], stays[max(first - rows + 1, 0) : end] = True, 0.0
    rest = np.abs(off[driven & ~away])
    usual = np.inf if 2 * len(rest) < driven.sum() or not found else float(np.quantile(rest, 0.98))
    sure = [one for one in found if one[2] > _TIMES * usual and one[3] < _CARRIED * one[2]]
    return sorted(one[:3] for one in sure), usual


@check("position without its command", unless=("position against command", "two clocks", "stands still", "lets go"))
def unrelated(view: View) -> Iterator[LogFinding]:
    """A position does not follow its command at any delay: it is another joint's or recording's, or the
    command is a torque. Not on its feet, where the weight moves soft joints against their commands."""
    if view.metadata.mount not in HOLDING:
        return
    stride = max(1, round(_PERIOD / view.interval)) if len(view.time) >= 20 else 1
    angle, target, driven = (a[::stride] for a in (view.position, view.command, view.driven))
    gain, current = view.get(("command", "p_gain")), view.get(CURRENT)
    explained = np.zeros(len(view.joints), bool)
    if gain is not None and current is not None:  # a soft joint that yields, and pulls by as much
        explained = np.diagonal(match(current, gain * (view.command - view.position)).correlation) > SURE
    asked, torques, lost = 0, set[int](), dict[int, float]()
    for joint in range(len(view.joints)):
        a, t = angle[driven[:, joint], joint], target[driven[:, joint], joint]
        if len(a) < 20 or np.ptp(t) < 0.1 or np.ptp(a) < 0.05:
            continue
        asked += 1
        best = max(delayed(a, t, n) for n in range(0, min(26, len(a) // 4), 2))
        if best < _UNRELATED and not explained[joint]:
            lost[joint] = best
            if driven[:, joint].all() and _as_torque(a, t, stride * view.interval):
                torques.add(joint)
    for joint, best in lost.items():
        problem = f"the position does not follow its command (correlation {best:.2f})"
        if joint in torques and 2 * len(torques) > asked:
            problem += ", which goes with its acceleration, speed and gravity as a torque does"
            remedy = "name the command <joint>.load under `columns:`, and give targets of positions"
            yield view.found(ERROR, (COMMAND, joint), problem, remedy)
        else:
            remedy = "look whether both are of this joint and of the same recording"
            yield view.found(WARNING, (POSITION, joint), problem, remedy)


def _as_torque(angle: np.ndarray, told: np.ndarray, period: float) -> bool:
    """Whether a motion explains a command as the torque that drives it; of a single sine anything does."""
    width = max(1, round(0.06 / period))
    speed = np.gradient(np.convolve(angle, np.ones(width) / width, "same"), period)
    causes = [np.ones(len(angle)), angle, speed, np.gradient(speed, period), np.tanh(speed / 0.05), np.sin(angle)]
    as_torque = _left(told, causes, 2 * width)
    return as_torque < 0.2 and _left(angle, [causes[0], told, np.gradient(told, period)], 2 * width) > 0.03


def _left(values: np.ndarray, causes: list[np.ndarray], ends: int) -> float:
    """Share of values that a linear fit of causes leaves, without so many rows at both ends."""
    inside = slice(ends, -ends)
    goal, table = values[inside], np.stack(causes, axis=1)[inside]
    rest = goal - table @ fitted(table, goal)
    return float(rest.var() / max(goal.var(), 1e-12))
