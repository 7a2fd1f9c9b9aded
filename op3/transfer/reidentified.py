"""What a re-identification finds: candidates with two objectives, those that nothing beats, and what chance leaves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import wasserstein_distance

from op3.servo import RobotModel

Array = NDArray[np.float64]

PAIRS = 400
"""Pairs of samples drawn for the distance that chance alone causes."""


@dataclass(frozen=True)
class ParetoPoint:
    """A point of the Pareto front, or the start.

    Attributes:
        values: parameter values by name.
        excitation: loss of the excitation, paper eq. (7).
        distance: Wasserstein-1 distance of the returns.
        returns: of the policy in simulation.
        attributes: what a sampler may learn from, see `op3.identify.level_set_sampler`.
    """

    values: Mapping[str, float]
    excitation: float
    distance: float
    returns: Sequence[float] = field(default_factory=tuple)
    attributes: Mapping[str, Sequence[float]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Reidentified:
    """What a re-identification found.

    Attributes:
        model: with the chosen candidate's values.
        start: the model that the policy was trained on.
        chosen: see `Reidentification.finish`.
        front: the Pareto front, by rising excitation loss.
        actual: returns on the robot.
        fresh_start: the start over episodes that neither the search nor the choice has seen.
        fresh_chosen: the chosen candidate over the same.
        noise: distance to be expected between the robot's returns and as many simulated ones if the chosen model were
            the robot: what chance alone leaves.
        at_chance: whether the start's returns are as close to the robot's as chance would leave them, so that there is
            nothing to learn from them.
        start_name: what the start is called: how it was found.
    """

    model: RobotModel
    start: ParetoPoint
    chosen: ParetoPoint
    front: Sequence[ParetoPoint]
    actual: Sequence[float]
    fresh_start: ParetoPoint
    fresh_chosen: ParetoPoint
    noise: float
    at_chance: bool = False
    start_name: str = "excitation only"

    @property
    def accepted(self) -> bool:
        """Whether the chosen candidate is another than the start."""
        return self.chosen is not self.start


def unbeaten(candidates: Sequence[ParetoPoint]) -> list[ParetoPoint]:
    """Those that no other is better than: nowhere worse, and better in one objective."""
    pairs = np.array([(one.excitation, one.distance) for one in candidates]).reshape(-1, 2)
    beaten = [((pairs <= own).all(axis=-1) & (pairs < own).any(axis=-1)).any() for own in pairs]
    return [one for one, lost in zip(candidates, beaten, strict=True) if not lost]


def better_half(losses: Array, distances: Array, start: tuple[float, float]) -> NDArray[np.int64]:
    """Indices, rising, of the candidates that fewest others beat in both objectives; none that the start beats."""
    beaten = (losses[None] < losses[:, None]) & (distances[None] < distances[:, None])
    hopeless = (losses > start[0]) & (distances >= start[1])
    order = np.lexsort((distances, beaten.sum(1)))[: (len(losses) + 1) // 2]
    return np.sort(order[~hopeless[order] & np.isfinite(distances[order])])


def chance_distances(returns: Array, actual: int, simulated: int) -> Array:
    """Wasserstein-1 distances of two samples of the same returns, whose mean no model can be expected to undercut."""
    rng = np.random.default_rng(0)
    known = returns[np.isfinite(returns)]
    return np.array(
        [wasserstein_distance(rng.choice(known, actual), rng.choice(known, simulated)) for _ in range(PAIRS)]
    )
