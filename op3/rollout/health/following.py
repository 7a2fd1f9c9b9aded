"""Check of positions against commands."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import ERROR, Finding, View, check
from op3.rollout.health.match import Match, match
from op3.rollout.units import likely_unit

_POSITION, _COMMAND = ("joint", "position"), ("command", "position")

_MOST = 1.9
"""A servo does not move this many times as far as it is told to."""


@check("position against command")
def command(view: View) -> Iterator[Finding]:
    """Position and command differ in unit or sign, or belong to different joints."""
    if len(view.time) < 20:
        return
    stride = max(1, round(0.02 / view.interval))
    angle, target = view.log.array(_POSITION)[::stride], view.log.array(_COMMAND)[::stride]
    driven = np.all(view.driven[::stride], axis=1)
    if driven.sum() < 20:
        return
    lags = [n for n in range(0, 26, 2) if n < len(angle) // 4] or [0]
    matches = [match(angle[n:][driven[n:]], target[: len(target) - n][driven[n:]]) for n in lags]
    own = np.stack([np.diag(m.correlation) for m in matches])
    asked = np.ptp(target[driven], axis=0)
    for joint in np.flatnonzero(asked > 0.05):
        best = int(own[:, joint].argmax())
        sure, ratio = float(own[best, joint]), float(matches[best].ratio[joint, joint])
        where = view.column(_POSITION, int(joint))
        if sure > 0.95 and (ratio > _MOST or ratio < 1 / 30):
            unit = likely_unit(ratio, "rad") or likely_unit(1 / ratio, "rad")
            cause = f", as if {'it' if ratio > 1 else 'the command'} were in {unit}" if unit else ""
            problem = f"the position moves {ratio:.3g} times as far as its command{cause}"
            yield Finding(ERROR, problem, "convert both to radians (57.3 is degrees)", where)
        elif own[:4, joint].min() < -0.95 and sure < 0.5:
            problem = "the position moves against its command: the sign of one of them is turned round"
            yield Finding(ERROR, problem, "write `sign: -1` for one of them into its YAML", where)
        elif sure < 0.4 and len(view.joints) > 1:
            yield from _swapped(view, matches, int(joint), np.flatnonzero(asked > 0.05))


def _swapped(view: View, matches: list[Match], joint: int, asked: np.ndarray) -> Iterator[Finding]:
    follows = np.stack([m.correlation[joint, asked] for m in matches]).max(0)
    if follows.max() > 0.97 and (other := int(asked[follows.argmax()])) != joint:
        problem = f"the position follows the command of {view.joints[other]}: the columns of the two are swapped"
        yield Finding(ERROR, problem, "swap the columns", view.column(_POSITION, joint))
