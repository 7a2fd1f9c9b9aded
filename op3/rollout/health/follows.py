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

_LEAVE = "leave this time out, and look at the servo's supply, its errors and its torque switch"

_LETS_GO = 0.14
"""A joint that does not follow for less is not told [s]."""

_FAR, _FURTHER, _TIMES = 0.05, 0.1, 4.5
"""Nor one that is off what its command lets expect by less than the first while it comes no nearer, or than the second
[rad], or by fewer times as much as otherwise: 3.0 in sound logs of benches, arms and policies on their feet, and 0.08
rad of a jaw whose command is faster than it."""

_PULLS, _WITHIN = 0.15, 0.1
"""A joint that is driven comes nearer to its target by this share of its error within this time [s] at least."""

_MOVED = 0.01
"""What a joint is off usually is that where its command of the last quarter of a second spans so much [rad]."""


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
            wanted, on = gain[:, joint] * (view.command - view.position)[:, joint], view.driven[:, joint]
            law = np.column_stack([wanted, np.gradient(view.position[:, joint], view.time)])
            wanted = law @ fitted(law[on], values[on, joint])
            run = _without(values[:, joint], wanted, on, view.interval)
            if run is not None:
                told.add(joint)
                first, last = run
                worst = first + int(np.abs(wanted[first : last + 1]).argmax())
                problem = f"{key[1]} is {values[worst, joint] + 0.0:.2g} where its law gives {wanted[worst]:.2g}, for "
                problem += f"{view.time[last] - view.time[first]:.2g} s: the servo had let go"
                yield view.found(WARNING, (POSITION, joint), problem, _LEAVE, first, last)
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
    angle, target = view.position[::stride], view.command[::stride]
    period = stride * view.interval
    if len(angle) < 50 or period > 2 * _PERIOD:
        return
    moving = (np.ptp(target, axis=0) > 0.1) & (np.ptp(angle, axis=0) > 0.05) & view.driven[::stride].all(0)
    found = {joint: _unexplained(angle[:, joint], target[:, joint], period) for joint in np.flatnonzero(moving)}
    rests = {joint: rest for joint, rest in found.items() if rest is not None}
    least = {joint: max(_FAR, _TIMES * usual) for joint, (_, usual) in rests.items()}
    far = {joint: rest > least[joint] for joint, (rest, _) in rests.items()}
    ahead, rows = (max(2, round(time / period)) for time in (_WITHIN, _LETS_GO))
    for joint, off in far.items():
        error, moved = target[:, joint] - angle[:, joint], np.roll(angle[:, joint], -ahead) - angle[:, joint]
        moved[-ahead:] = 0.0
        further = rests[joint][0] > max(_FURTHER, least[joint])
        nearer, size, within, beyond = (
            np.convolve(part, np.ones(rows), "valid") for part in (moved * error, error**2, off, further)
        )
        limp = np.flatnonzero((within > rows - 0.5) & ((nearer < _PULLS * size) | (beyond > rows - 0.5)))
        if joint in told or not len(limp):
            continue
        edges = np.flatnonzero(np.diff(off, prepend=False, append=False)).reshape(-1, 2)
        first, end = max(((a, b) for a, b in edges if ((a <= limp) & (limp < b)).any()), key=lambda e: e[1] - e[0])
        shaken = [other for other in far if other != joint and far[other][first:end].mean() > 0.3]
        if len(shaken) * 2 >= max(len(far) - 1, 1) or np.ptp(target[first:end, joint]) < 0.02:
            continue  # something moved all of them, or what it carries moved it
        most = f"{rests[joint][0][first:end].max():.2g} rad off what its command lets expect"
        problem = (
            f"the joint is {most}, for {(end - first) * period:.2g} s, and {rests[joint][1]:.2g} rad otherwise: its "
        )
        problem += "torque was off, or it was blocked"
        last = min((end - 1) * stride, len(view.time) - 1)
        yield view.found(WARNING, (POSITION, joint), problem, _LEAVE, first * stride, last)


def _unexplained(angle: np.ndarray, target: np.ndarray, period: float) -> tuple[np.ndarray, float] | None:
    """How far a position [row] is off what its command of the last quarter of a second lets expect, and how far it is
    usually while that changes; None where it follows too badly to say."""
    lags = np.unique(np.round(np.array([0.0, 0.04, 0.08, 0.12, 0.18, 0.26]) / period).astype(int))
    rows = np.arange(len(angle))
    past = np.stack([target[np.maximum(rows - lag, 0)] for lag in lags], axis=1)
    causes = np.column_stack([past, np.ones(len(angle)), target**2])
    moved = np.ptp(past, axis=1) > _MOVED
    if moved.sum() < 50 or not np.isfinite(causes).all():  # what overflows is refused by its bound
        return None
    kept, off = np.ones(len(angle), bool), np.ones(len(angle))
    for _ in range(12):  # least absolute deviations, then least squares of what is near
        weight = 1 / np.sqrt(np.maximum(off, 0.003))[:, None]
        off = np.abs(angle - causes @ fitted(causes * weight, angle * weight[:, 0]))
    for _ in range(4):
        kept = off <= max(4 * float(np.median(off[moved])), 0.003)
        off = np.abs(angle - causes @ fitted(causes[kept], angle[kept]))
    off[: lags[-1]] = 0.0  # what was commanded before is not known
    usual = float(np.quantile(off[kept & moved], 0.98))
    return (off, usual) if 2 * (kept & moved).sum() > moved.sum() and usual < 0.15 * np.ptp(target) else None


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
