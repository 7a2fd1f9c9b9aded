"""Data classes of the search for findings: proposals, refits, named effects, and the linear model around them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from op3.diagnose.base import Baseline
from op3.diagnose.candidates import Candidate, log_priors, secant_counts
from op3.diagnose.coordinates import Coordinate
from op3.diagnose.held_out import Gain
from op3.diagnose.judge import CoefficientPriors, Judge, Posterior, Rows, Variances
from op3.diagnose.judge_settings import SETTINGS, Settings
from op3.diagnose.linearisation import Column
from op3.diagnose.relevance import Relevance

NEGLIGIBLE = 1e-6
"""Numerical: RMS torque below which a candidate has no influence [torque units]."""


SIMILAR = 0.7
"""Correlation of gains over runs and joints, or of columns over rows, above which two effects are alternatives."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A candidate with its size in the linear model.

    Attributes:
        index: index of the candidate.
        step: change of the baseline's coordinates when the candidate is included, ``[coordinate]``.
        share: size as a share of the candidate's secant.
        variances: variances of the linear model with the candidate.
    """

    index: int
    step: np.ndarray
    share: float
    variances: Variances


@dataclass(frozen=True, eq=False)
class Refit:
    """The baseline refitted with a candidate in the nonlinear simulation.

    Attributes:
        log_odds: log odds by the evidence of the fitted windows.
        base: the fit.
        index: index of the candidate.
    """

    log_odds: float
    base: Baseline
    index: int


@dataclass(frozen=True, eq=False)
class Rival:
    """A candidate that predicts left-out runs as well as a finding, with gains in the same runs and joints.

    Attributes:
        candidate: effect and joints.
        finding_gain: held-out gain of the finding over this candidate.
        log_odds: log odds of the finding against this candidate, from the evidence of the fitted windows.
    """

    candidate: Candidate
    finding_gain: Gain
    log_odds: float


@dataclass(frozen=True, eq=False)
class NamedEffect:
    """An accepted candidate.

    Attributes:
        candidate: effect and joints.
        coordinates: its coordinates in the fit, the size first.
        log_odds: log odds by the evidence of the fitted windows when it was named.
        gain: held-out gain of the model with the candidate over the model without it.
        relevance: torque that the effect produces.
        rivals: candidates that are not distinguishable from this one.
    """

    candidate: Candidate
    coordinates: tuple[Coordinate, ...]
    log_odds: float
    gain: Gain
    relevance: Relevance
    rivals: tuple[Rival, ...] = ()


@dataclass(frozen=True, eq=False)
class ScoredRefit:
    """A refit with its held-out result.

    Attributes:
        effect: the candidate as it would be named.
        base: the fit.
        density: held-out log densities, ``[run, joint]``.
    """

    effect: NamedEffect
    base: Baseline
    density: np.ndarray


@dataclass(frozen=True, eq=False)
class NamingStage:
    """The linear model around a baseline that includes the effects named so far.

    Attributes:
        base: the fit, the coordinates of the named effects last.
        named: the named effects.
        candidates: all other candidates.
        columns: columns of the elementary candidates, by key.
        judge: the linear model.
        fit: its posterior with no further effect.
    """

    base: Baseline
    named: tuple[NamedEffect, ...]
    candidates: tuple[Candidate, ...]
    columns: Mapping[tuple, Column]
    judge: Judge
    fit: Posterior


def coefficient_priors(
    base: Baseline, candidates: Sequence[Candidate], keys: Sequence[tuple], rows: Rows, settings: Settings = SETTINGS
) -> CoefficientPriors:
    """Priors of the baseline's coordinates and of the candidates.

    The spike of a candidate is the amplitude that produces the RMS torque `spike` in the joints that it affects. All
    candidates of one hypothesis share its spike and its prior.

    Args:
        base: the baseline.
        candidates: the candidates.
        keys: keys of the elementary candidates, in the order of their columns.
        rows: the linear model.
        settings: tuned constants.
    """
    steps, index, count = base.priors, {key: i for i, key in enumerate(keys)}, len(base.point)
    low, high, slab = np.array([c.size_range(base.model, settings) for c in candidates]).reshape(-1, 3).T
    torque = _rms_torques(rows, count, len(keys))
    spike, secants = np.full(len(keys), 1e-9), secant_counts(candidates)
    for candidate, slab_deviation, secant_count in zip(candidates, slab, secants, strict=True):
        i = index.get(candidate.key)
        if i is not None and torque[i] > NEGLIGIBLE:
            bounds = settings.spike_range[0] * slab_deviation, settings.spike_range[1] * slab_deviation
            spike[i] = np.clip(settings.spike / torque[i], *bounds) / np.sqrt(secant_count)
    members = [tuple(index[key] for key in candidate.components if key in index) for candidate in candidates]
    active = np.array([max((torque[i] for i in member), default=0.0) > NEGLIGIBLE for member in members], bool)
    unbounded = np.full(len(keys), np.inf)
    return CoefficientPriors(
        np.concatenate([steps.mean, np.zeros(len(keys))]),
        np.concatenate([steps.deviation, spike]),
        tuple(tuple(count + i for i in member) for member in members),
        slab,
        low,
        high,
        np.where(active, log_priors(candidates) - np.log(secants), -np.inf),
        np.concatenate([steps.lower, -unbounded]),
        np.concatenate([steps.upper, unbounded]),
    )


def _rms_torques(rows: Rows, first: int, count: int) -> np.ndarray:
    """RMS torque of each candidate's column over the joints that it affects [torque units], ``[column]``."""
    square, samples, torque = np.zeros(count), np.zeros(count), rows.kinds < 2
    for coefficients, design, variance in zip(rows.coefficients, rows.design, rows.variance, strict=True):
        further, valid = coefficients >= first, np.isfinite(variance[:, 0])
        size = np.abs(design[further][:, valid][..., torque]).reshape(int(further.sum()), -1)
        if size.size:
            size = np.minimum(size, np.quantile(size, 0.97, axis=1, keepdims=True))
            square[coefficients[further] - first] += np.square(size).sum(1)
            samples[coefficients[further] - first] += size.shape[1]
    return np.sqrt(square / np.maximum(samples, 1))


