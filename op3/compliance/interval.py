"""Means with their intervals."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from op3.intervals import mean_interval


def with_interval(values: Sequence[Any] | NDArray[Any]) -> NDArray[np.float64]:
    """Mean over the first axis and Student's 95 % interval on a new last axis, ``[..., 3]``.

    Values that are not finite are left out; with fewer than two the interval is NaN.
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
