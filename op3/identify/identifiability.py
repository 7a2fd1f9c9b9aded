"""Which parameters are identifiable from logs, and which combinations of parameters are not distinguishable."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from op3.common.plain_names import words
from op3.identify.intervals import at_bound
from op3.identify.sensitivity import Sensitivity

Array = NDArray[np.float64]

SHARE = 0.5
"""A parameter is identifiable if its 90 % interval is narrower than this share of the searched range."""

PART = 0.3
"""A parameter belongs to a combination if its component of the unit direction is at least this large."""

WIDTH = 2 * float(special.ndtri(0.95))
"""Width of a 90 % interval in standard deviations."""


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Singular values and directions of the whitened sensitivity matrix, in units of the searched ranges.

    A combination with singular value s has a standard deviation of 1 / s, in units of the ranges.

    Attributes:
        noise: standard deviation of each channel's weighted residual.
        singular_values: singular values, largest first.
        directions: unit directions, ``[combination, parameter]``.
        correlation: correlation of the estimates, ``[parameter, parameter]``.
        widths: width of each 90 % interval as a share of the range.
        at_bound: parameters that ended at a bound of the searched range, which are not called identifiable.
        identifiable: whether each parameter is identifiable, by name.
        unknown: sentences about combinations that are not identifiable from the logs, the worst first.
    """

    names: tuple[str, ...]
    noise: Mapping[str, float]
    singular_values: Array
    directions: Array
    correlation: Array
    widths: Mapping[str, float]
    at_bound: Sequence[str]
    identifiable: Mapping[str, bool]
    unknown: Sequence[str]


def identifiability(
    sensitivity: Sensitivity,
    blocks: Sequence[np.ndarray],
    channels: Mapping[str, np.ndarray],
    intervals: Mapping[str, tuple[float, float]],
) -> Identifiability:
    """Whiten the sensitivity matrix with the noise of each channel and compute its singular values.

    Args:
        blocks: indices of correlated residuals; residuals of different blocks are assumed independent.
        channels: indices of the residuals of each channel.
        intervals: low and high end of each parameter's interval.
    """
    noise = {name: noise_scale(sensitivity.residual, index, blocks) for name, index in channels.items()}
    whitened = sensitivity.jacobian.copy()
    for name, index in channels.items():
        whitened[index] /= noise[name]
    _, values, directions = np.linalg.svd(whitened, full_matrices=False)
    names, span = sensitivity.box.names, sensitivity.box.span
    widths = {name: float(intervals[name][1] - intervals[name][0]) / span[i] for i, name in enumerate(names)}
    ended = [name for name, unit in zip(names, sensitivity.unit, strict=True) if at_bound(unit)]
    return Identifiability(
        names=names,
        noise=noise,
        singular_values=values,
        directions=directions,
        correlation=_correlation(values, directions),
        widths=widths,
        at_bound=ended,
        identifiable={name: bool(width < SHARE) and name not in ended for name, width in widths.items()},
        unknown=[
            in_words(names, direction)
            for value, direction in zip(values[::-1], directions[::-1], strict=True)
            if value * SHARE < WIDTH
        ],
    )


def noise_scale(residual: Array, index: np.ndarray, blocks: Sequence[np.ndarray]) -> float:
    """Standard deviation of one channel's residual, scaled as if all rows were independent samples.

    Neighbouring residuals are correlated. If they were independent, the mean of a block of n would have the variance
    sigma^2 / n; the actual variance shows how many rows form one independent sample (at least one).

    Args:
        blocks: indices of all residuals that belong together.
    """
    own = np.zeros(len(residual), dtype=bool)
    own[index] = True
    parts = [residual[block[own[block]]] for block in blocks]
    parts = [part for part in parts if len(part) > 1]
    square = float(np.square(residual[index]).mean())
    if not parts:
        return max(square, 1e-30) ** 0.5
    size = float(np.mean([len(part) for part in parts]))
    between = float(np.mean([part.mean() ** 2 for part in parts]))
    return max(square, between * size, 1e-30) ** 0.5


def in_words(names: Sequence[str], direction: Array) -> str:
    """A sentence about a combination that is not identifiable from the logs.

    Args:
        direction: unit direction, ``[parameter]``.
    """
    order = np.argsort(-np.abs(direction))
    parts = [int(i) for i in order if abs(direction[i]) >= PART][:4]
    spoken = [words(names[i]) for i in parts]
    if len(parts) < 2:
        return f"{spoken[0] if spoken else words(names[int(order[0])])} is not identifiable from these logs"
    first = direction[parts[0]] > 0
    alike = [word for i, word in zip(parts[1:], spoken[1:], strict=True) if (direction[i] > 0) == first]
    against = [word for i, word in zip(parts[1:], spoken[1:], strict=True) if (direction[i] > 0) != first]
    ways = [f"a higher {_listed(alike)}"] if alike else []
    ways += [f"a lower {_listed(against)}"] if against else []
    joined = f"{', '.join(spoken[:-1])} and {spoken[-1]}"
    return f"{joined} trade off: a higher {spoken[0]} with {' and '.join(ways)} gives nearly the same logs"


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _correlation(values: Array, directions: Array) -> Array:
    """Correlation of the estimates, from the inverse of the information matrix; uninformed directions use the whole
    range."""
    weak = 1.0 / np.maximum(np.square(values), 1.0)
    covariance = (directions.T * weak) @ directions
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    return covariance / np.outer(scale, scale)
