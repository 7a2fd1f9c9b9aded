"""Intervals of means and of shares."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import ndtri, stdtrit

RESAMPLES = 4000
"""Number of draws of clusters per interval."""


def mean_interval(values: Sequence[float]) -> tuple[float, float]:
    """Student's 95 % interval of the mean of at least two values."""
    count, middle, spread = len(values), float(np.mean(values)), float(np.std(values, ddof=1))
    half = float(stdtrit(count - 1, 0.975)) * spread / count**0.5
    return middle - half, middle + half


def with_interval(values: Sequence[Any] | NDArray[Any]) -> NDArray[np.float64]:
    """Mean over the first axis and Student's 95 % interval on a new last axis, ``[..., 3]``.

    Non-finite values are omitted; with fewer than two values the interval is NaN.
    """
    array = np.asarray(values, dtype=float)
    flat = array.reshape(len(array), -1) if len(array) else np.zeros((0, 1))
    result = np.full((flat.shape[1], 3), np.nan)
    for column, mine in zip(result, flat.T, strict=True):
        known = mine[np.isfinite(mine)]
        if len(known):
            column[0] = known.mean()
        if len(known) > 1:
            column[1:] = mean_interval(known.tolist())
    return result.reshape(*array.shape[1:], 3)


def wilson_interval(successes: float, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share (Wilson 1927), within 0 and 1 and of positive width even there."""
    z = float(ndtri(0.975))
    share, weight = successes / trials, 1 + z**2 / trials
    middle = (share + z**2 / (2 * trials)) / weight
    half = z / weight * (share * (1 - share) / trials + z**2 / (4 * trials**2)) ** 0.5
    return max(0.0, middle - half), min(1.0, middle + half)


def bootstrap_interval(
    values: NDArray[np.float64], weights: NDArray[np.float64] | None = None, *, seed: int = 0
) -> tuple[float, float] | tuple[None, None]:
    """90 % interval of a (weighted) mean over clusters, from a bootstrap over clusters.

    Percentiles of the bootstrap are too narrow for few clusters; the expanded percentile interval (Hesterberg, The
    American Statistician 69, 2015) uses the percentiles that are correct for the mean of the same number of normal
    values.

    Returns:
        Low and high; None with only one cluster.
    """
    count = len(values)
    if count < 2:
        return None, None
    tail = stats.norm.sf(np.sqrt(count / (count - 1)) * stats.t.ppf(0.95, count - 1))
    found = stats.bootstrap(
        (np.ones(count) if weights is None else weights, values),
        lambda w, v, axis: (w * v).sum(axis) / w.sum(axis),
        paired=True,
        n_resamples=RESAMPLES,
        confidence_level=float(1 - 2 * tail),
        method="percentile",
        rng=seed,
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def mean_and_deviation(values: Sequence[float | None]) -> dict[str, float | int | None] | None:
    """Mean and standard deviation; None if no run has the number, and no deviation for a single run."""
    known = [float(value) for value in values if value is not None]
    if not known:
        return None
    deviation = float(np.std(known, ddof=1)) if len(known) > 1 else None
    return {"value": float(np.mean(known)), "deviation": deviation, "count": len(known)}
