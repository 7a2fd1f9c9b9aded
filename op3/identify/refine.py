"""Bounded Levenberg-Marquardt whose every step is one batch of simulations.

A batch of simulations costs little more than a single one, so the finite differences of all starts run at once,
and several dampings are tried side by side instead of one after another.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from op3.identify.box_step import box_step

DIFFERENCE_STEP = 2e-3
"""Step of finite differences, as a share of a parameter's range: above the kinks of stiction, below curvature."""

DAMPING_LADDER = (1e-2, 1e-1, 1.0, 1e1, 1e2)
"""Dampings tried in every iteration, as multiples of the last one that worked."""

RESIGNED = 1e1
"""Damping beyond which a start that cannot improve is given up."""


@dataclass(frozen=True)
class Refinement:
    """Where least squares ended.

    Attributes:
        values: parameters by name, of the best start.
        loss: squared length of the residual there.
        history: best loss after every iteration, the first before any.
        ends: parameters and loss at the end of every start, best first.
        evaluations: parameter sets simulated.
    """

    values: Mapping[str, float]
    loss: float
    history: Sequence[float]
    ends: Sequence[tuple[Mapping[str, float], float]]
    evaluations: int


def refine(
    residuals: Callable[[Tensor], Tensor],
    bounds: Mapping[str, tuple[float, float]],
    starts: Sequence[Mapping[str, float]],
    *,
    max_iterations: int = 25,
    tolerance: float = 2e-3,
    race: int | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Refinement:
    """Least squares from several starts at once.

    Args:
        residuals: points of the unit box ``[candidate, parameter]`` to ``[candidate, residual]``.
        bounds: lowest and highest value by parameter name; the order of names is that of the box.
        starts: values to start from; those outside the bounds are clipped.
        max_iterations: at most so many Jacobians.
        tolerance: a start has converged when an iteration lowers its loss by less than this share.
        race: iterations after which only the best start goes on; None: all go on until each has converged.
        progress: called with iteration and best loss.

    Raises:
        ValueError: if there are no bounds or no starts.
    """
    if not bounds or not starts:
        raise ValueError("refine needs at least one parameter and one start")
    names = list(bounds)
    low = np.array([bounds[name][0] for name in names])
    span = np.array([bounds[name][1] for name in names]) - low
    points = np.clip((np.array([[start[name] for name in names] for start in starts]) - low) / span, 0.0, 1.0)
    search = _Search(residuals, points)
    history = [float(search.losses.min())]
    while search.active.any() and len(history) <= max_iterations:
        search.iterate(tolerance)
        if race is not None and len(history) >= race:
            search.keep_best()
        history.append(float(search.losses.min()))
        if progress is not None:
            progress(len(history) - 1, history[-1])
    ends = [
        (
            {name: float(v) for name, v in zip(names, low + search.points[i] * span, strict=True)},
            float(search.losses[i]),
        )
        for i in np.argsort(search.losses)
    ]
    return Refinement(ends[0][0], ends[0][1], history, ends, search.evaluations)


class _Search:
    """State of all starts."""

    def __init__(self, residuals: Callable[[Tensor], Tensor], points: np.ndarray):
        self._residuals = residuals
        self.points = points
        self.evaluations = 0
        self.residual = self._evaluate(points)
        self.losses = np.square(self.residual).sum(1)
        self.damping = np.full(len(points), 1e-2)
        self.active = np.ones(len(points), dtype=bool)

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        self.evaluations += len(points)
        return self._residuals(torch.from_numpy(np.ascontiguousarray(points))).numpy()

    def iterate(self, tolerance: float) -> None:
        """One Jacobian and one ladder of steps for every start that has not converged."""
        active = np.flatnonzero(self.active)
        jacobians = self._jacobians(active)
        candidates = np.concatenate([self._ladder(i, jacobian) for i, jacobian in zip(active, jacobians, strict=True)])
        residual = self._evaluate(candidates)
        losses = np.square(residual).sum(1).reshape(len(active), -1)
        for row, i in enumerate(active):
            best = int(losses[row].argmin())
            if losses[row, best] < self.losses[i]:
                gained = 1.0 - losses[row, best] / self.losses[i]
                self.losses[i] = losses[row, best]
                self.points[i] = candidates[row * len(DAMPING_LADDER) + best]
                self.residual[i] = residual[row * len(DAMPING_LADDER) + best]
                self.damping[i] = max(1e-9, self.damping[i] * DAMPING_LADDER[best])
                self.active[i] = gained > tolerance
            else:
                # the whole ladder failed: try one far more careful step, then take the kinks for the floor
                self.active[i] = self.damping[i] < RESIGNED
                self.damping[i] *= 1e3

    def keep_best(self) -> None:
        """Give up all starts but the best; if that one has converged, the search is over."""
        self.active &= np.arange(len(self.losses)) == self.losses.argmin()

    def _jacobians(self, active: np.ndarray) -> list[np.ndarray]:
        """Finite differences ``[residual, parameter]`` of each active start, inwards at the bounds."""
        size = self.points.shape[1]
        steps = np.where(self.points[active] + DIFFERENCE_STEP > 1.0, -DIFFERENCE_STEP, DIFFERENCE_STEP)
        moved = (self.points[active][:, None] + steps[:, :, None] * np.eye(size)).reshape(-1, size)
        residual = self._evaluate(moved).reshape(len(active), size, -1)
        return [((residual[row] - self.residual[i]) / steps[row][:, None]).T for row, i in enumerate(active)]

    def _ladder(self, start: int | np.intp, jacobian: np.ndarray) -> np.ndarray:
        """Points after bounded steps of growing damping, ``[damping, parameter]``."""
        size = jacobian.shape[1]
        gradient = jacobian.T @ self.residual[start]
        hessian = jacobian.T @ jacobian
        scale = np.diag(hessian).max()
        points = []
        for factor in DAMPING_LADDER:
            damped = hessian + np.eye(size) * scale * self.damping[start] * factor
            step = box_step(damped, gradient, -self.points[start], 1.0 - self.points[start])
            points.append(np.clip(self.points[start] + step, 0.0, 1.0))
        return np.array(points)
