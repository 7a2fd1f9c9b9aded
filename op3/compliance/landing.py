"""Landings: peaks of force and acceleration, compared between walks at the same speed and step height."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from op3.envs.step_traces import SKIPPED, Traces, swings

Array = NDArray[np.float64]

WINDOW = 50
"""Time after a touchdown in which peaks are searched [ms]."""

ALIKE = np.array([0.03, 0.004])
"""Differences of speed [m/s] and step height [m] up to which two landings are matched."""

RESAMPLES = 300
"""Number of draws of the bootstrap."""

FEWEST = 20
"""Smallest number of matched pairs for a comparison."""


@dataclass(frozen=True, eq=False)
class Landings:
    """Touchdowns of many episodes, arrays [landing].

    Attributes:
        episode: episode of the landing.
        force: peak of the ground's force on the foot [N].
        acceleration: peak acceleration of the trunk without gravity [m/s^2].
        speed: forward speed over the second around the touchdown [m/s].
        height: height of the preceding swing: largest height of the sole's lowest point above the ground [m].
    """

    episode: NDArray[np.int64]
    force: Array
    acceleration: Array
    speed: Array
    height: Array

    @property
    def alike(self) -> Array:
        """Speed and height in units of `ALIKE`, ``[landing, 2]``."""
        return np.stack([self.speed, self.height], -1) / ALIKE

    def of(self, episodes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Indices of the landings of episodes; repeated episodes give repeated landings."""
        by_episode = [np.flatnonzero(self.episode == episode) for episode in episodes]
        return np.concatenate(by_episode) if by_episode else np.zeros(0, dtype=np.int64)


def find_landings(traces: Traces, lengths: NDArray[np.int64]) -> Landings:
    """All landings of robots while they walk.

    Args:
        lengths: milliseconds for which each robot's episode lasted, [sim].
    """
    found: list[tuple[Any, ...]] = []
    for robot, length in enumerate(lengths):
        for side in range(2):
            force, sole = traces.force[:length, robot, side], traces.sole[:length, robot, side]
            for left, time in swings(force):
                if time < 1000 * SKIPPED or time + 500 >= length:
                    continue
                inside = slice(time, time + WINDOW)
                ahead, height = traces.ahead[:, robot], sole[left:time].max() - sole[time]
                peaks = force[inside].max(), traces.acceleration[inside, robot].max()
                found.append((robot, *peaks, ahead[time + 500] - ahead[time - 500], height))
    columns = np.array(found, dtype=float).reshape(-1, 5).T
    return Landings(columns[0].astype(np.int64), *columns[1:])


@dataclass(frozen=True)
class Comparison:
    """Differences between landings of one walk and matched landings of another.

    Attributes:
        pairs: number of matched pairs.
        force: mean difference of the peak force and its 95 % interval [N]; None with too few pairs.
        acceleration: mean difference of the peak acceleration and its 95 % interval [m/s^2].
    """

    pairs: int
    force: tuple[float, float, float] | None
    acceleration: tuple[float, float, float] | None


def compare_landings(ours: Landings, theirs: Landings) -> Comparison:
    """Match each landing of the first walk with the closest landing of the second in speed and step height, if similar.

    Intervals are bootstrapped over the episodes of both, with a fixed seed.
    """
    everything = [np.unique(walk.episode) for walk in (ours, theirs)]
    first = _paired(ours, theirs, *everything)
    if first is None or len(first) < FEWEST:
        return Comparison(0 if first is None else len(first), None, None)
    rng = np.random.default_rng(0)
    drawn = [_paired(ours, theirs, *(rng.choice(e, len(e)) for e in everything)) for _ in range(RESAMPLES)]
    means = np.array([pairs.mean(0) for pairs in drawn if pairs is not None and len(pairs)])
    low, high = np.quantile(means, (0.025, 0.975), axis=0)
    force, acceleration = np.stack([first.mean(0), low, high], 1).tolist()
    return Comparison(len(first), tuple(force), tuple(acceleration))


def _paired(ours: Landings, theirs: Landings, *episodes: NDArray[np.int64]) -> Array | None:
    """Differences of force and acceleration, ``[pair, 2]``; None if one of the walks has no landings."""
    mine, other = ours.of(episodes[0]), theirs.of(episodes[1])
    if not len(mine) or not len(other):
        return None
    found: Any = KDTree(theirs.alike[other]).query(ours.alike[mine], distance_upper_bound=1.0)
    distance, nearest = found
    known = np.isfinite(distance)
    a, b = mine[known], other[nearest[known]]
    return np.stack([ours.force[a] - theirs.force[b], ours.acceleration[a] - theirs.acceleration[b]], -1)
