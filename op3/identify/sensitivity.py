"""Sensitivity of residuals to parameters, which determines intervals and identifiability."""

from __future__ import annotations

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
"""Initial difference steps along the parameters, as a share of the range."""

SHORTEST, LONGEST = 5e-3, 0.3
"""Bounds of difference steps along combinations of parameters, as a share of the ranges."""

RISE = 0.05
"""A difference step should raise the loss by this share, unless jumps of the loss require more."""

ABOVE_JUMPS = 4.0
"""A difference step should raise the loss by this multiple of its jumps, so that single jumps do not dominate."""

TAKES_PART = 0.5
"""If both steps along a direction diverge, parameters with at least this component are not identifiable."""


@dataclass(frozen=True, eq=False)
class Box:
    """The searched ranges; points have coordinates from 0 to 1.

    Attributes:
        names: names of the parameters.
        low: lowest value of each parameter, ``[parameter]``.
        span: length of each range, ``[parameter]``.
    """

    names: tuple[str, ...]
    low: Array
    span: Array

    @classmethod
    def of(cls, bounds: Mapping[str, tuple[float, float]]) -> Box:
        """The box of lowest and highest values by parameter name."""
        low, high = np.array(list(bounds.values()), dtype=np.float64).reshape(-1, 2).T
        return cls(tuple(bounds), low, high - low)

    def unit(self, values: Mapping[str, float]) -> Array:
        """The point of these values, clipped to the ranges."""
        return np.clip((np.array([values[name] for name in self.names]) - self.low) / self.span, 0.0, 1.0)

    def values(self, unit: Array) -> dict[str, float]:
        """Values by name at a point."""
        return dict(zip(self.names, (self.low + unit * self.span).tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Residuals at a point of a box, and their central differences along several directions.

    Attributes:
        box: box of the parameters.
        unit: the point, in shares of the ranges, ``[parameter]``.
        residual: residual at this point, ``[residual]``.
        jacobian: change of the residual per parameter range, ``[residual, parameter]``.
        jumps: samples of the residual's stiction jumps, from second differences, ``[direction, residual]``.
        unseen: parameters without effect, or close to which simulations diverged, ``[parameter]``.
        curvature: product of the Jacobian with itself, minus the contribution of jumps, ``[parameter, parameter]``.
        axes: directions, ``[parameter, direction]``.
        lengths: lengths of the steps along the axes, as shares of the ranges, ``[direction]``.
    """

    box: Box
    unit: Array
    residual: Array
    jacobian: Array
    jumps: Array
    unseen: NDArray[np.bool_]
    curvature: Array
    axes: Array
    lengths: Array

    @property
    def jump(self) -> float:
        """Median effect of jumps on the squared residual, over directions."""
        return float(np.median(np.square(self.jumps).sum(1)))

    @property
    def long_enough(self) -> bool:
        """Whether no step should have been more than twice as long."""
        information = np.einsum("pd,pq,qd->d", self.axes, self.curvature, self.axes)
        loss = float(self.residual @ self.residual)
        return bool((_lengths(information, loss, self.jump) <= 2 * self.lengths).all())


def simulate(residuals: Residuals, points: Array) -> Array:
    """Residuals ``[point, residual]`` at points ``[point, parameter]`` as arrays."""
    return residuals(torch.from_numpy(np.ascontiguousarray(points))).numpy()


def sensitivity_at(
    residuals: Residuals,
    box: Box,
    unit: Array,
    residual: Array,
    curvature: Array | None,
    jump: float = 0.0,
    failed_loss: float = np.inf,
) -> Sensitivity:
    """Differences as long as an interval along the axes of the curvature, in one batch of 2 n points.

    Stiction makes residuals jump, and differences along single parameters mistake jumps for sensitivity: if parameters
    trade off, their large influences nearly cancel, and the jumps hide the rest. The residual is therefore compared at
    both ends of each principal direction of the curvature, far enough for the loss to rise by the share `RISE` and by
    `ABOVE_JUMPS` times the effect of jumps.

    Args:
        unit: the point, ``[parameter]``.
        residual: residual at this point, ``[residual]``.
        curvature: estimate of the Jacobian's product with itself; None for short steps along the parameters.
        jump: known effect of jumps on the squared residual.
        failed_loss: squared length of the residual that only a diverged simulation reaches.
    """
    size = len(unit)
    if curvature is None:
        axes, lengths = np.eye(size), np.full(size, FIRST_ARM)
    else:
        information, axes = np.linalg.eigh(curvature)
        lengths = _lengths(information, float(residual @ residual), jump)
    offsets = lengths[:, None] * axes.T
    ends = np.concatenate([np.clip(unit + offsets, 0.0, 1.0), np.clip(unit - offsets, 0.0, 1.0)])
    simulated = simulate(residuals, ends)
    failed = np.square(simulated).sum(1) >= failed_loss
    # if one end diverged, the other end determines the slope
    used, found = np.where(failed[:, None], unit, ends), np.where(failed[:, None], residual, simulated)
    forward, backward = np.linalg.norm(used[:size] - unit, axis=1), np.linalg.norm(used[size:] - unit, axis=1)
    inverse = np.linalg.pinv(used[:size] - used[size:], rcond=1e-6)
    jacobian = (inverse @ (found[:size] - found[size:])).T
    # a smooth residual lies on the chord between the ends; deviations are jumps (and some curvature)
    share = (backward / np.maximum(forward + backward, 1e-12))[:, None]
    chord = share * found[:size] + (1 - share) * found[size:]
    jumps = (chord - residual) / np.sqrt(1 + share**2 + (1 - share) ** 2)
    lost = failed[:size] | failed[size:] if curvature is None else failed[:size] & failed[size:]
    length = np.square(jacobian).sum(0)
    unseen = np.asarray((np.abs(axes[:, lost]) >= TAKES_PART).any(1))
    if curvature is not None:  # a parameter may have no influence over a short step because something sticks
        unseen = unseen | (length <= 1e-9 * max(1e-12, length.max()))
    feigned = (inverse * 2 * np.square(jumps).sum(1)) @ inverse.T
    found = jacobian.T @ jacobian - feigned
    return Sensitivity(box, unit.copy(), residual, jacobian, jumps, unseen, found, axes, lengths)


def _lengths(information: Array, loss: float, jump: float) -> Array:
    """Lengths of steps along directions with this information, ``[direction]``."""
    rise = min(max(ABOVE_JUMPS * jump, RISE * loss), loss)
    return np.clip(np.sqrt(rise / np.maximum(information, 1e-12)), SHORTEST, LONGEST)
