"""How well the data determine parameters: 90 % intervals from the curvature and the residual's blocks."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from op3.identify.refine import DIFFERENCE_STEP


def sandwich_intervals(
    residuals: Callable[[Tensor], Tensor],
    bounds: Mapping[str, tuple[float, float]],
    values: Mapping[str, float],
    blocks: Sequence[np.ndarray],
    level: float = 0.9,
) -> dict[str, tuple[float, float]]:
    """Intervals from the cluster-robust covariance of a least-squares estimate.

    ``cov = H^-1 (sum_b s_b s_b') H^-1`` with ``H = J'J`` and ``s_b = J_b' r_b`` over blocks b of samples: residuals
    of one block may be correlated in any way, those of different blocks are taken as independent (White 1980,
    Liang & Zeger 1986). Student's t with one degree of freedom less than there are blocks; clipped to the bounds.

    Args:
        residuals: points of the unit box ``[candidate, parameter]`` to ``[candidate, residual]``.
        bounds: lowest and highest value by parameter name, in the order of the box.
        values: the estimate.
        blocks: indices into the residual, one array per block.
        level: coverage.

    Returns:
        Low and high by parameter name. A parameter that the data do not determine gets its whole range.
    """
    names = list(bounds)
    low = np.array([bounds[name][0] for name in names])
    span = np.array([bounds[name][1] for name in names]) - low
    unit = np.clip((np.array([values[name] for name in names]) - low) / span, 0.0, 1.0)
    # central differences within the box: one batch of 2 n + 1 points
    forward = np.minimum(unit + DIFFERENCE_STEP, 1.0)
    backward = np.maximum(unit - DIFFERENCE_STEP, 0.0)
    eye = np.eye(len(names))
    points = np.concatenate([[unit], unit + eye * (forward - unit), unit + eye * (backward - unit)])
    result = residuals(torch.from_numpy(points)).numpy()
    size = len(names)
    jacobian = ((result[1 : size + 1] - result[size + 1 :]) / (forward - backward)[:, None]).T
    scores = np.array([jacobian[block].T @ result[0][block] for block in blocks])
    hessian = jacobian.T @ jacobian
    # directions that the data do not see at all get a standard deviation of the whole range
    inverse = np.linalg.pinv(hessian + np.eye(size) * 1e-9 * max(1e-12, np.diag(hessian).max()))
    covariance = inverse @ (scores.T @ scores) @ inverse
    quantile = stats.t.ppf(0.5 + level / 2, max(1, len(blocks) - 1))
    half = quantile * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unseen = np.diag(hessian) <= 1e-9 * max(1e-12, np.diag(hessian).max())
    half = np.where(unseen, 1.0, half)
    lower, upper = np.clip(unit - half, 0.0, 1.0), np.clip(unit + half, 0.0, 1.0)
    return {
        name: (float(low[i] + lower[i] * span[i]), float(low[i] + upper[i] * span[i])) for i, name in enumerate(names)
    }