def best_refit(
    accepted: Sequence[ScoredRefit], without: np.ndarray, settings: Settings
) -> tuple[ScoredRefit, tuple[Rival, ...]]:
    """The refit that is named, and its rivals.

    Held-out runs decide where they can: eligible are the refit with the largest gain, and those with gains in the same
    runs and joints that are not significantly worse. Among these, the evidence decides. If the evidence of related
    effects differs by less than an alarm, the effect with the fewest parameters is named.

    Args:
        accepted: refits with a significant gain.
        without: held-out log densities of the model without the effects, ``[run, joint]``.
        settings: settings with the alarm, and the gain in standard errors above which one refit is better than another.
    """
    leader = max(accepted, key=lambda refit: refit.effect.gain.mean)
    similar = [refit for refit in accepted if refit is leader or _similar(leader.density, refit.density, without)]
    equal = [refit for refit in similar if Gain.of(leader.density, refit.density).z < settings.threshold]
    evident = max(equal, key=lambda refit: refit.effect.log_odds)
    name, least = evident.effect.candidate.effect.name, evident.effect.log_odds - settings.alarm
    related = [
        refit
        for refit in equal
        if (refit.effect.log_odds > least and refit.effect.candidate.effect.related({name})) or refit is evident
    ]
    best = min(related, key=lambda refit: (len(refit.effect.coordinates), -refit.effect.log_odds))
    rivals = [
        Rival(r.effect.candidate, Gain.of(best.density, r.density), best.effect.log_odds - r.effect.log_odds)
        for r in equal
        if r is not best
    ]
    return best, tuple(rival for rival in rivals if rival.finding_gain.z < settings.threshold)


def probability_shares(rivals: Sequence[Rival], settings: Settings) -> np.ndarray:
    """How the probability that a finding or one of its rivals is present divides among them, ``[1 + rival]``.

    A rival's odds fall with the finding's held-out gain over it, and by a factor of e for each `alarm` of log evidence
    between them, because differences below an alarm also occur between wrong laws. No rival gets more than the finding,
    which was chosen first.
    """
    lead = [settings.steepness * max(r.finding_gain.z, 0.0) + max(r.log_odds, 0.0) / settings.alarm for r in rivals]
    odds = np.exp(-np.array([0.0, *lead]))
    return odds / odds.sum()


def _similar(density: np.ndarray, other: np.ndarray, without: np.ndarray) -> bool:
    """Whether two models gain in the same joints of the same runs: the correlation of their gains."""
    first, second = (d.ravel() for d in (density - without, other - without))
    return float(first @ second) > SIMILAR * float(np.linalg.norm(first) * np.linalg.norm(second))
