"""The last steps to the minimum, and the sensitivities there.

Gauss-Newton with the differences of `op3.identify.sensitivity.arms_at`: along combinations of parameters, and as long
as an interval. So the matrix that says how well each parameter is known is the one that took the search there, and a
valley in which parameters trade off is walked along, not across.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from op3.identify.box_step import box_step
from op3.identify.sensitivity import Array, Residuals, Sensitivity, arms_at, sensitivity_of

DAMPING = (1e-2, 1e-1, 1.0, 1e1, 1e2)
"""Dampings tried in every step, as multiples of that at which a third of all ranges raises the loss by a fiftieth."""

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
    """At most so many steps, each a batch of 2 n differences and a batch of dampings; then the sensitivities.

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
    names = list(bounds)
    low = np.array([bounds[name][0] for name in names])
    span = np.array([bounds[name][1] for name in names]) - low
    unit = np.clip((np.array([values[name] for name in names]) - low) / span, 0.0, 1.0)
    residual: Array = _simulate(residuals, unit[None])[0] if known is None else known
    unseen = np.zeros(len(names), dtype=bool)
    jump = 0.0
    if curvature is None:
        arms = arms_at(residuals, unit, residual, None, failed_loss=failed_loss)
        curvature, jump, unseen = arms.curvature, arms.jump, arms.unseen
    history, again, moving = [float(residual @ residual)], LENGTHENED, steps > 0
    while True:
        arms = arms_at(residuals, unit, residual, curvature, jump, failed_loss)
        curvature, jump = arms.curvature, arms.jump
        if moving:
            ladder = _ladder(unit, arms.jacobian, residual)
            points = np.concatenate([arms.points, ladder])
            found = np.concatenate([arms.residual, _simulate(residuals, ladder)])
            losses = np.square(found).sum(1)
            best, before = int(losses.argmin()), unit
            if losses[best] < history[-1]:
                unit, residual = points[best], found[best]
            history.append(float(residual @ residual))
            if progress is not None:
                progress(len(history) - 1, history[-1])
            gained = history[-1] < (1 - GAIN) * history[-2]
            moving = gained and len(history) <= steps
            if moving or (gained and not arms.reach(unit - before)):
                continue
        if again == 0 or arms.long_enough(history[-1]):
            break
        again -= 1
    found_values = {name: float(v) for name, v in zip(names, low + unit * span, strict=True)}
    sensitivity = sensitivity_of(bounds, unit, residual, arms, unseen)
    return Polished(found_values, history[-1], history, sensitivity)


def _simulate(residuals: Residuals, points: Array) -> Array:
    return residuals(torch.from_numpy(np.ascontiguousarray(points))).numpy()


def _ladder(unit: Array, jacobian: Array, residual: Array) -> Array:
    """Points after bounded Gauss-Newton steps of growing damping, ``[damping, parameter]``."""
    size = len(unit)
    curvature, gradient = jacobian.T @ jacobian, jacobian.T @ residual
    scale = 0.02 * float(residual @ residual) * 9.0
    points = []
    for factor in DAMPING:
        damped = curvature + max(factor * scale, 1e-12 * float(np.trace(curvature)) + 1e-30) * np.eye(size)
        points.append(np.clip(unit + box_step(damped, gradient, -unit, 1.0 - unit), 0.0, 1.0))
    return np.array(points)
