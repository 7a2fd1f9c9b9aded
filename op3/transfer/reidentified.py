"""Result of a re-identification: candidates with two objectives, the Pareto front, and distances due to chance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import wasserstein_distance

from op3.servo import RobotModel

Array = NDArray[np.float64]

PAIRS = 400
"""Number of sample pairs that estimate the distance due to chance."""


@dataclass(frozen=True)
class ParetoPoint:
    """A point of the Pareto front, or the initial model.

    Attributes:
        values: parameter values by name.
        excitation: loss of the excitation, paper eq. (7).
        distance: Wasserstein-1 distance of the returns.
        returns: returns of the policy in simulation.
        attributes: features for a sampler, see `op3.identify.level_set_sampler`.
    """

    values: Mapping[str, float]
    excitation: float
    distance: float
    returns: Sequence[float] = field(default_factory=tuple)
    attributes: Mapping[str, Sequence[float]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Reidentified:
    """Result of a re-identification.

    Attributes:
        model: model with the chosen candidate's values.
        start: the initial model, on which the policy was trained.
        chosen: chosen candidate, see `Reidentification.finish`.
        front: the Pareto front, sorted by excitation loss.
        actual: returns on the robot.
        fresh_start: the initial model on episodes that neither the search nor the choice has used.
        fresh_chosen: the chosen candidate on the same episodes.
        noise: expected distance due to chance between the robot's and as many simulated returns, if the chosen model
            were exact.
        at_chance: whether the initial model's returns are as close to the robot's as chance allows, so that the
            episodes show no error of the model.
        start_name: name of the initial model, by its method.
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
        """Whether the chosen candidate differs from the initial model."""
        return self.chosen is not self.start


def unbeaten(candidates: Sequence[ParetoPoint]) -> list[ParetoPoint]:
    """The Pareto front: candidates for which no other is at least as good in both objectives and better in one."""
    pairs = np.array([(one.excitation, one.distance) for one in candidates]).reshape(-1, 2)
    beaten = [((pairs <= own).all(axis=-1) & (pairs < own).any(axis=-1)).any() for own in pairs]
    return [one for one, lost in zip(candidates, beaten, strict=True) if not lost]


def better_half(losses: Array, distances: Array, start: tuple[float, float]) -> NDArray[np.int64]:
    """Ascending indices of the candidates that the fewest others beat in both objectives, except those the initial
    model beats."""
    beaten = (losses[None] < losses[:, None]) & (distances[None] < distances[:, None])
    hopeless = (losses > start[0]) & (distances >= start[1])
    order = np.lexsort((distances, beaten.sum(1)))[: (len(losses) + 1) // 2]
    return np.sort(order[~hopeless[order] & np.isfinite(distances[order])])


def chance_distances(returns: Array, actual: int, simulated: int) -> Array:
    """Wasserstein-1 distances between two samples of the same returns; their mean is the smallest distance that can be
    expected of a model."""
    rng = np.random.default_rng(0)
    known = returns[np.isfinite(returns)]
    return np.array(
        [wasserstein_distance(rng.choice(known, actual), rng.choice(known, simulated)) for _ in range(PAIRS)]
    )
