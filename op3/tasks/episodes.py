"""Initial states of episodes, pure functions of their seeds for every simulator."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]


def episode_seed(seed: int, index: int, episode: int) -> int:
    """The seed of an environment's k-th episode, independent of all other environments."""
    return int(np.random.SeedSequence([seed, index, episode]).generate_state(1)[0])


@dataclass(frozen=True, eq=False)
class Episodes:
    """Episodes that begin now in some of the robots.

    Attributes:
        rows: numbers of these robots, ``[row]``.
        seeds: seeds of their episodes, ``[row]``.
        qpos: initial positions, ``[row, nq]``; an event may change them.
        qvel: initial velocities, ``[row, nv]``; an event may change them.
    """

    rows: NDArray[np.int64]
    seeds: NDArray[np.int64]
    qpos: Array
    qvel: Array

    def generators(self, stream: int) -> list[np.random.Generator]:
        """A generator for each episode; callers that draw independent numbers take different streams."""
        return [np.random.default_rng([int(seed), stream]) for seed in self.seeds]


@dataclass(frozen=True, eq=False)
class World:
    """Live arrays of a simulation that events change, ``[env, ...]``.

    Attributes:
        model: model of MuJoCo.
        qpos: full position.
        qvel: full velocity.
        qfrc_applied: generalised forces, held until they are changed.
        base_wrench: force [N] and torque [N m] on the base in the world, ``[env, 6]``, held until they are changed.
        geom_pos: positions of the geoms in their bodies, ``[env, geom, 3]``; None for a scene without movable geoms.
        set_parameters: function that changes parameters of servo models by name, ``[env]``; None if the simulation
            cannot.
    """

    model: mujoco.MjModel
    qpos: Array
    qvel: Array
    qfrc_applied: Array
    base_wrench: Array
    geom_pos: Array | None
    set_parameters: Callable[[Mapping[str, Tensor]], None] | None = None
