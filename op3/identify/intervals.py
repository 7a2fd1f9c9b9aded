"""90 % intervals of parameters from noise, stiction jumps and steps that the search did not take."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import optimize, special

from op3.identify.sensitivity import Array, Residuals, Sensitivity, simulate

EDGE = 0.02
"""A parameter within this share of its range from a bound counts as at the bound."""

FARTHER = (0.5, 1.0)
"""Points at which the interval of a parameter at a bound is checked, as shares of the distance to the other bound."""

NOTHING = 1e-9
"""Combinations of parameters with less than this share of the largest information count as without effect."""


def at_bound(place: float) -> bool:
    """Whether a parameter at this position in its range, 0 to 1, is at a bound."""
    return not EDGE < place < 1 - EDGE


def intervals_of(sensitivity: Sensitivity, blocks: Sequence[np.ndarray]) -> dict[str, tuple[float, float]]:
    """90 % intervals that add the covariances from noise, stiction and an unfinished search.

    **Noise.** ``d_b = (H - H_b)^-1 s_b`` with ``H = J'J``, ``H_b = J_b'J_b`` and ``s_b = J_b' r_b`` is the change of
    the estimate in a Gauss-Newton step without block b; ``cov = (B - 1)/B sum_b d_b d_b'`` is the cluster jackknife
    (CR3, Bell & McCaffrey 2002), which remains valid with few blocks, where the plain sandwich estimator is too narrow.
    Residuals within a block may be correlated in any way; residuals of different blocks are assumed independent.

    **Stiction.** Stiction makes the residual jump, so the loss has many local minima, and chance decides which is the
    deepest. Second differences over the length of an interval are samples e of these jumps; each would move the
    estimate by ``H^-1 J' e``. The covariance is twice the mean square of these shifts, because measurement and
    simulation have different jumps. Independence in time is not assumed.

    **Steps not taken.** Differences as long as an interval average over the local minima: they may predict a step ``d =
    -H^-1 J' r`` along a valley that the search could not take because the loss rose in between. In random worlds
    (`experiments/benchmarks/interval_coverage.py`) this step led from the estimate towards the truth if torque
    constant, armature, friction and mass were all too high or all too low. ``d d'`` is added.

    Intervals use Student's t with one degree of freedom less than there are blocks, and are clipped to the bounds.

    Args:
        blocks: indices into the residual, one array per block.

    Returns:
        Low and high end by parameter name. A parameter that is not identifiable gets its whole range.
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
    covariance = covariance + _squares(_step_left(sensitivity, hessian + ridge)[None])
    quantile = special.stdtrit(max(1, len(blocks) - 1), 0.95)
    # a parameter without influence, or with diverging neighbours, is not identifiable: its interval is the range
    half = np.where(sensitivity.unseen, 1.0, quantile * np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    ends = np.clip([unit - half, unit + half], 0.0, 1.0)
    lower, upper = (sensitivity.box.low + ends * sensitivity.box.span).tolist()
    return {name: (lower[i], upper[i]) for i, name in enumerate(sensitivity.box.names)}


def followed_from_bounds(
    residuals: Residuals, sensitivity: Sensitivity, found: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Intervals, widened if a parameter ended at a bound from which the loss rises less than its slope predicts.

    At a bound, differences reach only to one side, and an effect that begins there (a voltage limiting the current) may
    fade away from the bound. So such parameters are moved beyond the end of their interval, alone and together with the
    other parameters' trade-offs, and simulated. The interval extends as far as the loss stays below the value expected
    at its end.

    Args:
        found: low and high end by parameter name, from `intervals_of`.
    """
    box, unit, result = sensitivity.box, sensitivity.unit, dict(found)
    covariance = np.linalg.pinv(sensitivity.jacobian.T @ sensitivity.jacobian, rcond=NOTHING)
    points, places, limits = [], [], []
    for i, name in enumerate(box.names):
        low, high = (np.array(found[name]) - box.low[i]) / box.span[i]
        near, end, far = (0.0, high, 1.0) if unit[i] <= EDGE else (1.0, low, 0.0)
        if abs(unit[i] - near) > EDGE or abs(end - far) <= EDGE or covariance[i, i] <= 0.0:
            continue
        way = end - unit[i]
        for others in (unit, unit + way * covariance[:, i] / covariance[i, i]):
            for share in FARTHER:
                point = np.clip(others, 0.0, 1.0)
                point[i] = end + share * (far - end)
                points.append(point)
                places.append(i)
                limits.append(way**2 / covariance[i, i])
    if not points:
        return result
    losses = np.square(simulate(residuals, np.array(points))).sum(1)
    allowed = float(sensitivity.residual @ sensitivity.residual) + np.array(limits)
    for point, i, loss, limit in zip(points, places, losses, allowed, strict=True):
        if loss <= limit:
            name, value = box.names[i], float(box.low[i] + point[i] * box.span[i])
            result[name] = (min(result[name][0], value), max(result[name][1], value))
    return result


def _step_left(sensitivity: Sensitivity, hessian: Array) -> Array:
    """The predicted Gauss-Newton step along identifiable combinations, within the box, ``[parameter]``."""
    seen = np.flatnonzero(~sensitivity.unseen)
    step, unit = np.zeros(len(hessian)), sensitivity.unit[seen]
    if not len(seen):
        return step
    root, gradient = np.linalg.cholesky(hessian[np.ix_(seen, seen)]), sensitivity.jacobian.T @ sensitivity.residual
    target = -np.linalg.solve(root, gradient[seen])
    step[seen] = optimize.lsq_linear(root.T, target, (-unit, 1.0 - unit), method="bvls").x
    return step


def _squares(moves: Array) -> Array:
    return moves.T @ moves


def _unknown(hessian: Array) -> Array:
    """Covariance of combinations without effect, which vary over the whole ranges, ``[parameter, parameter]``."""
    information, axes = np.linalg.eigh(hessian)
    nothing = axes[:, information <= NOTHING * max(1e-12, information.max())]
    return nothing @ nothing.T
