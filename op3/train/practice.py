"""What learning begins with and grows out of, as plain numbers over the steps of a run."""

from collections.abc import Mapping, Sequence

import numpy as np

from op3.settings import Listed, Number, Share, settings

Schedule = Listed[Listed[Number]]
"""Pairs of a number of steps and a value, with straight lines between and constant beyond."""

SCHEDULES = ("speed_bonus", "largest_lag", "terrain_height", "timestep")
"""What changes while a policy learns."""


@settings("practice")
class Practice:
    """Curricula of a run; evaluations know nothing of them.

    Attributes:
        speed_bonus: reward per m/s of forward speed, up to the desired speed, beside that of the paper, whose term of
            the speed has no slope where a beginner stands: standing still is an optimum.
        largest_lag: how far a robot may fall behind where the desired speed would have it before its episode ends [m].
            Who marks time collects what the paper's reward pays for being upright, and no slope leads on from there.
        terrain_height: highest tile of the terrain [m].
        timestep: of the physics [s], which changes at checkpoints, where all episodes begin anew.
        mirrored: share of each batch that is replaced by its image in the robot's plane of symmetry.
    """

    speed_bonus: Schedule = ()
    largest_lag: Schedule = ()
    terrain_height: Schedule = ()
    timestep: Schedule = ()
    mirrored: Share = 0.0

    def __post_init__(self):
        for name in SCHEDULES:
            pairs = getattr(self, name)
            if any(len(pair) != 2 for pair in pairs) or list(pairs) != sorted(pairs):
                raise ValueError(f"practice.{name} lists pairs of steps and value, steps rising, got {pairs}")

    def at(self, steps: int) -> Mapping[str, float]:
        """What an environment is told after so many steps, by name; nothing of what has no schedule."""
        given = {name: getattr(self, name) for name in SCHEDULES}
        return {name: _value(schedule, steps) for name, schedule in given.items() if schedule}


def _value(schedule: Sequence[Sequence[float]], steps: float) -> float:
    at, values = np.array(schedule).T
    return float(np.interp(steps, at, values))
