"""Checks of a column's values: copies of another column, raw registers, whole turns, single outliers."""

from __future__ import annotations

import numpy as np

from op3.rollout.health.log_view import Found, View, check
from op3.rollout.keys import COMMAND, CURRENT, FORCE, LOAD, ORIENTATION, POSITION, RATE, TEMPERATURE, VELOCITY, VOLTAGE
from op3.rollout.match import delayed, runs
from op3.rollout.schema import CHANNELS, Key
from op3.rollout.units import UNITS

_LEAPS: dict[Key, float] = {POSITION: 0.06, COMMAND: 0.1, VELOCITY: 5.0, CURRENT: 5.0, VOLTAGE: 2.0, TEMPERATURE: 5.0}
_LEAPS |= {RATE: 5.0, ORIENTATION: 0.2, FORCE: 100.0}
"""Smallest jump reported as a single wrong reading, in the unit of its channel."""

_LOST: dict[Key, float] = {VELOCITY: 0.1, COMMAND: 0.1, ORIENTATION: 0.02, RATE: 0.1, FORCE: 1.0, POSITION: 0.02}
"""Smallest value beside a missing reading, in the unit of its channel."""

TURN = 2 * np.pi


def are_radians(values: np.ndarray) -> np.ndarray:
    """Columns with angles in rad; the checks of units report the others."""
    steps = np.diff(values, axis=0)
    steps = np.abs(steps - TURN * np.round(steps / TURN))
    return (np.abs(values).max(0) < 50) & ((steps > 1).mean(0) < 0.05 if len(steps) else True)


@check("lost turns", rows=2)
def lost_turns(view: View) -> Found:
    """A position or target jumps by whole turns: it was wrapped, or the encoder lost its count."""
    for key, name, values in ((POSITION, "position", view.position), (COMMAND, "target", view.command)):
        steps = np.diff(values, axis=0)
        turns = np.round(steps / TURN)
        jumps = (turns != 0) & (np.abs(steps - turns * TURN) < 1.0)
        for row, joint in np.argwhere(jumps & are_radians(values))[:1] if jumps.any() else ():
            count = abs(int(turns[row, joint]))
            count = "one turn" if count == 1 else f"{count} turns"
            problem = f"{name} jumps by {count} ({steps[row, joint]:+.3f} rad) at row {row + 2}"
            remedy = "write `unwrap: true` into the log's YAML, or `shift: {joint: rad}` to shift the zero as well"
            yield view.found((key, joint), problem, remedy, row + 1, error=True)


@check("copied channels", rows=20)
def copied(view: View) -> Found:
    """Two joints have the same values in every row."""
    seen: dict[tuple[Key, bytes], int] = {}
    for key, index, column in view.columns(POSITION, VELOCITY, CURRENT):
        first = seen.setdefault((key, np.ascontiguousarray(column).tobytes()), index)
        if first == index or np.ptp(column) <= 0.05 or len(np.unique(column)) <= 20:
            continue
        twins = np.array_equal(view.command[:, first], view.command[:, index])
        if view.metadata.robot == "simulated" and twins:  # simulated joints may move identically
            continue
        # a velocity that matches its own position is not a copy
        wrong = [j for j in (index, first) if key == VELOCITY and delayed(view.speed[:, j], column, 0) <= 0.5]
        error, aside, remedy = key == POSITION and not twins, key != POSITION, "check which joint the values belong to"
        for joint in wrong or [index]:
            problem = f"every value equals that of {view.name(key, first + index - joint)}"
            yield view.found((key, joint), problem, remedy, aside=aside, error=error)


@check("command instead of position", rows=20)
def not_measured(view: View) -> Found:
    """A position equals the command in every row: the goal was recorded instead of the measurement."""
    angle, target = view.position, view.command
    rounding = np.minimum(0.51 * view.steps(POSITION), np.pi / 1024)  # of an encoder
    late = [(np.abs(angle[n:] - target[: len(target) - n]) <= rounding * (n < 3)).all(0) for n in range(8)]
    same = np.any(late, axis=0) & (np.ptp(target, axis=0) > 0.05) & view.driven.any(0)
    for joint in np.flatnonzero(same) if view.metadata.robot != "simulated" else ():  # a simulation may follow exactly
        problem, remedy = "every value equals the command", "record the present position, not the goal"
        yield view.found((POSITION, joint), problem, remedy, aside=not same.all(), error=bool(same.all()))


