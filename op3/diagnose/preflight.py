"""What logs are too poor for, before anything is fitted."""

from collections.abc import Sequence

import numpy as np

from op3.diagnose.split import LogSplit
from op3.rollout import Rollout

SHORTEST = 15.0
"""Fitted runs shorter than this in all cannot carry a verdict [s]."""

STILL = 0.02
"""A joint that moves less than this has told nothing [rad]."""


def too_poor(split: LogSplit) -> tuple[str, ...]:
    """Why these logs cannot tell what is missing, and what to record next; empty if they can.

    Args:
        split: the logs.
    """
    said = []
    duration = sum(log.duration for log in split.fit)
    if duration < SHORTEST:
        said.append(
            f"The fitted runs last {duration:.0f} s in all; record at least {SHORTEST:.0f} s, better 100 s in several"
            " runs with three repeats of one of them."
        )
    still = _still(split.fit)
    if still:
        said.append(
            f"{', '.join(still)} moved less than {STILL:g} rad in the fitted runs; move every joint through slow"
            " triangles and fast sines."
        )
    return tuple(said)


def _still(logs: Sequence[Rollout]) -> list[str]:
    """Joints that hardly moved in any log."""
    reach = np.max([np.ptp(log.array("joint/position"), axis=0) for log in logs], axis=0)
    return [joint for joint, moved in zip(logs[0].joints, reach, strict=True) if moved < STILL]
