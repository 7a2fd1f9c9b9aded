"""Numbers of an environment that change while a policy learns."""

from collections.abc import Mapping

import numpy as np

from op3.settings import Listed, Named, Number, settings

Schedule = Listed[Listed[Number]]
"""Pairs of a number of steps and a value, with straight lines between and constant beyond."""


@settings()
class Practice:
    """Curricula of a run; evaluations know nothing of them.

    Attributes:
        practice: schedules by the name of what the environment's method ``practise`` takes.
    """

    practice: Named[Schedule]

    def __post_init__(self):
        for name, pairs in self.practice.items():
            if any(len(pair) != 2 for pair in pairs) or list(pairs) != sorted(pairs):
                raise ValueError(f"practice.{name} lists pairs of steps and value, steps rising, got {pairs}")

    def at(self, steps: int) -> Mapping[str, float]:
        """What the environment is told after so many steps, by name; nothing of what has an empty schedule."""
        schedules = {name: np.array(pairs).T for name, pairs in self.practice.items() if pairs}
        return {name: float(np.interp(steps, *columns)) for name, columns in schedules.items()}