@check("register without its sign")
def unsigned(view: View) -> Found:
    """Negative values of a 16-bit or 32-bit register were read as large positive ones."""
    for key, index, column in view.columns(POSITION, VELOCITY, CURRENT, LOAD):
        size = float(view.steps(key)[index]) or _counted(column, CHANNELS[key].quantity.unit)
        if not size or column.max() < 2**10 * size:
            continue
        counts, angle = np.round(column / size), key == POSITION
        wrong: list[tuple[str, str, np.ndarray, bool]] = []
        for bit, least in ((10, 1.0), (11, 1.0), (15, 0.2)):  # loads and currents of small servos (first two), of all
            signed = counts >= 2**bit
            apart = np.where(signed, counts - 2**bit, counts).max() < least * 2 ** (bit - 1)
            if signed.any() and not signed.all() and apart and (bit == 15 or (not angle and column.min() >= 0)):
                which = "the highest of 16 bits" if bit == 15 else f"bit {bit}"
                problem = f"values from {column[signed].min():.6g} on have their sign in {which}"
                wrong.append((problem, "decode sign and magnitude separately", signed, angle and bit == 15))
        for bits in (16, 32):
            high = counts > 2**bits * 0.9
            shifted = abs(float(np.median(column - 2**bits * size - view.command[:, index]))) < 0.5
            mixed = not high.all() and not (counts[~high] > 2**bits * 0.1).any() and counts.max() < 2**bits
            if (angle and shifted) if high.all() else (high.any() and mixed):
                number = np.median(column) if high.all() else column[high].max()
                problem = f"values near {number:.6g} are negative values of a {bits}-bit register"
                wrong.append((problem, "read the register as a signed number", high, angle))
        for problem, remedy, rows, error in wrong:
            yield view.found((key, index), problem, remedy, rows.argmax(), aside=not error, error=error)


def _counted(column: np.ndarray, si_unit: str) -> float:
    """Size in SI units of the register unit in which the values are 16-bit integers; 0 if there is none."""
    most = float(column.max())
    fits = (u for u in UNITS.get(si_unit, {}).values() if 2**15 * u < most < 2**16 * u)
    return next((u for u in fits if np.abs(column / u - np.round(column / u)).max() < 0.01), 0.0)


@check("single readings", unless="lost turns")
def spikes(view: View) -> Found:
    """A reading jumps for one row, or a target for up to three rows, and then returns."""
    for key, index, column in view.columns(*_LEAPS):
        column, sent, angle = np.unwrap(column) if key == ORIENTATION else column, key == COMMAND, key == POSITION
        least = max(_LEAPS[key], 5 * view.interval * angle)
        if np.abs(np.diff(column)).max() <= least:
            continue
        changes = np.diff(column, 2) / 2 if sent or angle else np.diff(column)
        away, some = column - np.median(column), 1 + len(column) // 20_000
        usual, level = (float(np.quantile(np.abs(x[::some]), 0.95)) for x in (changes, away))
        least = max(12 * usual, least, 0.0 if sent or angle or key == ORIENTATION else 3 * level)
        for rows in range(1, 2 + min(2, round(0.03 / view.interval) - 1)) if sent else (1,):
            there, back = column[1:-rows] - column[: -rows - 1], column[rows:-1] - column[rows + 1 :]
            size = np.minimum(np.abs(there), np.abs(back))
            size *= np.abs(column[rows + 1 :] - column[: -rows - 1]) < 0.5 * size  # the value returns
            if key == VELOCITY:  # a real impact also appears in the position
                size *= np.abs(np.diff(view.position[:-1, index]) / np.diff(view.time[:-1])) < 0.5 * size
            elif key == FORCE and (rate := view.get(RATE)) is not None:  # or in the gyroscope
                turned = np.linalg.norm(rate[2:] - rate[:-2], axis=1)
                size *= turned <= np.quantile(turned, 0.98)
            row = int(size.argmax()) + 1
            often = sent and (size > 0.5 * size[row - 1]).sum() > 3  # jumps belong to the motion
            if size[row - 1] > least and not often:
                what, where, aside = "a target" if sent else "a single reading", (key, index), not (sent or angle)
                beside = f"{column[row - 1]:.4g} and {column[row + rows]:.4g}"
                problem = f"{what} of {column[row]:.4g} is far from its neighbours {beside}"
                yield view.found(where, problem, "remove the row", row, row + rows - 1, aside=aside)
                break


@check("zeros", rows=20)
def zeros(view: View) -> Found:
    """All axes of a trunk sensor, all joints, or a velocity are 0 in single rows because nothing was read; or a target
    is 0 because none was sent."""
    for key in (key for key in _LOST if key in view.log):
        values, alone = view.log.array(key), key in (VELOCITY, COMMAND)  # for each joint in constant direction
        for index, part in enumerate(values.T[:, :, None] if alone else [values] if values.shape[1] > 1 else []):
            steps, away, most = view.steps(key), np.abs(part).max(1), 1 if alone else 10
            least = max(_LOST[key], 15 * float(steps[index] if alone else steps.max()))
            inside = [(a, b) for a, b in runs(away == 0).tolist() if 0 < a < b < len(part) and b - a <= most]
            lost = [(a, b) for a, b in inside if min(away[a - 1], away[b]) > least]
            lost = [(a, b) for a, b in lost if not alone or part[a - 1, 0] * part[b, 0] > 0]
            rows = sum(b - a for a, b in lost)
            problem = (
                f"all values of the sensor are 0 in {rows} rows but not in neighbouring rows: nothing was read there"
            )
            if alone:
                problem = (
                    f"the value is 0 in {rows} single rows but not in neighbouring rows: nothing was read or sent there"
                )
            for column in range(1 if key == POSITION else len(part[0])) if rows > 2 * alone else ():
                where, aside = (key, index + column), key == VELOCITY
                yield view.found(where, problem, "remove these rows", lost[0][0], lost[0][1] - 1, aside=aside)
