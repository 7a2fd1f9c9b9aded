"""Curricula: parameters of a task that change over the steps of a run."""

from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any

import numpy as np

from op3.common.settings import Listed, Named, Number, settings

Schedule = Listed[Listed[Number]]
"""Pairs of a number of steps and a value, with straight lines between and constant beyond."""


@settings()
class Practice:
    """Curricula of a training; evaluations do not use them.

    Attributes:
        curricula: schedules by the path of a number in the task, such as ``shaping.speed_bonus.weight``; ``timestep``
            is that of the physics [s], which changes at checkpoints, where all episodes restart.
    """

    curricula: Named[Schedule] = field(default_factory=dict)

    def __post_init__(self):
        for path, pairs in self.curricula.items():
            if not pairs or any(len(pair) != 2 for pair in pairs) or list(pairs) != sorted(pairs):
                raise ValueError(f"curricula.{path} lists pairs of steps and value, with increasing steps, got {pairs}")

    def at(self, steps: int) -> Mapping[str, Any]:
        """Values after so many steps, by path."""
        return {path: _value(schedule, steps) for path, schedule in self.curricula.items()}


def _value(schedule: Sequence[Sequence[float]], steps: float) -> float:
    at, values = np.array(schedule).T
    return float(np.interp(steps, at, values))
