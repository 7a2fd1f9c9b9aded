"""What residuals do when parameters change: the matrix behind intervals and identifiability."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
Residuals = Callable[[Tensor], Tensor]
"""Points of the unit box ``[candidate, parameter]`` to ``[candidate, residual]``."""

FIRST_ARM = 1e-2
"""Arms along the parameters where nothing is known yet, as a share of a range."""

SHORTEST, LONGEST = 5e-3, 0.3
"""Bounds of the arms along combinations of parameters, as a share of the ranges."""

RISE = 0.05
"""By which share of the loss an arm should raise it, where jumps do not ask for more."""

ABOVE_JUMPS = 4.0
"""How many times what jumps do to the loss an arm should raise it: the difference is then not that of single jumps."""

TAKES_PART = 0.5
"""A parameter with at least this component of a direction is not seen where both arms of it diverge."""


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
        jumps: samples of what sticking does to the residual, from second differences, ``[direction, residual]``.
        unseen: parameters that move nothing, or next to which simulations diverged, ``[parameter]``.
    """

    names: tuple[str, ...]
    low: Array
    span: Array
    unit: Array
    residual: Array
    jacobian: Array
    jumps: Array
    unseen: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Arms:
    """Central differences along combinations of parameters.

    Attributes:
        axes: directions, ``[parameter, direction]``.
        lengths: of the arms, as a share of the ranges, ``[direction]``.
        points: the ends that were simulated, ``[end, parameter]``.
        residual: there, ``[end, residual]``.
        jacobian: ``[residual, parameter]``.
        curvature: product of the Jacobian with itself, less what jumps feign, ``[parameter, parameter]``.
        jumps: ``[direction, residual]``.
        unseen: parameters of directions whose arms diverged, ``[parameter]``.
    """

    axes: Array
    lengths: Array

    points: Array
    residual: Array
    jacobian: Array
    curvature: Array
    jumps: Array
    unseen: NDArray[np.bool_]

    @property
    def jump(self) -> float:
        """What jumps do to the squared residual, of the middle direction."""
        return float(np.median(np.square(self.jumps).sum(1)))

    def long_enough(self, loss: float) -> bool:
        """Whether no arm should be more than twice as long, by what they found."""
        information = np.einsum("pd,pq,qd->d", self.axes, self.curvature, self.axes)
        return bool((_lengths(information, loss, self.jump) <= 2 * self.lengths).all())


def arms_at(
    residuals: Residuals,
    unit: Array,
    residual: Array,
    curvature: Array | None,
    jump: float = 0.0,
    failed_loss: float = np.inf,
) -> Arms:
    """Differences as long as an interval, along the axes of the curvature: one batch of 2 n points.

    Sticking makes residuals jump. Differences along single parameters take jumps for sensitivity: where parameters
    trade off, what is left of their large influences is little, and the jumps of all of them hide it. So the residual
    is compared at both ends of each combination that the curvature tells apart, far enough for the loss to rise by
    `RISE` of itself and by `ABOVE_JUMPS` times what jumps do to it.

    Args:
        residuals: of points in the unit box.
        unit: the point, ``[parameter]``.
        residual: there, ``[residual]``.
        curvature: what is known of the Jacobian's product with itself; None for short arms along the parameters.
        jump: what jumps do to the squared residual, as far as it is known.
        failed_loss: a squared length of the residual that only a diverged simulation has.
    """
    size = len(unit)
    if curvature is None:
        axes, lengths = np.eye(size), np.full(size, FIRST_ARM)
    else:
        information, axes = np.linalg.eigh(curvature)
        lengths = _lengths(information, float(residual @ residual), jump)
    offsets = lengths[:, None] * axes.T
    ends = np.concatenate([np.clip(unit + offsets, 0.0, 1.0), np.clip(unit - offsets, 0.0, 1.0)])
    simulated = residuals(torch.from_numpy(ends)).numpy()
    failed = np.square(simulated).sum(1) >= failed_loss
    # the other end alone tells the slope where one diverged
    used, found = np.where(failed[:, None], unit, ends), np.where(failed[:, None], residual, simulated)
    forward, backward = np.linalg.norm(used[:size] - unit, axis=1), np.linalg.norm(used[size:] - unit, axis=1)
    inverse = np.linalg.pinv(used[:size] - used[size:], rcond=1e-6)
    jacobian = (inverse @ (found[:size] - found[size:])).T
    # a smooth residual lies on the chord between the ends; what it misses by is jumps (and a little curvature)
    share = (backward / np.maximum(forward + backward, 1e-12))[:, None]
    chord = share * found[:size] + (1 - share) * found[size:]
    jumps = (chord - residual) / np.sqrt(1 + share**2 + (1 - share) ** 2)
    lost = failed[:size] | failed[size:] if curvature is None else failed[:size] & failed[size:]
    unseen = np.asarray((np.abs(axes[:, lost]) >= TAKES_PART).any(1))
    feigned = (inverse * 2 * np.square(jumps).sum(1)) @ inverse.T
    return Arms(axes, lengths, ends, simulated, jacobian, jacobian.T @ jacobian - feigned, jumps, unseen)


def _lengths(information: Array, loss: float, jump: float) -> Array:
    """How long arms of this information should be, ``[direction]``."""
    rise = min(max(ABOVE_JUMPS * jump, RISE * loss), loss)
    return np.clip(np.sqrt(rise / np.maximum(information, 1e-12)), SHORTEST, LONGEST)


def sensitivity_of(
    bounds: Mapping[str, tuple[float, float]], unit: Array, residual: Array, arms: Arms, unseen: NDArray[np.bool_]
) -> Sensitivity:
    """What arms around a point say.

    Args:
        bounds: lowest and highest value by parameter name, in the order of the box.
        unit: the point, ``[parameter]``.
        residual: there, ``[residual]``.
        arms: around it.
        unseen: parameters that are known not to be seen, ``[parameter]``.
    """
    low = np.array([pair[0] for pair in bounds.values()])
    span = np.array([pair[1] for pair in bounds.values()]) - low
    length = np.square(arms.jacobian).sum(0)
    unseen = unseen | arms.unseen | (length <= 1e-9 * max(1e-12, length.max()))
    return Sensitivity(tuple(bounds), low, span, unit, residual, arms.jacobian, arms.jumps, unseen)
