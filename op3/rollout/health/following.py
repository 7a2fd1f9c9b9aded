"""Check of positions against commands."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import ERROR, Finding, View, check
from op3.rollout.health.match import match
from op3.rollout.units import likely_unit

_POSITION = ("joint", "position")

_MOST = 1.9
"""A servo does not move this many times as far as it is told to."""


@check("position against command")
def command(view: View) -> Iterator[Finding]:
    """Position and command differ in unit or sign, or belong to different joints."""
    if len(view.time) < 20:
        return
    stride = max(1, round(0.02 / view.interval))
    angle, target = view.position[::stride], view.command[::stride]
    driven = np.all(view.driven[::stride], axis=1)
    if driven.sum() < 20:
        return
    lags = [n for n in range(0, 26, 2) if n < len(angle) // 4] or [0]
    matches = [match(angle[n:][driven[n:]], target[: len(target) - n][driven[n:]]) for n in lags]
    every = np.stack([m.correlation for m in matches])
    own, best = np.diagonal(every, axis1=1, axis2=2), every.max(0)
    asked, moved = np.ptp(target[driven], axis=0) > 0.05, np.ptp(angle[driven], axis=0) > 0.05
    for joint in map(int, np.flatnonzero(asked | moved)):
        sure, ratio = float(best[joint, joint]), float(matches[int(own[:, joint].argmax())].ratio[joint, joint])
        where = view.column(_POSITION, joint)
        # whose command it follows, where that joint does not follow it itself
        others = [k for k in np.argsort(-best[joint]) if k != joint and asked[k] and best[joint, k] > 0.97]
        other = next((view.joints[k] for k in others if best[k, k] < 0.5), None)
        if asked[joint] and sure > 0.95 and (ratio > _MOST or ratio < 1 / 30):
            unit = likely_unit(ratio, "rad") or likely_unit(1 / ratio, "rad")
            cause = f", as if {'it' if ratio > 1 else 'the command'} were in {unit}" if unit else ""
            problem = f"the position moves {ratio:.3g} times as far as its command{cause}"
            yield Finding(ERROR, problem, "convert both to radians (57.3 is degrees)", where)
        elif asked[joint] and own[:4, joint].min() < -0.95 and sure < 0.5:
            problem = "the position moves against its command: the sign of one of them is turned round"
            problem += f", or it was swapped with that of {other}" if other else ""
            yield Finding(ERROR, problem, "write `sign: -1` for one of them into its YAML", where)
        elif sure < 0.4 and other:
            problem = f"the position follows the command of {other}: the columns of the two are swapped"
            yield Finding(ERROR, problem, "swap the columns", where)
