"""Random robot parameters for every episode, from the paper's ranges or from a model's intervals."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from op3.common.settings import settings
from op3.servo import RobotModel

TABLE_I = (
    "torque_constant",
    "terminal_resistance",
    "armature",
    "backward_efficiency",
    "coulomb_friction",
    "viscous_friction",
    "static_friction_excess",
    "base_mass_offset",
    "base_com_offset_x",
    "base_com_offset_z",
)
"""Parameters of the paper's Table I; the forward efficiency is fixed there."""


@settings("randomisation")
class ParameterRanges:
    """Distribution of the parameters.

    Attributes:
        source: ``ranges``: uniform over the plausible ranges of `names`, which for the paper's parameters are those of
            Table I. ``intervals``: uniform over the model's 90 % intervals.
        names: parameters to draw; None: those of Table I that the model has, or all that have an interval.
    """

    source: Literal["ranges", "intervals"] = "ranges"
    names: Sequence[str] | None = None

    def bounds(self, model: RobotModel) -> dict[str, tuple[float, float]]:
        """Lowest and highest value of every drawn parameter.

        Raises:
            ValueError: if a named parameter is not in the model or has no interval, or there is nothing to draw.
        """
        known = model.parameters()
        intervals = {name: (e.low, e.high) for name, e in model.estimates.items() if None not in (e.low, e.high)}
        if self.source == "ranges":
            names = self.names if self.names is not None else [name for name in TABLE_I if name in known]
            found = {name: (known[name].low, known[name].high) for name in names if name in known}
        else:
            names = self.names if self.names is not None else list(intervals)
            found = {name: intervals[name] for name in names if name in intervals}
        missing = [name for name in names if name not in found]
        if missing or not found:
            what = f"no {self.source} of {', '.join(missing)}" if missing else "no parameter with an interval"
            raise ValueError(f"randomisation: the model has {what}; its parameters are {', '.join(known)}")
        return found  # type: ignore[return-value]

    def draw(self, model: RobotModel, seed: int) -> dict[str, float]:
        """The parameters of the robot of a seed, shared by its joints; values of single joints change in proportion."""
        rng = np.random.default_rng([seed, 2])
        return {name: float(rng.uniform(low, high)) for name, (low, high) in self.bounds(model).items()}
