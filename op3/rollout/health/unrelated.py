"""Check of positions that have nothing to do with their commands."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import CURRENT, POSITION, WARNING, Finding, View, check
from op3.rollout.health.match import SURE, delayed, match
from op3.rollout.metadata import HOLDING

_UNRELATED = 0.5
"""Correlation with its command, at the best delay, that a position is not below: 0.57 in 3,400 joints of sound logs,
where a late and undamped loop swings by three times what it is told."""


@check("position without its command", unless=("position against command", "two clocks", "stands still"))
def unrelated(view: View) -> Iterator[Finding]:
    """A position does not follow its command at any delay: it is another joint's, or of another recording. Not on its
    feet, where the weight moves soft joints against their commands."""
    if view.metadata.mount not in HOLDING:
        return
    stride = max(1, round(0.02 / view.interval)) if len(view.time) >= 20 else 1
    angle, target, driven = (a[::stride] for a in (view.position, view.command, view.driven))
    gain, current = view.get(("command", "p_gain")), view.get(CURRENT)
    explained = np.zeros(len(view.joints), bool)
    if gain is not None and current is not None:  # a soft joint that yields, and pulls by as much
        explained = np.diagonal(match(current, gain * (view.command - view.position)).correlation) > SURE
    for joint in range(len(view.joints)):
        a, t = angle[driven[:, joint], joint], target[driven[:, joint], joint]
        if len(a) < 20 or np.ptp(t) < 0.1 or np.ptp(a) < 0.05:
            continue
        best = max(delayed(a, t, n) for n in range(0, min(26, len(a) // 4), 2))
        if best < _UNRELATED and not explained[joint]:
            problem = f"the position does not follow its command (correlation {best:.2f})"
            remedy = "look whether both are of this joint and of the same recording"
            yield view.found(WARNING, (POSITION, joint), problem, remedy)
