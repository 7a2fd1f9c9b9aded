"""Differences between two policies, with intervals."""

from dataclasses import dataclass

import numpy as np

from op3.common.sample_intervals import wilson_interval
from op3.compliance.compliance_study import Measured
from op3.compliance.landing import Comparison, Landings, compare_landings
from op3.compliance.robustness import Passed

Triple = tuple[float, float, float]
"""A difference and its 95 % interval."""


@dataclass(frozen=True)
class Difference:
    """The first policy minus another one.

    Attributes:
        landing: differences of peaks at matched landings.
        bricks: difference of the share of successful episodes on all grounds except the first; None with one ground.
        push: difference of the largest survived push, mean over directions [N s].
    """

    landing: Comparison
    bricks: Triple | None
    push: Triple

    @property
    def better(self) -> list[str]:
        """Measures in which the first policy is better, with an interval that excludes zero."""
        found = []
        if self.landing.force is not None and self.landing.force[2] < 0:
            found.append("lands more softly")
        if self.bricks is not None and self.bricks[1] > 0:
            found.append("passes more episodes on uneven ground")
        if self.push[1] > 0:
            found.append("withstands larger pushes")
        return found


def difference(first: Measured, other: Measured, their_landings: Landings | None = None) -> Difference:
    """The first policy compared with another, which may have landings from additional episodes."""
    landing = compare_landings(first.landings, their_landings or other.landings)
    uneven = [list(measured.passed.values())[1:] for measured in (first, other)]
    return Difference(landing, _of_shares(*uneven), _of_pushes(first, other))


def _of_shares(first: list[Passed], other: list[Passed]) -> Triple | None:
    """Difference of two shares, with an interval derived from Wilson's (Newcombe 1998, method 10)."""
    if not first:
        return None
    ours, theirs = ((sum(p.successes for p in each), sum(p.episodes for p in each)) for each in (first, other))
    p, q = ours[0] / ours[1], theirs[0] / theirs[1]
    (low_p, high_p), (low_q, high_q) = wilson_interval(*ours), wilson_interval(*theirs)
    below, above = np.hypot(p - low_p, high_q - q), np.hypot(high_p - p, q - low_q)
    return p - q, float(p - q - below), float(p - q + above)


def _of_pushes(first: Measured, other: Measured) -> Triple:
    (a, low_a, high_a), (b, low_b, high_b) = first.survival.mean_largest, other.survival.mean_largest
    half = np.hypot(high_a - low_a, high_b - low_b) / 2
    return float(a - b), float(a - b - half), float(a - b + half)
