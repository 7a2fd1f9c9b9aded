"""NSGA-II with proposals that lower one objective along the level set of the other.

Re-identification has two objectives of different kinds. The excitation loss is the squared length of a residual that
changes almost linearly with the parameters, so its region of low loss is a long, thin ellipsoid oblique to all axes,
and crossover and mutation of single parameters move most children out of it. The distance between returns is rough and
at first contains little information about single parameters. Both objectives are learned from vectors stored with
finished trials: a short projection of the residual, and the differences between the sorted returns and those of the
robot. Gaussian processes of these vectors (`op3.identify.surrogate`) predict both objectives. Part of each population
is drawn from the level set, where the second objective is predicted to be lowest. The rest are ordinary children, and
all trials may become parents.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import optuna
import torch
from numpy.typing import ArrayLike, NDArray
from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.samplers import NSGAIISampler
from optuna.trial import FrozenTrial, TrialState
from torch import Tensor

from op3.identify.level_set import draw_level_set
from op3.identify.sensitivity import Array, Box
from op3.identify.surrogate import Surrogate

IMAGE = "residual_image"
"""Attribute of a trial: a vector that changes linearly with the residual of the first objective."""

MISFIT = "misfit"
"""Attribute of a trial: a vector that is zero where the second objective is zero."""

ENOUGH = 2.0
"""Number of trials per parameter before surrogates are used."""

FAR = 1.5
"""The second objective is learned from trials whose first objective is at most this many times the limit."""

LEARNED = 200
"""Number of trials with the lowest objective that a surrogate learns from."""

RISES = (0.2, 0.6, 1.0)
"""Expected rises of the first objective for drawn points, as shares of the tolerated rise."""

AIMED = 0.6
"""Share of the tolerated rise up to which points are proposed, because predictions are not exact."""

DRAWS = 150
"""Number of points drawn for each rise."""

LEAPS = 1500
"""Number of steps tried from the best trials."""

IMAGE_LENGTH = 128
"""Length of an image: squared norms then differ from those of the residuals by about an eighth."""

BEST = 20
"""Number of best trials from which steps start."""

STEPS = (0.02, 0.5)
"""Lengths of steps, as shares of the difference between two points of the level set."""

CAUTION = (0.5, -0.3, -1.0)
"""Weights of the variance relative to the squared mean; negative ones explore. Each serves an equal share of
proposals.
"""

APART = 0.05
"""Proposals closer than this, in length scales, count as duplicates."""


@dataclass(frozen=True, eq=False)
class Observed:
    """Data of finished trials.

    Attributes:
        points: points in the unit box, ``[trial, parameter]``.
        losses: first objective, ``[trial]``.
        images: projections of the residual, ``[trial, number]``.
        misfits: differences of the sorted returns, ``[trial, number]``; NaN without the second objective.
    """

    points: Array
    losses: Array
    images: Array
    misfits: Array

    def near(self, limit: float) -> NDArray[np.bool_]:
        """Trials with a second objective whose first objective is not far above a limit."""
        return np.isfinite(self.misfits).all(1) & (self.losses <= FAR * limit)


class LevelSetSampler(NSGAIISampler):
    """NSGA-II in which surrogates propose the first children of every population.

    Args:
        proposals: largest number of proposals per population; a new sampler is built for each population.
        tolerated: allowed first objective, as a multiple of the nominal trial's, or of the lowest objective.
    """

    def __init__(self, *, proposals: int, tolerated: float = 1.25, seed: int | None = None, **options: Any):
        if proposals < 0 or not tolerated > 1.0:
            raise ValueError(f"proposals must be at least 0 and tolerated above 1, got {proposals} and {tolerated}")
        super().__init__(seed=seed, **options)
        self._count, self._tolerated = proposals, tolerated
        self._random = np.random.default_rng(None if seed is None else [seed, 11])
        self._proposed: list[dict[str, Any]] | None = None

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Parameters of a trial: a proposal while any remain, otherwise a child."""
        if self._proposed is None:
            self._proposed = self._propose(study.get_trials(deepcopy=False), search_space)
        if not self._proposed:
            return super().sample_relative(study, trial, search_space)
        self.get_trial_generation(study, trial)  # stores the generation, which parents need
        return self._proposed.pop(0)

    def _propose(
        self, trials: Sequence[FrozenTrial], search_space: dict[str, BaseDistribution]
    ) -> list[dict[str, Any]]:
        ranges = {name: d for name, d in search_space.items() if isinstance(d, FloatDistribution) and not d.log}
        if not ranges or len(ranges) < len(search_space):
            return []
        observed = _observed(trials, _box(ranges))
        if observed is None:
            return []
        nominal = [t.values[0] for t in trials if t.state == TrialState.COMPLETE and t.user_attrs.get("nominal")]
        limit = self._tolerated * (nominal[0] if nominal else float(observed.losses.min()))
        if observed.near(limit).sum() < ENOUGH * len(ranges):
            return []
        points = propose(observed, limit, self._count, self._random)
        box, high = _box(ranges), np.array([d.high for d in ranges.values()])
        values = np.minimum(box.low + points * box.span, high)  # rounding must not exceed a range
        return [dict(zip(ranges, row, strict=True)) for row in values.tolist()]


