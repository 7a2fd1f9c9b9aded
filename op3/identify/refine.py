"""Bounded least squares with scipy from the best points of a search; every Jacobian is one batch of simulations."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from op3.identify.sensitivity import Array, Box, Residuals, simulate

DIFFERENCE_STEP = 2e-3
"""Step of finite differences, as a share of a parameter's range: above stiction's kinks, below curvature."""

TRIES = 4
"""Average number of simulated points allowed per step; a step that does not lower the loss is shortened."""


@dataclass(frozen=True)
class Refinement:
    """Result of least squares from the best starting point, and the best loss before and after every iteration."""

    values: Mapping[str, float]
    loss: float
    history: Sequence[float]


def refine(
    residuals: Residuals,
    box: Box,
    starts: Sequence[Mapping[str, float]],
    *,
    max_iterations: int = 25,
    tolerance: float = 2e-3,
) -> Refinement:
    """Least squares from several starting points.

    Args:
        residuals: maps points of the unit box ``[candidate, parameter]`` to ``[candidate, residual]``.
        starts: initial values, clipped to the box.
        max_iterations: largest number of Jacobians per starting point.
        tolerance: a start has converged if an iteration lowers its loss by less than this share.
    """
    history = [np.inf]

    def differences(unit: Array, residual: Array) -> Array:
        steps = np.where(unit + DIFFERENCE_STEP > 1.0, -DIFFERENCE_STEP, DIFFERENCE_STEP)
        moved = simulate(residuals, unit + np.diag(steps))
        return ((moved - residual) / steps[:, None]).T

    def note(loss: float) -> None:
        history.append(min(history[-1], loss))

    def descend(unit: Array) -> tuple[float, Array]:
        residual = simulate(residuals, unit[None])[0]
        history[0] = min(history[0], float(residual @ residual)) if len(history) == 1 else history[0]
        unit, residual = least_squares(
            residuals, unit, residual, differences, steps=max_iterations, tolerance=tolerance, note=note
        )
        return float(residual @ residual), unit

    loss, unit = min((descend(box.unit(start)) for start in starts), key=lambda end: end[0])
    return Refinement(box.values(unit), loss, history)


def least_squares(
    residuals: Residuals,
    unit: Array,
    residual: Array,
    jacobian: Callable[[Array, Array], Array],
    *,
    steps: int,
    tolerance: float,
    note: Callable[[float], None],
) -> tuple[Array, Array]:
    """Minimise within the unit box by a trust region method (`scipy.optimize.least_squares`).

    Args:
        unit: starting point, ``[parameter]``.
        residual: residual at the starting point, ``[residual]``.
        jacobian: function of a point and its residual: ``[residual, parameter]``.
        steps: largest number of steps.
        tolerance: the search ends after a step that lowers the loss by less than this share.
        note: function that is called after every step with the loss, the squared length of the residual.

    Returns:
        The last point and its residual.
    """
    known = {unit.tobytes(): residual}

    def at(point: Array) -> Array:
        key = point.tobytes()
        if key not in known:
            known[key] = simulate(residuals, point[None])[0]
        return known[key]

    def stop(intermediate_result: optimize.OptimizeResult) -> None:
        note(2 * float(intermediate_result.cost))
        if intermediate_result.nit >= steps:
            raise StopIteration

    found = optimize.least_squares(
        at, unit, lambda point: jacobian(point, at(point)),  # type: ignore[arg-type]
        bounds=(0.0, 1.0), ftol=tolerance, xtol=1e-6, gtol=1e-15,
        max_nfev=1 + TRIES * steps, callback=stop,
    )  # fmt: skip
    return found.x, at(found.x)
