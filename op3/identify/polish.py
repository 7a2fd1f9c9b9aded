"""The last steps to the minimum, and the sensitivities there.

Gauss-Newton with the differences of `op3.identify.sensitivity.arms_at`: along combinations of parameters, and as long
as an interval. So the matrix that says how well each parameter is known is the one that took the search there, and a
valley in which parameters trade off is walked along, not across.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from op3.identify.refine import least_squares, simulate
from op3.identify.sensitivity import Arms, Array, Residuals, Sensitivity, arms_at, sensitivity_of

GAIN = 1e-3
"""Share of the loss by which a step has to lower it, or it was the last."""

LENGTHENED = 2
"""How often arms are made longer where the first ones prove too short."""


@dataclass(frozen=True, eq=False)
class Polished:
    """Where the steps ended.

    Attributes:
        values: by parameter name.
        loss: squared length of the residual there.
        history: loss before, and after every step.
        sensitivity: around that point.
    """

    values: Mapping[str, float]
    loss: float
    history: Sequence[float]
    sensitivity: Sensitivity


def polish(
    residuals: Residuals,
    bounds: Mapping[str, tuple[float, float]],
    values: Mapping[str, float],
    *,
    steps: int = 2,
    curvature: Array | None = None,
    known: Array | None = None,
    failed_loss: float = np.inf,
    progress: Callable[[int, float], None] | None = None,
) -> Polished:
    """At most so many steps, each after a batch of 2 n differences; then the sensitivities.

    Args:
        residuals: points of the unit box ``[candidate, parameter]`` to ``[candidate, residual]``.
        bounds: lowest and highest value by parameter name, in the order of the box.
        values: the point to start from; outside the bounds it is clipped.
        steps: at most; 0 measures the sensitivities only.
        curvature: what is known of the Jacobian's product with itself, ``[parameter, parameter]``; None: nothing.
        known: residual at the point to start from, ``[residual]``; None: it is simulated.
        failed_loss: a squared length of the residual that only a diverged simulation has.
        progress: called with step and loss.
    """
    low, span = np.array([(low, high - low) for low, high in bounds.values()]).T
    unit = np.clip((np.array([values[name] for name in bounds]) - low) / span, 0.0, 1.0)
    residual = simulate(residuals, unit[None])[0] if known is None else known
    unseen = np.zeros(len(unit), dtype=bool)
    if curvature is None:
        first = arms_at(residuals, unit, residual, None, failed_loss=failed_loss)
        curvature, jump, unseen = first.curvature, first.jump, first.unseen
    else:
        jump = 0.0
    history, latest = [float(residual @ residual)], _Latest(residuals, curvature, jump, failed_loss)

    def note(step: int, loss: float) -> None:
        history.append(loss)
        if progress is not None:
            progress(step, loss)

    if steps:
        unit, residual = least_squares(
            residuals, unit, residual, latest.measure, steps=steps, tolerance=GAIN, progress=note
        )
    for _ in range(1 + LENGTHENED):
        if latest.holds(unit, residual):
            break
        latest.measure(unit, residual)
    assert latest.arms is not None
    found = dict(zip(bounds, (low + unit * span).tolist(), strict=True))
    return Polished(found, history[-1], history, sensitivity_of(bounds, unit, residual, latest.arms, unseen))


class _Latest:
    """The arms measured last, and what they said."""

    def __init__(self, residuals: Residuals, curvature: Array, jump: float, failed_loss: float):
        self._residuals, self._failed_loss = residuals, failed_loss
        self._curvature, self._jump = curvature, jump
        self._unit: Array | None = None
        self.arms: Arms | None = None

    def measure(self, unit: Array, residual: Array) -> Array:
        """The Jacobian at a point."""
        self.arms = arms_at(self._residuals, unit, residual, self._curvature, self._jump, self._failed_loss)
        self._curvature, self._jump, self._unit = self.arms.curvature, self.arms.jump, unit.copy()
        return self.arms.jacobian

    def holds(self, unit: Array, residual: Array) -> bool:
        """Whether they are of this point, and long enough."""
        if self.arms is None or self._unit is None or not np.array_equal(unit, self._unit):
            return False
        return self.arms.long_enough(float(residual @ residual))
