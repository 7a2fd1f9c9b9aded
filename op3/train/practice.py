"""What learning begins with and grows out of, as plain numbers over the steps of a run."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

Schedule = tuple[tuple[float, float], ...]
"""Pairs of a number of steps and a value, with straight lines between and constant beyond."""


@dataclasses.dataclass(frozen=True)
class Practice:
    """Curricula of a run; evaluations know nothing of them.

    Attributes:
        speed_bonus: reward per m/s of forward speed, up to the desired speed, beside that of the paper, whose term of
            the speed has no slope where a beginner stands: standing still is an optimum.
        terrain_height: highest tile of the terrain [m].
        mirrored: share of each batch that is replaced by its image in the robot's plane of symmetry.
    """

    speed_bonus: Schedule = ()
    terrain_height: Schedule = ()
    mirrored: float = 0.0

    def __post_init__(self):
        for name in ("speed_bonus", "terrain_height"):
            given = getattr(self, name)
            try:
                schedule = tuple((float(steps), float(value)) for steps, value in given or ())
            except (TypeError, ValueError):
                schedule = ((math.nan, math.nan),)
            steps = [first for first, _ in schedule]
            if not all(map(math.isfinite, (number for pair in schedule for number in pair))) or steps != sorted(steps):
                raise ValueError(f"practice.{name} lists pairs of steps and value, steps rising, got {given!r}")
            object.__setattr__(self, name, schedule)
        if isinstance(self.mirrored, bool) or not isinstance(self.mirrored, int | float) or not 0 <= self.mirrored <= 1:
            raise ValueError(f"practice.mirrored must be a share from 0 to 1, got {self.mirrored!r}")

    def at(self, steps: int) -> Mapping[str, float]:
        """What an environment is told after so many steps, by name; nothing of what has no schedule."""
        given = {"speed_bonus": self.speed_bonus, "terrain_height": self.terrain_height}
        return {name: _value(schedule, steps) for name, schedule in given.items() if schedule}


def _value(schedule: Sequence[tuple[float, float]], steps: float) -> float:
    at, values = np.array(schedule).T
    return float(np.interp(steps, at, values))
