"""Checks of what was written in a column: another joint's numbers, a register's, single wrong ones."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import (
    COMMAND,
    CURRENT,
    ERROR,
    FORCE,
    ORIENTATION,
    POSITION,
    RATE,
    VELOCITY,
    WARNING,
    LogFinding,
    View,
    check,
)
from op3.rollout.schema import CHANNELS, Key
from op3.rollout.units import UNITS

_LEAST: dict[Key, float] = {VELOCITY: 5.0, CURRENT: 5.0, ("joint", "voltage"): 2.0, ("joint", "temperature"): 5.0}
_LEAST |= {RATE: 5.0, ORIENTATION: 0.2, FORCE: 100.0}
"""A single reading leaps at least so far, in the unit of its channel."""


@check("copied channels")
def copied(view: View) -> Iterator[LogFinding]:
    """Two joints have the same numbers in every row."""
    seen: dict[tuple[str, bytes], int] = {}
    for key, index, column in view.columns(POSITION, VELOCITY, CURRENT):
        first = seen.setdefault((key[1], np.ascontiguousarray(column).tobytes()), index)
        if first == index or np.ptp(column) <= 0.05 or len(np.unique(column)) <= 20:
            continue
        told_alike = np.array_equal(view.command[:, first], view.command[:, index])
        if view.metadata.robot == "simulated" and told_alike:  # twins of a simulation may move alike
            continue
        severity = ERROR if key == POSITION and not told_alike else WARNING
        for joint in [j for j in (index, first) if not _fits(view, key[1], j)] or [index]:
            problem = f"every row has the numbers of {view.name(key, first if joint == index else index)}"
            yield view.found(severity, (key, joint), problem, "look which of the two it is", aside=key != POSITION)


def _fits(view: View, kind: str, joint: int) -> bool:
    """Whether a joint's velocity is that of its position."""
    if kind != "velocity":
        return True
    own = np.gradient(view.position[:, joint], view.time)
    return float(np.corrcoef(own, view.log.array(VELOCITY)[:, joint])[0, 1]) > 0.5


@check("command instead of position")
def not_measured(view: View) -> Iterator[LogFinding]:
    """A position is the command itself, number by number: what was told was recorded, and not what was read."""
    angle, told = view.position, view.command
    rounding = np.minimum(0.51 * view.steps(POSITION), np.pi / 1024)  # of an encoder
    late = [
        (np.abs(angle[n:] - told[: len(told) - n]) <= rounding * (n < 3)).all(0)
        for n in range(8 if len(view.time) >= 20 else 0)
    ]
    same = np.any(late, axis=0) & (np.ptp(told, axis=0) > 0.05) & view.driven.any(0) if late else np.zeros(0, bool)
    if view.metadata.robot == "simulated":  # which may move as it is told
        return
    for joint in np.flatnonzero(same):
        severity = ERROR if same.all() else WARNING
        remedy = "record the present position, not the goal"
        problem = "every row has the number of the command"
        yield view.found(severity, (POSITION, joint), problem, remedy, aside=severity == WARNING)


@check("register without its sign")
def unsigned(view: View) -> Iterator[LogFinding]:
    """Negative numbers of a 16-bit or 32-bit register were read as large positive ones."""
    for key, index, column in view.columns(POSITION, VELOCITY, CURRENT, ("joint", "load")):
        size = float(view.steps(key)[index]) or _counted(column, CHANNELS[key].quantity.unit)
        if not size or column.max() < 2**10 * size:
            continue
        counts = np.round(column / size)
        for bit in (10, 11) if key not in (POSITION, VELOCITY) else ():  # loads and currents of small servos
            top = counts >= 2**bit
            apart = np.where(top, counts - 2**bit, counts).max() < 2 ** (bit - 1) and column.min() >= 0
            if top.any() and not top.all() and apart:
                problem = f"numbers from {column[top].min():.6g} on have their sign in bit {bit}"
                yield view.found(WARNING, (key, index), problem, "read sign and size apart", top.argmax(), aside=True)
        for bits in (16, 32):
            high = counts > 2**bits * 0.9
            shifted = column - 2**bits * size - view.command[:, index]
            if high.all() and key == POSITION and abs(float(np.median(shifted))) < 0.5:
                problem = f"numbers near {np.median(column):.6g} are negative ones of a {bits}-bit register"
                yield view.found(ERROR, (key, index), problem, "read the register with its sign", 0)
            signed = counts >= 2 ** (bits - 1)
            least = np.where(signed, counts - 2 ** (bits - 1), counts).max() < 2**bits * 0.05
            if signed.any() and not signed.all() and least and bits == 16:
                problem = f"numbers from {column[signed].min():.6g} on have their sign in the highest of 16 bits"
                severity, remedy = ERROR if key == POSITION else WARNING, "read sign and size apart"
                yield view.found(severity, (key, index), problem, remedy, signed.argmax(), aside=severity == WARNING)
            if high.any() and not (high.all() or (counts[~high] > 2**bits * 0.1).any() or counts.max() >= 2**bits):
                problem = f"numbers near {column[high].max():.6g} are negative ones of a {bits}-bit register"
                severity, remedy = ERROR if key == POSITION else WARNING, "read the register with its sign"
                yield view.found(severity, (key, index), problem, remedy, high.argmax(), aside=severity == WARNING)


