"""How well the data determine parameters: 90 % intervals from blocks of the residual and from jumps of sticking."""

from collections.abc import Sequence

import numpy as np
from scipy import stats

from op3.identify.sensitivity import Array, Sensitivity

NOTHING = 1e-9
"""Share of the largest information below which a combination of parameters changes nothing."""


def intervals_of(
    sensitivity: Sensitivity, blocks: Sequence[np.ndarray], level: float = 0.9
) -> dict[str, tuple[float, float]]:
    """Intervals from what noise and sticking do to the estimate; both covariances are added.

    **Noise.** ``d_b = (H - H_b)^-1 s_b`` with ``H = J'J``, ``H_b = J_b'J_b`` and ``s_b = J_b' r_b`` is how far a
    Gauss-Newton step without block b moves; ``cov = (B - 1)/B sum_b d_b d_b'`` is the cluster jackknife (CR3, Bell &
    McCaffrey 2002), which stays honest with few blocks where the plain sandwich is too narrow. Residuals of one block
    may be correlated in any way, those of different blocks are taken as independent.

    **Sticking.** Where it makes the residual jump, the loss has many hollows, and which of them is the deepest is
    chance. Second differences are samples e of these jumps over the length of an interval; each would move the estimate
    by ``H^-1 J' e``. The covariance is twice their mean square: what was measured has jumps of its own, and the
    simulation has others. No independence in time is asked for.

    Student's t with one degree of freedom less than there are blocks; clipped to the bounds.

    Args:
        sensitivity: at the estimate.
        blocks: indices into the residual, one array per block.
        level: coverage.

    Returns:
        Low and high by parameter name. A parameter that the data do not determine gets its whole range.
    """
    jacobian, residual, unit = sensitivity.jacobian, sensitivity.residual, sensitivity.unit
    hessian = jacobian.T @ jacobian
    ridge = np.eye(len(unit)) * NOTHING * max(1e-12, np.diag(hessian).max())
    moves = []
    for block in blocks:
        part = jacobian[block]
        moves.append(np.linalg.lstsq(hessian - part.T @ part + ridge, part.T @ residual[block], rcond=None)[0])
    covariance = (len(blocks) - 1) / len(blocks) * _squares(np.array(moves))
    jumped = np.asarray(np.linalg.solve(hessian + ridge, jacobian.T @ sensitivity.jumps.T).T, dtype=np.float64)
    covariance = covariance + 2 * _squares(jumped) / len(jumped) + _unknown(hessian)
    quantile = stats.t.ppf(0.5 + level / 2, max(1, len(blocks) - 1))
    # a parameter that moves nothing, or whose neighbourhood diverges, is not determined: its interval is the range
    half = np.where(sensitivity.unseen, 1.0, quantile * np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    lower = sensitivity.low + np.clip(unit - half, 0.0, 1.0) * sensitivity.span
    upper = sensitivity.low + np.clip(unit + half, 0.0, 1.0) * sensitivity.span
    return {name: (float(lower[i]), float(upper[i])) for i, name in enumerate(sensitivity.names)}


def _squares(moves: Array) -> Array:
    return moves.T @ moves


def _unknown(hessian: Array) -> Array:
    """Covariance of the combinations that change nothing: the whole ranges, ``[parameter, parameter]``."""
    information, axes = np.linalg.eigh(hessian)
    nothing = axes[:, information <= NOTHING * max(1e-12, information.max())]
    return nothing @ nothing.T
