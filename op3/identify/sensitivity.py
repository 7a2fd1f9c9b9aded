"""What residuals do when parameters change: the matrix behind intervals, identifiability and designs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
Residuals = Callable[[Tensor], Tensor]
"""Points of the unit box ``[candidate, parameter]`` to ``[candidate, residual]``."""


SENSITIVITY_STEP = 1e-2
"""Step of the central differences, as a share of a parameter's range.

Sticking makes residuals jump. Differences over less than the width of an interval take single jumps for sensitivity and
promise intervals that are too narrow.
"""


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Residuals at a point of the box of parameters, and how they change around it.

    Attributes:
        names: of the parameters.
        low: lowest value of each, ``[parameter]``.
        span: length of its range, ``[parameter]``.
        unit: the point, as a share of the range, ``[parameter]``.
        residual: ``[residual]``.
        jacobian: change of the residual per range, ``[residual, parameter]``.
        roughness: square of what single jumps do to the residual, from second differences, ``[parameter]``.
        jump_noise: what jumps add to the squared columns of the jacobian, ``[parameter]``.
        unseen: parameters that move nothing, or next to which a simulation diverged, ``[parameter]``.
    """

    names: tuple[str, ...]
    low: Array
    span: Array
    unit: Array
    residual: Array
    jacobian: Array
    roughness: Array
    jump_noise: Array
    unseen: NDArray[np.bool_]


def sensitivity_at(
    residuals: Residuals,
    bounds: Mapping[str, tuple[float, float]],
    values: Mapping[str, float],
    failed_loss: float = np.inf,
) -> Sensitivity:
    """Central differences within the box: one batch of 2 n + 1 points.

    Args:
        residuals: of points in the box.
        bounds: lowest and highest value by parameter name, in the order of the box.
        values: the point.
        failed_loss: a squared length of the residual that only a diverged simulation has.
    """
    names = tuple(bounds)
    low = np.array([bounds[name][0] for name in names])
    span = np.array([bounds[name][1] for name in names]) - low
    unit = np.clip((np.array([values[name] for name in names]) - low) / span, 0.0, 1.0)
    forward = np.minimum(unit + SENSITIVITY_STEP, 1.0)
    backward = np.maximum(unit - SENSITIVITY_STEP, 0.0)
    eye = np.eye(len(names))
    points = np.concatenate([[unit], unit + eye * (forward - unit), unit + eye * (backward - unit)])
    result = residuals(torch.from_numpy(points)).numpy()
    size = len(names)
    jacobian = ((result[1 : size + 1] - result[size + 1 :]) / (forward - backward)[:, None]).T
    # a smooth residual lies on the chord between its neighbours; what it misses by is jumps (and a little curvature)
    share = (unit - backward) / (forward - backward)
    chord = share[:, None] * result[1 : size + 1] + (1 - share)[:, None] * result[size + 1 :]
    roughness = np.square(chord - result[0]).sum(1) / (1 + share**2 + (1 - share) ** 2)
    jump_noise = 2 * roughness / (forward - backward) ** 2
    length = np.square(jacobian).sum(0)
    diverged = np.square(result).sum(1) >= failed_loss
    unseen = length <= 1e-9 * max(1e-12, length.max())
    unseen |= diverged[0] | diverged[1 : size + 1] | diverged[size + 1 :]
    return Sensitivity(names, low, span, unit, result[0], jacobian, roughness, jump_noise, unseen)
