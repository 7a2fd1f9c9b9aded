"""What given logs reveal: the smallest size at which an effect is proposed, and effects with similar signatures."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from op3.diagnose.base import step_priors
from op3.diagnose.candidates import Hypothesis
from op3.diagnose.judge import evidence
from op3.diagnose.naming import SIMILAR, NamingStage
from op3.diagnose.verdict import separating
from op3.servo.effect import parameter

if TYPE_CHECKING:  # imports this module
    from op3.diagnose.diagnosis import Diagnosis

SIZES = np.geomspace(0.02, 20.0, 60)
"""Numerical: compared shares of a secant."""

VISIBLE = 0.3
"""Display: an effect is visible if the baseline leaves at least this share of its signature."""


def smallest_sizes(stage: NamingStage) -> np.ndarray:
    """Smallest share of each candidate's secant at which its expected log odds reach the alarm, ``[candidate]``;
    infinite if no plausible size reaches it."""
    priors, settings = stage.judge.priors, stage.judge.settings
    _, curvature = stage.judge.likelihood_terms(stage.fit)
    result = np.full(len(stage.candidates), np.inf)
    for size in SIZES[::-1]:
        share = np.where(priors.high > 0, size, -size)
        odds = evidence(curvature * share, curvature, 0.0, priors.slab, priors.low, priors.high) + priors.log_prior
        proposed = (odds > settings.alarm) & (share <= priors.high) & (share >= priors.low)
        result = np.where(proposed, size, result)
    return result


def not_shown(stage: NamingStage, joints: Sequence[str]) -> dict[str, list[str]]:
    """Effects that would not be proposed at any plausible size, with the affected joints (empty: all)."""
    visible: dict[Hypothesis, bool] = {}
    for candidate, share in zip(stage.candidates, smallest_sizes(stage), strict=True):
        visible[candidate.hypothesis] = visible.get(candidate.hypothesis, False) or bool(np.isfinite(share))
    result: dict[str, list[str]] = {}
    for (name, columns), is_visible in visible.items():
        if not is_visible and (columns is None or len(columns) == 1):
            result.setdefault(name, []).extend([] if columns is None else [joints[columns[0]]])
    return result


def aliasing(diagnosis: "Diagnosis", most: int = 60, *, planned: bool = False) -> dict[str, Any]:
    """Visibility of every effect in every set of joints, and pairs of effects with similar signatures after the
    baseline's parameters are projected out.

    Args:
        diagnosis: a diagnosis that has not run; its baseline is fitted and the catalogue's columns computed.
        most: largest number of pairs.
        planned: whether the model itself simulated the logs, so that no fit is needed.

    Returns:
        ``sentence``; by effect and joint ``visibility`` and ``smallest``, the smallest size that would be proposed
        (None if no plausible size would); ``hidden``, the effects below `VISIBLE`; ``show_by``, the catalogue's
        experiment that reveals each of them; ``alike``, pairs with their cosine and separating experiment, the most
        similar first.
    """
    stage = diagnosis.first_stage(fitted=not planned)
    joints = diagnosis.split.fit[0].joints
    projected, full = _products(stage)
    strength = np.sqrt(np.maximum(np.diag(projected), 0.0))
    visibility = strength / np.sqrt(np.maximum(np.diag(full), 1e-12))
    smallest = smallest_sizes(stage)
    best: dict[str, int] = {}
    for i, candidate in enumerate(stage.candidates):
        label = candidate.label(joints)
        if label not in best or strength[i] > strength[best[label]]:
            best[label] = i
    hidden = sorted(label for label, i in best.items() if visibility[i] < VISIBLE)
    effects = {label: stage.candidates[i].effect for label, i in best.items()}
    pairs, count = _pairs(best, projected, strength, effects, most)
    return {
        "sentence": f"These logs reveal {len(best) - len(hidden)} of {len(best)} effects in at least one joint;"
        f" {count} pairs of effects cannot be distinguished.",
        "visibility": {label: round(float(visibility[i]), 3) for label, i in best.items()},
        "smallest": {label: _size(stage, i, smallest[i]) for label, i in best.items()},
        "hidden": hidden,
        "show_by": {label: effects[label].separating_experiment for label in hidden},
        "alike": pairs,
    }


def _size(stage: NamingStage, index: int, share: float) -> dict[str, Any] | None:
    """The size of a candidate at a share of its secant; None if infinite."""
    candidate = stage.candidates[index]
    size = float(f"{abs(share * candidate.secant[candidate.size_parameter]):.3g}")
    return {"size": size, "unit": parameter(candidate.size_parameter).unit} if np.isfinite(share) else None


def _products(stage: NamingStage) -> tuple[np.ndarray, np.ndarray]:
    """Products of the candidates' columns after the baseline is projected out, and of the full columns."""
    judge, size = stage.judge, len(stage.base.point)
    gram = judge.gram(stage.fit.variances)
    prior = 1.0 / step_priors(stage.base.coordinates, stage.base.point).deviation ** 2
    membership = judge.membership(range(len(judge.priors.members)))[size:]
    inner, across = gram[:size, :size] + np.diag(prior), gram[:size, size:] @ membership
    full = membership.T @ gram[size:, size:] @ membership
    return full - across.T @ np.linalg.solve(inner, across), full


def _pairs(
    best: Mapping[str, int], projected: np.ndarray, strength: np.ndarray, effects: Mapping[str, Any], most: int
) -> tuple[list[dict[str, Any]], int]:
    """Pairs of visible effects, the most similar first, and the number of similar pairs."""
    labels = [label for label, i in best.items() if strength[i] > 0]
    indices = [best[label] for label in labels]
    cosine = projected[np.ix_(indices, indices)] / np.outer(strength[indices], strength[indices])
    first, second = np.triu_indices(len(labels), 1)
    size = np.abs(cosine[first, second])
    count, pairs = int((size >= SIMILAR).sum()), []
    for i in np.argsort(-size)[: min(count, most)]:
        a, b = labels[first[i]], labels[second[i]]
        experiment = separating(effects[label].name for label in (a, b))
        pairs.append(
            {"effects": [a, b], "cosine": round(float(cosine[first[i], second[i]]), 3), "separate_by": experiment}
        )
    return pairs, count
