"""The final steps to the minimum, and the sensitivities there.

Gauss-Newton steps use the differences of `op3.identify.sensitivity`, which run along combinations of parameters and are
as long as an interval. Intervals therefore come from the matrix that guided the search, and the search follows a valley
in which parameters trade off along its length.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from op3.identify.refine import least_squares
from op3.identify.sensitivity import Array, Box, Residuals, Sensitivity, sensitivity_at, simulate

GAIN = 1e-3
"""Smallest relative decrease of the loss per step; a smaller decrease ends the refinement."""

LENGTHENED = 2
"""How often difference steps that are too short are lengthened."""


@dataclass(frozen=True, eq=False)
class Polished:
    """The final point, the residual's squared length before and after every step, and sensitivities at the final
    point."""

    values: Mapping[str, float]
    history: Sequence[float]
    sensitivity: Sensitivity


def polish(
    residuals: Residuals,
    box: Box,
    values: Mapping[str, float],
    *,
    steps: int = 2,
    curvature: Array | None = None,
    known: Array | None = None,
    failed_loss: float = np.inf,
) -> Polished:
    """Take a number of steps, each after a batch of 2 n differences; then compute the sensitivities.

    Args:
        residuals: maps points of the unit box ``[candidate, parameter]`` to ``[candidate, residual]``.
        values: the initial point, clipped to the box.
        steps: largest number of steps; 0 only computes the sensitivities.
        curvature: estimate of the Jacobian's product with itself, ``[parameter, parameter]``; None: unknown.
        known: residual at the initial point, ``[residual]``; None: it is simulated.
        failed_loss: squared length of the residual that only a diverged simulation reaches.
    """
    unit = box.unit(values)
    residual = simulate(residuals, unit[None])[0] if known is None else known
    history, jump, unseen = [float(residual @ residual)], 0.0, np.zeros(len(unit), dtype=bool)
    if curvature is None:
        first = sensitivity_at(residuals, box, unit, residual, None, failed_loss=failed_loss)
        curvature, jump, unseen = first.curvature, first.jump, first.unseen
    latest: Sensitivity | None = None

    def measure(unit: Array, residual: Array) -> Array:
        nonlocal latest, curvature, jump
        latest = sensitivity_at(residuals, box, unit, residual, curvature, jump, failed_loss)
        curvature, jump = latest.curvature, latest.jump
        return latest.jacobian

    if steps:
        how = {"steps": steps, "tolerance": GAIN, "note": history.append}
        unit, residual = least_squares(residuals, unit, residual, measure, **how)
    for _ in range(1 + LENGTHENED):
        if latest is not None and np.array_equal(unit, latest.unit) and latest.long_enough:
            break
        measure(unit, residual)
    assert latest is not None
    return Polished(box.values(unit), history, replace(latest, unseen=unseen | latest.unseen))
