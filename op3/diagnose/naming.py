"""What a search for findings passes on: proposals, refits of them, names, and the judge around what is named."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from op3.diagnose.base import Baseline
from op3.diagnose.candidates import Candidate, place_priors, secants_of_place
from op3.diagnose.coordinates import Coordinate
from op3.diagnose.held_out import Gain, HeldOutScore
from op3.diagnose.judge import Judge, Numbers, Posterior, Rows, Variances
from op3.diagnose.judge_settings import SETTINGS, Settings
from op3.diagnose.relevance import Relevance

NOTHING = 1e-6
"""Torque below which a candidate does nothing here [units]."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A candidate with the size that is linear in the judge's rows.

    Attributes:
        number: of the candidate.
        step: how far the base's numbers move with it, ``[coordinate]``.
        share: of its secant.
        state: the judge's variances.
    """

    number: int
    step: np.ndarray
    share: float
    state: Variances


@dataclass(frozen=True, eq=False)
class Refit:
    """A candidate fitted with everything else, nonlinearly.

    Attributes:
        log_odds: by the evidence of the windows that were fitted.
        base: the fit.
        number: of the candidate.
    """

    log_odds: float
    base: Baseline
    number: int


@dataclass(frozen=True, eq=False)
class Rival:
    """A name that predicts runs that were left out as well as a finding's, and the same of them.

    Attributes:
        candidate: what it is.
        behind: the finding's gain on it.
    """

    candidate: Candidate
    behind: Gain


@dataclass(frozen=True, eq=False)
class Named:
    """An effect that was found.

    Attributes:
        candidate: what it is.
        coordinates: its numbers in the fit, its size the first.
        log_odds: by the evidence of the windows that were fitted, when it was named.
        gain: of the model with it on the model without, in runs that were left out.
        relevance: what it does.
        rivals: names that are not distinguished from it.
    """

    candidate: Candidate
    coordinates: tuple[Coordinate, ...]
    log_odds: float
    gain: Gain
    relevance: Relevance
    rivals: tuple[Rival, ...] = ()


@dataclass(frozen=True, eq=False)
class Judged:
    """A refit as it would be named.

    Attributes:
        named: what it is, and what it gains on the model without it.
        base: the fit.
        score: of runs that were left out.
    """

    named: Named
    base: Baseline
    score: HeldOutScore


@dataclass(frozen=True, eq=False)
class NamingStage:
    """The judge around a base with some effects named.

    Attributes:
        base: the fit, the named effects' numbers the last of its own.
        named: the effects.
        found: candidates.
        columns: of those in one joint or in all, by key, ``[joint, window, row]``.
        judge: of them.
        fit: with nothing else named.
    """

    base: Baseline
    named: tuple[Named, ...]
    found: tuple[Candidate, ...]
    columns: Mapping[tuple, np.ndarray]
    judge: Judge
    fit: Posterior


def numbers_of(
    base: Baseline, found: Sequence[Candidate], parts: Sequence[tuple], rows: Rows, settings: Settings = SETTINGS
) -> Numbers:
    """Priors of the base's numbers and of the candidates.

    A spike is what makes so much torque, root mean square over the joints that feel it; the secants of one effect in
    one place share it, and the place's prior. Parts are keys of candidates in one joint or in all, of which the others
    are sums.
    """
    own, number = base.numbers, {key: i for i, key in enumerate(parts)}
    model = base.model
    low, high, slab = np.array([one.reach(model, settings) for one in found]).reshape(-1, 3).T
    size = _torques(rows, len(base.point), len(parts))
    spike, secants = np.full(len(parts), 1e-9), secants_of_place(found)
    for one, wide, count in zip(found, slab, secants, strict=True):
        i = number.get(one.key)
        if i is not None and size[i] > NOTHING:
            ends = settings.spike_ends[0] * wide, settings.spike_ends[1] * wide
            spike[i] = np.clip(settings.spike / size[i], *ends) / np.sqrt(count)
    members = [tuple(number[key] for key in one.parts if key in number) for one in found]
    seen = np.array([max((size[i] for i in one), default=0.0) > NOTHING for one in members], bool)
    return Numbers(
        np.concatenate([own.mean, np.zeros(len(parts))]),
        np.concatenate([own.deviation, spike]),
        tuple(tuple(len(base.point) + i for i in one) for one in members),
        slab,
        low,
        high,
        np.where(seen, place_priors(found) - np.log(secants), -np.inf),
        np.concatenate([own.least, np.full(len(parts), -np.inf)]),
        np.concatenate([own.most, np.full(len(parts), np.inf)]),
    )


def _torques(rows: Rows, own: int, count: int) -> np.ndarray:
    """What each column behind the base's makes, root mean square over the joints that feel it [units], ``[column]``."""
    square, felt, torque = np.zeros(count), np.zeros(count), rows.kinds < 2
    for columns, values, variance in zip(rows.columns, rows.values, rows.variance, strict=True):
        mine, seen = columns >= own, np.isfinite(variance[:, 0])
        part = np.abs(values[mine][:, seen][..., torque]).reshape(int(mine.sum()), -1)
        if part.size:
            part = np.minimum(part, np.quantile(part, 0.97, axis=1, keepdims=True))
            square[columns[mine] - own] += np.square(part).sum(1)
            felt[columns[mine] - own] += part.shape[1]
    return np.sqrt(square / np.maximum(felt, 1))
