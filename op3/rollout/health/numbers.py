"""Checks of what was written in a column: another joint's numbers, a register's, single wrong ones."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import ERROR, WARNING, Finding, View, check
from op3.rollout.health.match import step


@check("copied channels")
def copied(view: View) -> Iterator[Finding]:
    """Two joints have the same numbers in every row."""
    for key in (("joint", "position"), ("joint", "velocity"), ("joint", "current")):
        values = view.get(key)
        if values is None:
            continue
        seen: dict[bytes, int] = {}
        for index, column in enumerate(values.T):
            first = seen.setdefault(np.ascontiguousarray(column).tobytes(), index)
            if first == index or np.ptp(column) <= 0.05 or len(np.unique(column)) <= 20:
                continue
            told_alike = np.array_equal(view.command[:, first], view.command[:, index])
            if view.metadata.robot == "simulated" and told_alike:  # twins of a simulation may move alike
                continue
            severity = ERROR if key[1] == "position" and not told_alike else WARNING
            for joint in [j for j in (index, first) if not _fits(view, key[1], j)] or [index]:
                problem = f"every row has the numbers of {view.column(key, first if joint == index else index)}"
                remedy, aside = "look which of the two it is", key[1] != "position"
                yield Finding(severity, problem, remedy, view.column(key, joint), set_aside=aside)


def _fits(view: View, kind: str, joint: int) -> bool:
    """Whether a joint's velocity is that of its position."""
    if kind != "velocity" or len(view.time) < 3:
        return True
    own = np.gradient(view.position[:, joint], view.time)
    return float(np.corrcoef(own, view.log.array(("joint", kind))[:, joint])[0, 1]) > 0.5


@check("register without its sign")
def unsigned(view: View) -> Iterator[Finding]:
    """Negative numbers of a 16-bit or 32-bit register were read as large positive ones."""
    for key in (("joint", "position"), ("joint", "velocity"), ("joint", "current"), ("joint", "load")):
        values = view.get(key)
        if values is None or len(values) < 20:
            continue
        for index, size in enumerate(step(values)):
            counts = np.round(values[:, index] / size) if size else np.zeros(1)
            for bits in (16, 32):
                high = counts > 2**bits * 0.9
                if high.any() and not (high.all() or (counts[~high] > 2**bits * 0.1).any() or counts.max() >= 2**bits):
                    problem = f"numbers near {values[high, index].max():.6g} are negative ones of a {bits}-bit register"
                    severity = WARNING if key[1] != "position" else ERROR
                    column, where = view.column(key, index), view.where(int(high.argmax()))
                    remedy = "read the register with its sign"
                    yield Finding(severity, problem, remedy, column, **where, set_aside=severity == WARNING)


@check("single readings")
def spikes(view: View) -> Iterator[Finding]:
    """A velocity or current leaps away for a row or two and comes back."""
    for key in (("joint", "velocity"), ("joint", "current")):
        values = view.get(key)
        if values is None or len(values) < 20:
            continue
        for index, column in enumerate(values.T):
            away = np.abs(column[1:-1] - column[:-2]), np.abs(column[1:-1] - column[2:])
            size, usual = np.minimum(*away), np.abs(np.diff(column))
            row = int(size.argmax())
            level = float(np.quantile(np.abs(column), 0.99))
            if size[row] > max(12 * float(np.quantile(usual, 0.99)), 6 * level, 5.0):
                problem = f"a single reading of {column[row + 1]:.4g} stands between {column[row]:.4g} and "
                problem += f"{column[row + 2]:.4g}"
                remedy, name = "leave the row out; until then the channel is not used", view.column(key, index)
                yield Finding(WARNING, problem, remedy, name, **view.where(row + 1), set_aside=True)
