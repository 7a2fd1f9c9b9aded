"""How well the data determine parameters: 90 % intervals from blocks of the residual and from the loss's jumps."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy import stats
from torch import Tensor

from op3.identify.sensitivity import Sensitivity, sensitivity_at

FLOOR = 0.05
"""Least information of a direction, in units of what jumps feign.

A direction that is not above the jumps may be unknown altogether; with this floor its half width is a tenth of the
ranges.
"""


def jackknife_intervals(
    residuals: Callable[[Tensor], Tensor],
    bounds: Mapping[str, tuple[float, float]],
    values: Mapping[str, float],
    blocks: Sequence[np.ndarray],
    level: float = 0.9,
    failed_loss: float = np.inf,
) -> dict[str, tuple[float, float]]:
    """Intervals from the spread of the estimate when one block of samples after another is left out.

    ``d_b = (H - H_b)^-1 s_b`` with ``H = J'J``, ``H_b = J_b'J_b`` and ``s_b = J_b' r_b`` is how far a Gauss-Newton
    step without block b moves; ``cov = (B - 1)/B sum_b d_b d_b'`` is the cluster jackknife (CR3, Bell & McCaffrey
    2002), which stays honest with few blocks where the plain sandwich is too narrow. Residuals of one block may be
    correlated in any way, those of different blocks are taken as independent. Student's t with one degree of freedom
    less than there are blocks; clipped to the bounds.

    Noise is not all: where sticking makes the residual jump, the loss has many hollows, and which of them is the
    deepest is chance. See `_hollows`.

    Args:
        residuals: points of the unit box ``[candidate, parameter]`` to ``[candidate, residual]``.
        bounds: lowest and highest value by parameter name, in the order of the box.
        values: the estimate.
        blocks: indices into the residual, one array per block.
        level: coverage.
        failed_loss: a squared length of the residual that only a diverged simulation has.

    Returns:
        Low and high by parameter name. A parameter that the data do not determine gets its whole range.
    """
    return intervals_of(sensitivity_at(residuals, bounds, values, failed_loss), blocks, level)


def intervals_of(
    sensitivity: Sensitivity, blocks: Sequence[np.ndarray], level: float = 0.9
) -> dict[str, tuple[float, float]]:
    """The intervals of `jackknife_intervals` from a sensitivity matrix that is known already."""
    jacobian, residual, unit = sensitivity.jacobian, sensitivity.residual, sensitivity.unit
    hessian = jacobian.T @ jacobian
    ridge = np.eye(len(unit)) * 1e-9 * max(1e-12, np.diag(hessian).max())
    moves = []
    for block in blocks:
        part = jacobian[block]
        moves.append(np.linalg.lstsq(hessian - part.T @ part + ridge, part.T @ residual[block], rcond=None)[0])
    covariance = (len(blocks) - 1) / len(blocks) * np.array(moves).T @ np.array(moves)
    covariance = covariance + _hollows(sensitivity)
    quantile = stats.t.ppf(0.5 + level / 2, max(1, len(blocks) - 1))
    # a parameter that moves nothing, or whose neighbourhood diverges, is not determined: its interval is the range
    half = np.where(sensitivity.unseen, 1.0, quantile * np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    lower = sensitivity.low + np.clip(unit - half, 0.0, 1.0) * sensitivity.span
    upper = sensitivity.low + np.clip(unit + half, 0.0, 1.0) * sensitivity.span
    return {name: (float(lower[i]), float(upper[i])) for i, name in enumerate(sensitivity.names)}


def _hollows(sensitivity: Sensitivity) -> np.ndarray:
    """Covariance of the place of the deepest hollow of a rugged loss, ``[parameter, parameter]``.

    Hollows are about as deep as the square of a jump, so the estimate may lie wherever the smooth loss has risen by
    that much: ``cov = jump^2 H^-1``. Jumps feign sensitivity in the finite differences, which is taken off H first.
    """
    seen = ~sensitivity.unseen
    result = np.zeros((len(seen), len(seen)))
    jumps = float(sensitivity.roughness[seen].max(initial=0.0))
    if jumps <= 0:
        return result
    jacobian = sensitivity.jacobian[:, seen]
    feigned = sensitivity.jump_noise[seen] + 1e-9 * np.square(jacobian).sum(0).max()
    scale = 1 / np.sqrt(feigned)
    information, axes = np.linalg.eigh(scale[:, None] * (jacobian.T @ jacobian) * scale - np.eye(len(scale)))
    directions = scale[:, None] * axes
    result[np.ix_(seen, seen)] = jumps * (directions / np.maximum(information, FLOOR)) @ directions.T
    return result
