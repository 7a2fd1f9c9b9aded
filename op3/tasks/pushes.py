"""Impulses at the trunk: in eight directions, at a random time in the gait."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from op3.common.settings import CONTROL_PERIOD

Array = NDArray[np.float64]

DIRECTIONS = 8
"""Directions of a push: forwards, then every 45 degrees to the left."""

PUSH_DURATION = 12 * CONTROL_PERIOD
"""Duration of a push [s], similar to a push by hand and short compared with the gait cycle."""

FIRST_PUSH = 1.5
"""Earliest time of a push [s], when the robot already walks."""


@dataclass(frozen=True)
class Push:
    """A constant force at the trunk's centre of mass for `PUSH_DURATION`.

    Attributes:
        start: time since the episode's beginning [s], an integer number of control ticks.
        impulse: impulse forwards and to the left, relative to the initial heading [N s].
    """

    start: float
    impulse: tuple[float, float]

    @classmethod
    def towards(cls, direction: int, size: float, start: float) -> "Push":
        """A push of `size` [N s] in one of the `DIRECTIONS`, begun at the tick nearest to `start` [s]."""
        angle = 2 * np.pi * direction / DIRECTIONS
        tick = round(start / CONTROL_PERIOD) * CONTROL_PERIOD
        return cls(tick, (float(size * np.cos(angle)), float(size * np.sin(angle))))


class Pushes:
    """One push of each of many robots."""

    def __init__(self, pushes: Sequence[Push]):
        self._start = np.array([push.start for push in pushes])
        self._force = np.array([(*push.impulse, 0.0) for push in pushes]) / PUSH_DURATION

    def replace(self, rows: Sequence[int] | NDArray[np.int64], pushes: Sequence[Push]) -> None:
        """Give the robots in `rows` these pushes."""
        new = Pushes(pushes)
        self._start[rows], self._force[rows] = new._start, new._force

    def force(self, time: Array) -> Array:
        """Forces [N] at times of each episode [s], ``[sim]``, in the world: ``[sim, 3]``."""
        # half a tick of tolerance on both sides, because times are rounded
        since = time - self._start + CONTROL_PERIOD / 2
        now = (since > 0) & (since < PUSH_DURATION)
        return np.where(now[:, None], self._force, 0.0)
