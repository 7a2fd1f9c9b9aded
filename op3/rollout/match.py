"""Comparison of signals: factor, sign, delay, and assignment."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid

from op3.rollout.units import likely_unit

WINDOW, OVERLAP = (
    0.12,
    3,
)  # time over which increments are compared, so that encoder steps average out [s], and windows in this time
SURE = 0.9  # correlation above which one signal follows another, so that a factor and a sign are meaningful
GIVES = 0.5  # larger than the deflection of any servo that holds its target [rad]


@dataclass(frozen=True)
class Match:
    """Comparison of signals a with signals b.

    Attributes:
        correlation: Correlation of a's columns with b's, [a, b].
        ratio: Size of a relative to size of b, with the sign of the correlation, [a, b].
        size_a: Root mean square of a's columns.
        size_b: Root mean square of b's columns.
    """

    correlation: np.ndarray
    ratio: np.ndarray
    size_a: np.ndarray
    size_b: np.ndarray

    @property
    def own(self) -> np.ndarray:
        """Correlation of each column of a with the same column of b."""
        return np.diagonal(self.correlation)


def match(a: np.ndarray, b: np.ndarray) -> Match:
    """Compare signals [row, name] after removing their means."""
    a, b = a - a.mean(0), b - b.mean(0)
    size_a, size_b = np.sqrt((a * a).mean(0)), np.sqrt((b * b).mean(0))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.nan_to_num((a.T @ b) / len(a) / np.outer(size_a, size_b))
        ratio = np.nan_to_num(np.sign(correlation) * size_a[:, None] / size_b[None])
    return Match(correlation, ratio, size_a, size_b)


def fitted(causes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Least-squares weights [cause] of causes [row, cause] for values [row]; NaN where numbers overflow."""
    sound = bool(np.isfinite(causes).all() and np.isfinite(values).all())
    return np.linalg.lstsq(causes, values)[0] if sound else np.full(causes.shape[1], np.nan)


def unexplained(values: np.ndarray, causes: np.ndarray) -> float:
    """Share of the variance of values [row] that a linear fit of causes [row, cause] does not explain."""
    return float((values - causes @ fitted(causes, values)).var() / max(values.var(), 1e-12))


def as_if(*readings: tuple[str, float, str], tolerance: float = 0.05) -> str:
    """Text that names the first fitting unit, for quantities given by name, factor and SI unit."""
    units = ((who, likely_unit(ratio, unit, tolerance)) for who, ratio, unit in readings)
    return next((f", as if {who} were in {unit}" for who, unit in units if unit), "")


def is_unit(ratio: float | None) -> bool:
    """Whether a factor between two rates is a unit or a sign, rather than a filter or a coarse sensor."""
    return ratio is not None and (ratio < 0 or not 0.2 < ratio < 5 or likely_unit(ratio, "rad/s", 0.05) is not None)


def delayed(a: np.ndarray, b: np.ndarray, rows: int) -> float:
    """Correlation of a [row] with b shifted by a number of rows, positive for earlier rows of b."""
    if rows < 0:
        a, b, rows = b, a, -rows
    a, b = a[rows:] - a[rows:].mean(), b[: len(b) - rows] - b[: len(b) - rows].mean()
    size = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / size) if size > 0 else 0.0


def delays(a: np.ndarray, b: np.ndarray, lags: Iterable[int]) -> np.ndarray:
    """Correlation of a [row] with b for several shifts [lag], positive for earlier rows of b."""
    return np.array([delayed(a, b, lag) for lag in lags])


def windows(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """First and last rows of overlapping windows without gaps, and their length [s]."""
    interval = float(np.median(np.diff(time)))
    rows = max(2, min(round(WINDOW / interval), len(time) // 10))
    first = np.arange(0, len(time) - rows, max(1, rows // OVERLAP, len(time) // 8000))
    first = first[time[first + rows] - time[first] < 2 * rows * interval]
    return first, first + rows, float(np.median(time[first + rows] - time[first])) if len(first) else 0.0


def integral(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Integral of rates [time, ...] from the first row."""
    return np.asarray(cumulative_trapezoid(rate, time, axis=0, initial=0))


def step(values: np.ndarray) -> np.ndarray:
    """Resolution of columns [row, name]: the grid step of each column's values [name], or 0 without a grid."""
    some = values[:: max(1, len(values) // 4000)]
    steps = np.zeros(some.shape[1])
    for i, column in enumerate(some.T):
        levels = np.unique(column)
        gaps = np.diff(levels)
        gaps = gaps[gaps > 1e-9]
        if len(gaps) and len(levels) < 0.7 * len(column):
            least = float(gaps.min())
            steps[i] = least if np.abs(gaps / least - np.round(gaps / least)).max() < 0.05 else 0.0
    return steps


def runs(rows: np.ndarray) -> np.ndarray:
    """First and end row of each run of true values [row], [run, 2]; the end row follows the run."""
    return np.flatnonzero(np.diff(np.concatenate([[False], rows, [False]]).astype(np.int8))).reshape(-1, 2)


def longest_run(rows: np.ndarray) -> tuple[int, int]:
    """Start and length of the longest run of true values [row]."""
    found = runs(rows)
    first, end = found[np.diff(found).argmax()].tolist() if len(found) else (0, 0)
    return first, end - first
