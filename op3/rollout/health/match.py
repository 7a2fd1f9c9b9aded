"""How one signal follows another: factor, sign, delay, and whose it really is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

WINDOW = 0.12
"""Time over which increments are compared, so that the steps of an encoder average out [s]."""


@dataclass(frozen=True)
class Match:
    """Signals a against signals b, at the delay that suits each best.

    Attributes:
        correlation: Of a's columns with b's, [a, b].
        ratio: Size of a over size of b, [a, b]; with the sign of the correlation.
        size_a: Root mean square of a's columns.
        size_b: The same for b.
    """

    correlation: np.ndarray
    ratio: np.ndarray
    size_a: np.ndarray
    size_b: np.ndarray


def match(a: np.ndarray, b: np.ndarray) -> Match:
    """Compare signals without their means.

    Args:
        a: [row, name].
        b: [row, name].
    """
    a, b = a - a.mean(0), b - b.mean(0)
    size_a, size_b = np.sqrt((a * a).mean(0)), np.sqrt((b * b).mean(0))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.nan_to_num((a.T @ b) / len(a) / np.outer(size_a, size_b))
        ratio = np.nan_to_num(np.sign(correlation) * size_a[:, None] / size_b[None])
    return Match(correlation, ratio, size_a, size_b)


def windows(time: np.ndarray, width: float = WINDOW) -> tuple[np.ndarray, np.ndarray]:
    """First and last rows of overlapping windows that no hole interrupts."""
    interval = float(np.median(np.diff(time)))
    rows = max(2, min(round(width / interval), len(time) // 10))
    first = np.arange(0, len(time) - rows, max(1, rows // 2))
    return (f := first[time[first + rows] - time[first] < 2 * rows * interval]), f + rows


def integral(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Integral of rates [time, name] from the first row on, by the trapezoid rule."""
    steps = (rate[1:] + rate[:-1]) / 2 * np.diff(time)[:, None]
    return np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(steps, axis=0)])


def step(values: np.ndarray) -> np.ndarray:
    """Step of the grid on which each column's numbers lie [name]; 0 where they lie on none."""
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


def delayed(a: np.ndarray, b: np.ndarray, rows: int) -> np.ndarray:
    """Correlation of a with b so many rows earlier, column by column [name]."""
    a, b = (a[rows:], b[: len(b) - rows]) if rows else (a, b)
    return np.diag(match(a, b).correlation)


def longest_run(still: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Start and length of the longest run of truths in each column of [row, name]."""
    _rows, names = still.shape
    start, length = np.zeros(names, int), np.zeros(names, int)
    for i in range(names):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], still[:, i], [False]]).astype(np.int8)))
        if len(edges):
            sizes = edges[1::2] - edges[::2]
            start[i], length[i] = edges[2 * sizes.argmax()], sizes.max()
    return start, length
