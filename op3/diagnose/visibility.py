"""From which size on the logs show an effect, and which effects they do not show at all."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from op3.diagnose.judge import evidence
from op3.diagnose.naming import NamingStage
from op3.servo.effect import parameter

SIZES = np.geomspace(0.02, 20.0, 60)
"""Shares of a secant that are tried."""


def smallest_sizes(stage: NamingStage) -> np.ndarray:
    """Share of each candidate's secant from which on its expected log odds reach the alarm; infinite if none does."""
    n, settings = stage.judge.numbers, stage.judge.settings
    _, h = stage.judge.of_candidates(stage.fit)
    result = np.full(len(stage.found), np.inf)
    for size in SIZES[::-1]:
        share = np.where(n.high > 0, size, -size)
        odds = evidence(h * share, h, 0.0, n.slab, n.low, n.high) + n.place
        named = (odds > settings.alarm) & (share <= n.high) & (share >= n.low)
        result = np.where(named, size, result)
    return result


def size_of(stage: NamingStage, i: int, share: float) -> dict[str, Any] | None:
    """The size of a candidate at a share of its secant; None where that is infinite."""
    known = parameter(stage.found[i].sized)
    size = float(f"{abs(share * stage.found[i].secant[known.name]):.3g}")
    return {"size": size, "unit": known.unit} if np.isfinite(share) else None


def not_shown(stage: NamingStage, joints: Sequence[str]) -> dict[str, list[str]]:
    """Effects that no plausible size of which would have been proposed, and the joints in which that is so; no joint
    for those of all joints alike."""
    seen: dict[tuple[str, tuple[int, ...] | None], bool] = {}
    for one, share in zip(stage.found, smallest_sizes(stage), strict=True):
        seen[one.place] = seen.get(one.place, False) or bool(np.isfinite(share))
    result: dict[str, list[str]] = {}
    for (name, where), shown in seen.items():
        if not shown and (where is None or len(where) == 1):
            result.setdefault(name, []).extend([] if where is None else [joints[where[0]]])
    return result