def residual_image(residual: Tensor) -> Tensor:
    """Short vectors with approximately the lengths and mutual angles of the residuals.

    ``[candidate, residual]`` to ``[candidate, number]``: sums of all residuals with fixed random signs
    (Johnson & Lindenstrauss 1984; Achlioptas 2003).
    """
    generator = torch.Generator().manual_seed(0)
    signs = torch.randint(0, 2, (residual.shape[1], IMAGE_LENGTH), generator=generator, dtype=torch.int8)
    return residual @ (2 * signs - 1).to(residual.dtype) / IMAGE_LENGTH**0.5


def quantile_misfit(simulated: ArrayLike, actual: Sequence[float]) -> Array:
    """Differences between the quantiles of two samples, ``[actual]``.

    The mean of their absolute values is the Wasserstein-1 distance if the samples have equal size.
    """
    places = (np.arange(len(actual)) + 0.5) / len(actual)
    return np.quantile(np.asarray(simulated), places, method="hazen") - np.sort(actual)


def _box(ranges: Mapping[str, FloatDistribution]) -> Box:
    return Box.of({name: (d.low, max(d.high, d.low + 1e-300)) for name, d in ranges.items()})


def _observed(trials: Sequence[FrozenTrial], box: Box) -> Observed | None:
    known = [
        t
        for t in trials
        if t.state == TrialState.COMPLETE and IMAGE in t.user_attrs and all(name in t.params for name in box.names)
    ]
    if not known:
        return None
    length = max(len(t.user_attrs.get(MISFIT, ())) for t in known)
    return Observed(
        np.array([box.unit(t.params) for t in known]),
        np.array([t.values[0] for t in known]),
        np.array([t.user_attrs[IMAGE] for t in known], dtype=np.float64),
        np.array([t.user_attrs.get(MISFIT, [np.nan] * length) for t in known], dtype=np.float64).reshape(
            len(known), -1
        ),
    )


def propose(observed: Observed, limit: float, count: int, rng: np.random.Generator) -> Array:
    """Points at which the first objective is expected to be below a limit and the second to be low.

    They have the shape ``[point, parameter]`` and are in the unit box.
    """
    foreseen = _Losses(observed)
    rise = max(limit / foreseen.lowest_loss - 1.0, 1e-3)
    drawn = [foreseen.draw(share * rise, rng) for share in RISES]
    pool = np.concatenate(drawn)
    whole = observed.near(limit)
    order = np.flatnonzero(whole)[np.argsort(np.square(observed.misfits[whole]).sum(1), kind="stable")]
    returns = Surrogate(observed.points[order[:LEARNED]], observed.misfits[order[:LEARNED]])
    # along differences between points of the level set
    within = order[observed.losses[order] <= limit]
    begin = observed.points[(within if len(within) else order)[:BEST]]
    across = pool[rng.integers(0, len(pool), LEAPS)] - pool[rng.integers(0, len(pool), LEAPS)]
    steps = begin[rng.integers(0, len(begin), LEAPS)] + across * rng.uniform(*STEPS, LEAPS)[:, None]
    pool = np.concatenate([pool, steps])
    pool = pool[((pool >= 0.0) & (pool <= 1.0)).all(1)]
    pool = pool[foreseen.at(pool) <= foreseen.lowest_loss * (1.0 + AIMED * rise)]
    if not len(pool):
        return pool
    mean, variance = (part.numpy() for part in returns.predict(torch.from_numpy(pool)))
    scales = returns.inverse_lengths.numpy()
    chosen: list[Array] = []
    for level, caution in enumerate(CAUTION):
        target = count * (level + 1) // len(CAUTION)
        for i in np.argsort(mean + caution * variance, kind="stable"):
            if len(chosen) >= target:
                break
            if all(np.linalg.norm((pool[i] - other) * scales) > APART for other in chosen):
                chosen.append(pool[i])
    return np.array(chosen).reshape(-1, pool.shape[1])


class _Losses:
    """Predicts the first objective as the expected square of the image, corrected by the error of nearby images."""

    def __init__(self, observed: Observed):
        order = np.argsort(observed.losses, kind="stable")[:LEARNED]
        points, images = observed.points[order], observed.images[order]
        squares = np.square(images).sum(1)
        self.lowest_loss = float(observed.losses[order[0]])
        self._lowest, self._image_loss = points[0], float(squares[0])
        self._images = Surrogate(points, images)
        self._off = np.log(observed.losses[order]) - np.log(squares)
        self._correction = Surrogate(points, self._off[:, None])

    def at(self, points: Array) -> Array:
        """The objective at points, ``[point]``."""
        unit = torch.from_numpy(points)
        mean, variance = self._images.predict(unit)
        return (mean + variance).numpy() * np.exp(self._correction.weights(unit).numpy() @ self._off)

    def draw(self, rise: float, rng: np.random.Generator) -> Array:
        """Points at which the objective is expected to exceed its minimum by at most this share."""
        gradient, curvature = self._images.slope(torch.from_numpy(self._lowest))
        return draw_level_set(self._lowest, curvature, gradient, rise * self._image_loss, DRAWS, rng)
