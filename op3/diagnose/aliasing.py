"""What logs can tell at all: how large an effect must be to be named, and which effects look alike."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from op3.diagnose.base import base_numbers
from op3.diagnose.diagnosis import Diagnosis
from op3.diagnose.findings import ALIKE
from op3.diagnose.judge import Judge
from op3.diagnose.naming import NamingStage
from op3.diagnose.verdict import separating
from op3.diagnose.visibility import size_of, smallest_sizes

VISIBLE = 0.3
"""Share of an effect that the base must leave for it to be seen."""


def aliasing(diagnosis: Diagnosis, most: int = 60, *, planned: bool = False) -> dict[str, Any]:
    """Visibility of every effect in every place, and pairs that look alike once the base has had its say.

    Args:
        diagnosis: not run yet; its base is fitted and the catalogue's columns made.
        planned: whether the logs were simulated by the model, which is then not fitted.

    Returns:
        ``sentence``; by effect and joint ``visibility`` and ``smallest``, the size from which on it would be named
        (None if no plausible one would); ``hidden``, those below `VISIBLE`, and ``show_by``, the experiment of the
        catalogue that shows each; ``alike``, pairs with their cosine and what would separate them, most alike first.
    """
    stage = diagnosis.first_stage(fitted=not planned)
    joints, own = diagnosis.split.fit[0].joints, len(stage.base.point)
    left, whole = _left_by_base(stage.judge, stage, own)
    strength = np.sqrt(np.maximum(np.diag(left), 0.0))
    visibility = strength / np.sqrt(np.maximum(np.diag(whole), 1e-12))
    smallest = smallest_sizes(stage)
    best: dict[str, int] = {}
    for i, one in enumerate(stage.found):
        label = one.label(joints)
        if label not in best or strength[i] > strength[best[label]]:
            best[label] = i
    hidden = sorted(label for label, i in best.items() if visibility[i] < VISIBLE)
    effects = {label: stage.found[i].effect for label, i in best.items()}
    pairs, count = _pairs(best, left, strength, effects, most)
    return {
        "sentence": f"These logs show {len(best) - len(hidden)} of {len(best)} effects, each in its joints;"
        f" {count} pairs of effects cannot be distinguished.",
        "visibility": {label: round(float(visibility[i]), 3) for label, i in best.items()},
        "smallest": {label: size_of(stage, i, smallest[i]) for label, i in best.items()},
        "hidden": hidden,
        "show_by": {label: effects[label].separating_experiment for label in hidden},
        "alike": pairs,
    }


def _left_by_base(judge: Judge, stage: NamingStage, own: int) -> tuple[np.ndarray, np.ndarray]:
    """Products of the candidates' columns that the base does not imitate, and all of them."""
    products = judge.products(stage.fit.state)
    prior = 1.0 / base_numbers(stage.base.coordinates, stage.base.point).deviation ** 2
    sums = judge.sums(range(len(judge.numbers.members)))[own:]
    inner, across = products[:own, :own] + np.diag(prior), products[:own, own:] @ sums
    whole = sums.T @ products[own:, own:] @ sums
    return whole - across.T @ np.linalg.solve(inner, across), whole


def _pairs(
    best: Mapping[str, int], left: np.ndarray, strength: np.ndarray, effects: Mapping[str, Any], most: int
) -> tuple[list[dict[str, Any]], int]:
    """Pairs of seen effects by how alike they are, and how many there are."""
    labels = [label for label, i in best.items() if strength[i] > 0]
    at = [best[label] for label in labels]
    cosine = left[np.ix_(at, at)] / np.outer(strength[at], strength[at])
    first, second = np.triu_indices(len(labels), 1)
    size = np.abs(cosine[first, second])
    count, pairs = int((size >= ALIKE).sum()), []
    for i in np.argsort(-size)[: min(count, most)]:
        a, b = labels[first[i]], labels[second[i]]
        apart = separating(effects[label].name for label in (a, b))
        pairs.append({"effects": [a, b], "cosine": round(float(cosine[first[i], second[i]]), 3), "separate_by": apart})
    return pairs, count
