"""A smooth surrogate of the residuals that locates the region of the minimum with few simulations.

Friction gives the loss many local minima, and a gradient search stops at the first of them. Residuals are smoother than
the loss: over much of the ranges they change almost linearly. A Gaussian process (kriging) is therefore fitted to all
simulated residual vectors, and its prediction is squared. One kernel serves all residuals: a linear part, as in
Gauss-Newton, and a Matern part for the nonlinear rest. A prediction is then a weighted sum of simulated residuals, and
its expected square needs only their scalar products, however long the logs are (composite Bayesian optimisation;
Astudillo & Frazier, Bayesian Optimization of Composite Functions, ICML 2019).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from op3.identify.sensitivity import Array, Residuals, simulate

CAUTION = (1.0, 0.2, 0.02)
"""Weight of the variance relative to the squared mean: 1 gives the expected loss, smaller values give bolder steps."""

APART = 0.1
"""Proposals closer than this, in length scales, count as duplicates."""

UNTOLD = 0.3
"""Standard deviation of proposals along directions that the surrogate does not determine, as a share of a range."""

MOST_POINTS = 110
"""Number of best points that a surrogate learns from."""

PATIENCE = 3
"""Number of rounds without progress after which the search ends."""

PROGRESS = 0.02
"""Relative decrease of the best loss that counts as progress."""


@dataclass(frozen=True, eq=False)
class Exploration:
    """All simulated points.

    Attributes:
        points: points in the unit box, best first, ``[point, parameter]``.
        losses: squared lengths of the residuals, ``[point]``.
        residual: residual at the best point.
        history: best loss before the first round and after each round.
        curvature: product of the smoothed residual's Jacobian with itself at the best point,
            ``[parameter, parameter]``.
    """

    points: Array
    losses: Array
    residual: Array
    history: Sequence[float]
    curvature: Array


def explore(
    residuals: Residuals,
    points: Array,
    residual: Array,
    *,
    rounds: int,
    batch: int = 12,
    seed: int = 0,
    failed_loss: float = np.inf,
) -> Exploration:
    """Search with a surrogate of the residuals, which proposes a batch of points in each round.

    A third of a batch minimises the expected loss, and the other two thirds take increasing risk. If proposals
    coincide, the rest is drawn from the surrogate's level set at twice the best loss, mostly along uncertain
    directions.

    Args:
        points: initial points, spread over the box, ``[point, parameter]``.
        residual: residuals at these points, ``[point, residual]``.
        rounds: largest number of rounds.
        failed_loss: a loss that only a diverged simulation reaches.

    Raises:
        ValueError: if all simulations diverged.
    """
    rng = np.random.default_rng([seed, 3])
    first, count = len(points), points.shape[1]
    losses = np.square(residual).sum(1)
    if losses.min() >= failed_loss:
        raise ValueError("every simulation failed; check the log and the model")
    history = [float(losses.min())]
    scales = None
    while len(history) <= rounds and not _stuck(history):
        order = _worth_learning(losses, count, first, failed_loss)
        surrogate = Surrogate(points[order], residual[order], scales)
        scales = surrogate.scales
        proposals = _propose(surrogate, batch, rng)
        simulated = simulate(residuals, proposals)
        points, residual = np.concatenate([points, proposals]), np.concatenate([residual, simulated])
        losses = np.square(residual).sum(1)
        history.append(float(losses.min()))
    order = _worth_learning(losses, count, first, failed_loss)
    curvature = Surrogate(points[order], residual[order], scales).slope(torch.from_numpy(points[order[0]]))[1]
    order = np.argsort(losses, kind="stable")
    return Exploration(points[order], losses[order], residual[order[0]], history, curvature)


def _worth_learning(losses: Array, count: int, first: int, failed_loss: float) -> NDArray[np.intp]:
    """Points that a surrogate learns from, best first; poor points behave differently (falls, stops)."""
    order = np.argsort(losses, kind="stable")
    order = order[: min(MOST_POINTS, max(2 * count + 4, len(losses) - 2 * first // 5))]
    limit = max(30 * losses[order[0]], losses[order[min(2 * count, len(order) - 1)]])
    return order[(losses[order] <= limit) & (losses[order] < failed_loss)]


class Surrogate:
    """Gaussian process of residual vectors, centred on the best vector.

    Args:
        points: points in the unit box, best first, ``[point, parameter]``.
        residual: ``[point, residual]``.
        scales: initial logarithms of the kernel's inverse lengths, share of the Matern part, and noise.

    Attributes:
        scales: values fitted by marginal likelihood, ``[parameter + 2]``.
    """

    def __init__(self, points: Array, residual: Array, scales: Tensor | None = None):
        self.points = torch.from_numpy(np.ascontiguousarray(points))
        self._products = torch.from_numpy(residual @ residual.T)
        self._centred = torch.from_numpy((residual - residual[0]) @ (residual - residual[0]).T)
        size = self.points.shape[1]
        if scales is None:
            scales = torch.tensor([0.0] * size + [0.0, -6.0], dtype=torch.float64)
        try:
            self.scales = self._fit(scales)
            self._factor = self._cholesky(self.scales)
        except RuntimeError:  # includes a matrix without a Cholesky factor
            self.scales = scales
            self._factor = self._cholesky(scales)
        spread = torch.cholesky_solve(self._centred, self._factor).diagonal().sum()
        self._variance = float(spread) / len(self.points)

    @property
    def inverse_lengths(self) -> Tensor:
        """Inverse length scales of the kernel by parameter, in units of 1 / range."""
        return self.scales[:-2].clamp(-4, 4).exp()

    @property
    def best_loss(self) -> float:
        """The lowest simulated loss."""
        return float(self._products[0, 0])

    def _kernel(self, a: Tensor, b: Tensor, scales: Tensor) -> Tensor:
        inverse = scales[:-2].clamp(-4, 4).exp()
        a, b = (a - self.points[0]) * inverse, (b - self.points[0]) * inverse
        distance = (3 * (a[:, None] - b[None]).square().sum(-1) + 1e-12).sqrt()
        return a @ b.T + scales[-2].clamp(-6, 6).exp() * (1 + distance) * torch.exp(-distance)

    def _cholesky(self, scales: Tensor) -> Tensor:
        noise = scales[-1].clamp(-10, 2).exp() * torch.eye(len(self.points), dtype=torch.float64)
        return torch.linalg.cholesky(self._kernel(self.points, self.points, scales) + noise)

    def _fit(self, start: Tensor) -> Tensor:
        """Scales that maximise the marginal likelihood under weak priors; the scale of the residuals is eliminated."""
        scales = start.clone().requires_grad_()
        optimiser = torch.optim.LBFGS([scales], max_iter=80, line_search_fn="strong_wolfe")

        def cost() -> Tensor:
            optimiser.zero_grad()
            factor = self._cholesky(scales)
            misfit = torch.cholesky_solve(self._centred, factor).diagonal().sum() + 1e-30
            value = len(self.points) * misfit.log() + 2 * factor.diagonal().log().sum()
            value = value + 0.05 * scales[:-1].square().sum() + 0.02 * (scales[-1] + 6.0).square()
            value.backward()
            return value

        optimiser.step(cost)  # type: ignore[arg-type]
        found = scales.detach()
        return found if bool(found.isfinite().all()) else start

    def weights(self, unit: Tensor) -> Tensor:
        """Weights of the simulated residuals in the predictions, ``[candidate, point]``; they add up to one."""
        weights = torch.cholesky_solve(self._kernel(self.points, unit, self.scales), self._factor).T
        rest = 1 - weights.sum(-1, keepdim=True)
        return torch.cat([weights[:, :1] + rest, weights[:, 1:]], 1)

    def predict(self, unit: Tensor) -> tuple[Tensor, Tensor]:
        """Squared mean residual, and variance of the residual, each summed over the vector, ``[candidate]``.

        The expected loss is their sum.
        """
        kernel = self._kernel(unit, self.points, self.scales)
        weights = self.weights(unit)
        own = ((unit - self.points[0]) * self.inverse_lengths).square().sum(-1) + self.scales[-2].clamp(-6, 6).exp()
        variance = own - (torch.cholesky_solve(kernel.T, self._factor).T * kernel).sum(-1)
        return ((weights @ self._products) * weights).sum(-1), variance.clamp_min(0.0) * self._variance

    def minimise(self, starts: Tensor, caution: Tensor, steps: int = 200) -> tuple[Tensor, Tensor]:
        """Points within the box that minimise the squared mean plus `caution` times the variance, and the minima.

        Args:
            starts: initial points, ``[candidate, parameter]``.
            caution: weight of the variance, ``[candidate]``.
        """
        unit = starts.clone().requires_grad_()
        optimiser = torch.optim.Adam([unit])
        for step in range(steps):
            optimiser.param_groups[0]["lr"] = 0.03 * (1 - step / steps) + 2e-4
            optimiser.zero_grad()
            mean, variance = self.predict(unit)
            (mean + caution * variance + 1e-9).log().sum().backward()
            optimiser.step()
            with torch.no_grad():
                unit.clamp_(0.0, 1.0)
        with torch.no_grad():
            mean, variance = self.predict(unit)
        return unit.detach(), mean + caution * variance

    def slope(self, unit: Tensor) -> tuple[Array, Array]:
        """Products of the mean residual's Jacobian at a point with the residual, ``[parameter]``, and with itself.

        These are the gradient and the Gauss-Newton Hessian of half the squared residual.
        """
        step = 1e-3 * torch.eye(len(unit), dtype=torch.float64)
        change = (self.weights(unit + step) - self.weights(unit - step)) / 2e-3
        gradient = change @ self._products @ self.weights(unit[None])[0]
        return gradient.numpy(), (change @ self._products @ change.T).numpy()


def _stuck(history: Sequence[float]) -> bool:
    return len(history) > PATIENCE and history[-1] > (1 - PROGRESS) * history[-1 - PATIENCE]


def _propose(surrogate: Surrogate, batch: int, rng: np.random.Generator) -> Array:
    """Minima of the surrogate from many starting points at each level of caution, then draws from its level set."""
    known = surrogate.points.numpy()
    size = known.shape[1]
    near = known[rng.integers(0, min(10, len(known)), 40)] + 0.15 * rng.standard_normal((40, size))
    starts = np.concatenate([known[:8], np.clip(near, 0.0, 1.0), rng.uniform(size=(16, size))])
    caution = torch.tensor(CAUTION, dtype=torch.float64).repeat_interleave(len(starts))
    ends, values = surrogate.minimise(torch.from_numpy(starts).repeat(len(CAUTION), 1), caution)
    inverse = surrogate.inverse_lengths.numpy()
    chosen: list[Array] = []
    for level in range(len(CAUTION)):
        rows = slice(level * len(starts), (level + 1) * len(starts))
        points, value = ends[rows].numpy(), values[rows].numpy()
        target = batch * (level + 1) // len(CAUTION)
        mine = 0
        for i in np.argsort(value, kind="stable"):
            if len(chosen) >= target or (mine and value[i] > surrogate.best_loss):
                break
            if all(np.linalg.norm((points[i] - other) * inverse) > APART for other in chosen):
                chosen.append(points[i])
                mine += 1
    best = chosen[0] if chosen else known[0]
    share = max(surrogate.best_loss, 1e-12) / size
    curvature = surrogate.slope(torch.from_numpy(best))[1] + share / UNTOLD**2 * np.eye(size)
    eigenvalues, axes = np.linalg.eigh(curvature)
    draws = rng.standard_normal((batch - len(chosen), size)) * np.sqrt(share / eigenvalues)
    return np.concatenate([np.array(chosen).reshape(-1, size), np.clip(best + draws @ axes.T, 0.0, 1.0)])
