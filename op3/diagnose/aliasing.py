"""What these logs can tell at all: which effects they show, and which look alike."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from op3.diagnose.diagnosis import Diagnosis
from op3.diagnose.hypotheses import separating
from op3.diagnose.screen import Screened, cosines

ALIKE = 0.7
"""Cosine beyond which two effects are alike to these logs."""

VISIBLE = 0.3
"""Share of an effect that the base must leave for it to be seen."""


def aliasing(diagnosis: Diagnosis, most: int = 60, *, planned: bool = False) -> dict[str, Any]:
    """Visibility of every hypothesis, and pairs that look alike once the base has had its say.

    Args:
        diagnosis: not run yet; its base is refitted and the catalogue screened.
        most: pairs that are listed.
        planned: whether the logs were simulated by the model, which is then not refitted.

    Returns:
        ``sentence``; ``visibility`` by effect and joint; ``hidden``, those below `VISIBLE`, and ``show_by``, the
        experiment of the catalogue that shows each; ``alike``, pairs with their cosine and what would separate them,
        the most alike first.
    """
    base = diagnosis.linearised() if planned else diagnosis.refit_base(diagnosis.given)
    best: dict[str, Screened] = {}
    for s in diagnosis.screen(base, planned):
        label = s.hypothesis.label(diagnosis.engine.joints)
        if label not in best or s.strength > best[label].strength:
            best[label] = s
    return report(best, most)


def report(best: Mapping[str, Screened], most: int) -> dict[str, Any]:
    """The report of one secant per hypothesis, by its label."""
    seen = {label: s for label, s in best.items() if s.strength > 0}
    hidden = sorted(label for label, s in best.items() if s.visibility < VISIBLE)
    labels = list(seen)
    pairs: list[dict[str, Any]] = []
    count = 0
    if labels:
        cosine = cosines(list(seen.values()))
        first, second = np.triu_indices(len(labels), 1)
        size = np.abs(cosine[first, second])
        count = int((size >= ALIKE).sum())
        for i in np.argsort(-size)[: min(count, most)]:
            a, b = int(first[i]), int(second[i])
            both = [labels[a], labels[b]]
            apart = separating(seen[label].hypothesis.effect.name for label in both)
            pairs.append({"effects": both, "cosine": round(float(cosine[a, b]), 3), "separate_by": apart})
    return {
        "sentence": f"These logs show {len(best) - len(hidden)} of {len(best)} hypotheses, "
        f"and {count} pairs look alike to them.",
        "visibility": {label: round(s.visibility, 3) for label, s in best.items()},
        "hidden": hidden,
        "show_by": {label: best[label].hypothesis.effect.separating_experiment for label in hidden},
        "alike": pairs,
    }