def _counted(column: np.ndarray, si_unit: str) -> float:
    """Size of the unit of which numbers are whole 16-bit counts, in the SI unit; 0 where there is none."""
    most = float(column.max())
    fits = (u for u in UNITS.get(si_unit, {}).values() if 2**15 * u < most < 2**16 * u)
    return next((u for u in fits if np.abs(column / u - np.round(column / u)).max() < 0.01), 0.0)


@check("single readings")
def spikes(view: View) -> Iterator[LogFinding]:
    """A reading leaps away for a row and comes back, or a target for up to three rows."""
    for key, index, column in view.columns(POSITION, COMMAND, *_LEAST):
        column = np.unwrap(column) if key == ORIENTATION else column
        least = max(0.06, 5 * view.interval) if key == POSITION else 0.1 if key == COMMAND else _LEAST[key]
        if np.abs(np.diff(column)).max() <= least:
            continue
        of_angles = key in (ORIENTATION, POSITION, COMMAND)
        changes = np.diff(column, 2) / 2 if key in (POSITION, COMMAND) else np.diff(column)
        away, some = column - np.median(column), 1 + len(column) // 20_000
        usual, level = (float(np.quantile(np.abs(x[::some]), 0.95)) for x in (changes, away))
        for rows in range(1, 2 + min(2, round(0.03 / view.interval) - 1)) if key == COMMAND else (1,):
            there, back = column[1:-rows] - column[: -rows - 1], column[rows:-1] - column[rows + 1 :]
            size = np.minimum(np.abs(there), np.abs(back))
            size *= np.abs(column[rows + 1 :] - column[: -rows - 1]) < 0.5 * size  # it comes back
            if key == VELOCITY:  # a knock, which the position knows of
                size *= np.abs(np.diff(view.position[:-1, index]) / np.diff(view.time[:-1])) < 0.5 * size
            elif key == FORCE and (rate := view.get(RATE)) is not None:  # or the gyroscope
                turned = np.linalg.norm(rate[2:] - rate[:-2], axis=1)
                size *= turned <= np.quantile(turned, 0.98)
            row = int(size.argmax()) + 1
            often = key == COMMAND and (size > 0.5 * size[row - 1]).sum() > 3  # the motion is so
            if size[row - 1] > max(12 * usual, 0 if of_angles else 3 * level, least) and not often:
                what = "a target" if key == COMMAND else "a single reading"
                problem = f"{what} of {column[row]:.4g} stands between {column[row - 1]:.4g} and "
                problem += f"{column[row + rows]:.4g}"
                aside = key not in (POSITION, COMMAND)
                remedy = "leave the row out" + ("; until then the channel is not used" if aside else "")
                yield view.found(WARNING, (key, index), problem, remedy, row, row + rows - 1, aside=aside)
                break


@check("zeros")
def zeros(view: View) -> Iterator[LogFinding]:
    """All axes of the trunk's sensor, all joints, or a velocity read 0 in single rows: nothing was read there. Or a
    target is 0 there, where none was sent."""
    for key, joint, column in view.columns(VELOCITY, COMMAND):
        before, after = column[:-2], column[2:]
        least = max(0.1, 15 * float(view.steps(key)[joint]))
        gone = (column[1:-1] == 0) & (np.minimum(np.abs(before), np.abs(after)) > least) & (before * after > 0)
        if gone.sum() > 2:
            problem = f"it is 0 in {gone.sum()} single rows, and not beside them: nothing was read there, or sent"
            remedy = "leave these rows out" + ("; until then the channel is not used" if key == VELOCITY else "")
            yield view.found(WARNING, (key, joint), problem, remedy, gone.argmax() + 1, aside=key == VELOCITY)
    for key, least in ((ORIENTATION, 0.02), (RATE, 0.1), (FORCE, 1.0), (POSITION, 0.02)):
        values = view.get(key)
        if values is None or len(values) < 20 or values.shape[1] < 2:
            continue
        away = np.abs(values).max(1)
        empty, least = away == 0, max(least, 15 * float(view.steps(key).max()))
        first = np.flatnonzero(np.diff(np.concatenate([[False], empty, [False]]).astype(np.int8)))
        inside = [(a, b) for a, b in first.reshape(-1, 2) if a > 0 and b < len(values)]
        lost = [(a, b) for a, b in inside if b - a <= 10 and min(away[a - 1], away[b]) > least]
        if lost:
            rows = sum(b - a for a, b in lost)
            problem = f"all of it is 0 in {rows} rows, and not beside them: nothing was read there"
            for index in range(values.shape[1]) if key != POSITION else [0]:
                remedy = "leave these rows out"
                yield view.found(WARNING, (key, index), problem, remedy, lost[0][0], lost[0][1] - 1)
