"""Checks of whether joints follow their commands: throughout, and at every time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import COMMAND, CURRENT, ERROR, POSITION, WARNING, LogFinding, View, check
from op3.rollout.health.match import SURE, delayed, fitted, longest_run, match
from op3.rollout.metadata import HOLDING

_UNRELATED = 0.5
"""Correlation with its command, at the best delay, that a position is not below: 0.57 in 3,400 joints of sound logs,
where a late and undamped loop swings by three times what it is told."""

_PERIOD = 0.02
"""Time from row to row in which motions are looked at [s]."""

_LETS_GO = 0.16
"""A joint that does not follow for less is not told [s]."""

_FAR, _TIMES = 0.08, 6.0
"""Nor one that is off what its command lets expect by less [rad], or by fewer times as much as otherwise."""

_CLOSES, _WITHIN = 0.15, 0.1
"""A joint that follows comes nearer to its target by at least this share of the way within this time [s]."""


@check("lets go", unless=("position against command", "two clocks", "time jumps", "stale readings"))
def lets_go(view: View) -> Iterator[LogFinding]:
    """For a while a joint takes no current where its error asks for it, or moves otherwise than its command lets expect
    from the rest of the log, while the other joints do not."""
    if len(view.time) < 50 or view.metadata.fallen:
        return
    told: set[int] = set()
    for key, gain in ((CURRENT, view.get(("command", "p_gain"))), (("joint", "duty"), view.duty_gain)):
        values = view.get(key)
        for joint in range(len(view.joints)) if values is not None and gain is not None else ():
            assert values is not None
            assert gain is not None
            wanted = gain[:, joint] * (view.command - view.position)[:, joint]
            run = _without(values[:, joint], wanted, view.driven[:, joint], view.interval)
            if run is not None:
                told.add(joint)
                first, last = run
                worst = first + int(np.abs(wanted[first : last + 1]).argmax())
                problem = (
                    f"{key[1]} is {values[worst, joint] + 0.0:.2g} where gain times error is {wanted[worst]:.2g}, for "
                )
                problem += f"{view.time[last] - view.time[first]:.2g} s: the servo had let go"
                remedy = "leave this time out, and look at the servo's supply, its errors and its torque switch"
                yield view.found(WARNING, (POSITION, joint), problem, remedy, first, last)
    yield from _off_its_way(view, told)


def _without(values: np.ndarray, wanted: np.ndarray, driven: np.ndarray, interval: float) -> tuple[int, int] | None:
    """First and last row in which nothing is given where much is asked for, and at other times it is."""
    size = np.abs(wanted)
    if not driven.any() or (asked := 0.5 * float(np.quantile(size[driven], 0.95))) <= 0:
        return None
    much = driven & (size > asked)
    none = much & (np.abs(values) < 0.1 * size)
    first, length = longest_run(none)
    rest = driven & ~none & (size > 0.25 * asked)
    others = np.abs(values[rest]) / size[rest]
    given = len(others) > 10 and float(np.median(others)) > 0.3
    return (first, first + length - 1) if given and length >= max(3, round(_LETS_GO / interval)) else None


def _off_its_way(view: View, told: set[int]) -> Iterator[LogFinding]:
    stride = max(1, round(_PERIOD / view.interval))
    angle, target, driven = (table[::stride] for table in (view.position, view.command, view.driven))
    asked = np.ptp(target, axis=0) > 0.1
    moving = [j for j in np.flatnonzero(asked & driven.all(0)).tolist() if np.ptp(angle[:, j]) > 0.05]
    if len(angle) < 50 or stride * view.interval > 2 * _PERIOD:
        return
    period = stride * view.interval
    rests = {joint: _unexplained(angle[:, joint], target[:, joint], period) for joint in moving}
    far = {joint: rest[0] > max(_FAR, _TIMES * rest[1]) for joint, rest in rests.items() if rest is not None}
    for joint, rows in far.items():
        if joint in told:
            continue
        error, ahead = target[:, joint] - angle[:, joint], max(1, round(_WITHIN / period))
        later = angle[np.minimum(np.arange(len(angle)) + ahead, len(angle) - 1), joint]
        stuck = rows & ((later - angle[:, joint]) * np.sign(error) < _CLOSES * np.abs(error))
        first, length = longest_run(stuck)
        if length * period < _LETS_GO or np.ptp(target[first : first + length, joint]) < 0.02:
            continue
        run = slice(first, first + length)
        shaken = [other for other in far if other != joint and far[other][run].mean() > 0.3]
        if len(shaken) * 2 >= max(len(far) - 1, 1):
            continue  # something moved all of them
        usual = rests[joint]
        assert usual is not None
        problem = (
            f"the joint is {usual[0][run].max():.2g} rad off what its command lets expect, for {length * period:.2g} s,"
        )
        problem += f" and {usual[1]:.2g} rad otherwise: its torque was off, or it was blocked"
        remedy = "leave this time out, and look at the servo's supply, its errors and its torque switch"
        last = min((first + length - 1) * stride, len(view.time) - 1)
        yield view.found(WARNING, (POSITION, joint), problem, remedy, first * stride, last)


def _unexplained(angle: np.ndarray, target: np.ndarray, period: float) -> tuple[np.ndarray, float] | None:
    """How far a position [row] is off what its command of the last quarter of a second lets expect, and how far it is
    usually; None where it follows too badly to say."""
    lags = np.unique(np.round(np.array([0.0, 0.04, 0.08, 0.12, 0.18, 0.26]) / period).astype(int))
    rows = np.arange(len(angle))
    causes = [target[np.maximum(rows - lag, 0)] for lag in lags]
    causes = np.stack([*causes, np.ones(len(angle)), target**2], axis=1)
    if not np.isfinite(causes).all():  # what overflows is refused by its bound
        return None
    kept, off = np.ones(len(angle), bool), np.abs(angle)
    for _ in range(6):
        off = np.abs(angle - causes @ fitted(causes[kept], angle[kept]))
        kept = off <= max(4 * float(np.median(off)), 0.003)
    usual = float(np.quantile(off[kept], 0.98))
    return (off, usual) if kept.mean() > 0.5 and usual < 0.15 * np.ptp(target) else None


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
