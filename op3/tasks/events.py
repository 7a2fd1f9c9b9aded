"""Events: changes to robots and scenes when an episode begins and at every control tick.

An event is a class with any of the methods ``attach(world)``, ``begin(episodes)`` and ``tick(time)``, or a function
``(world, time, ...)`` that is called at every tick; see `op3.tasks.episodes`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from op3.common.settings import CONTROL_PERIOD
from op3.robot import Robot
from op3.scenes import Scene, Tilts, Waves, WeightSchedule, board_drive, draw_tiles, place_tiles, stack, tile_ids
from op3.scenes.board import WAVE_AMPLITUDE
from op3.scenes.surfaces import TILE_HEIGHT
from op3.servo import RobotModel
from op3.tasks.episodes import Episodes, World
from op3.tasks.pushes import FIRST_PUSH, Push, Pushes
from op3.tasks.randomisation import ParameterRanges as Ranges

__all__ = ["Board", "Placement", "Pushing", "Randomisation", "Terrain"]

Array = NDArray[np.float64]

BoardMotion = Literal["still", "waves", "tilts", "weight"]
"""Motions of a board: none, random waves, steps between two tilts, or a weight that is lowered on it."""


class Placement:
    """Random initial states around the home pose at rest; the standard deviations are op3's choice.

    Args:
        joint_position: standard deviation of each controlled joint's angle [rad].
        joint_velocity: standard deviation of each controlled joint's velocity [rad/s].
        velocity: standard deviation of a free base's velocity, forwards and sideways [m/s].
        angular_velocity: standard deviation of a free base's roll and pitch rates [rad/s].
    """

    def __init__(
        self,
        scene: Scene,
        robot: Robot,
        joint_position: float = 0.02,
        joint_velocity: float = 0.1,
        velocity: float = 0.02,
        angular_velocity: float = 0.1,
    ):
        self._scene, self._robot = scene, robot
        self._scatter = joint_position, joint_velocity, velocity, angular_velocity
        self._first = 6 if scene.floating else 0

    def begin(self, episodes: Episodes) -> None:
        """Set the initial states."""
        angle, rate, velocity, spin = self._scatter
        moved = self._robot.indices(self._robot.controlled)
        for row, generator in enumerate(episodes.generators(1)):
            position = self._robot.home.copy()
            position[moved] += angle * generator.standard_normal(len(moved))
            episodes.qpos[row] = self._scene.initial_qpos(position)
            episodes.qvel[row] = 0.0
            if self._first:
                episodes.qvel[row, 0:2] = velocity * generator.standard_normal(2)
                episodes.qvel[row, 3:5] = spin * generator.standard_normal(2)
            # the base and the joints come first; everything else in the scene starts at rest
            episodes.qvel[row, self._first + moved] = rate * generator.standard_normal(len(moved))


class Board:
    """Moves the board of the scenes ``board`` and ``board_weight``.

    Args:
        motion: one of `BoardMotion`.
        amplitude: largest angle of random waves [rad].
    """

    def __init__(self, scene: Scene, motion: BoardMotion, amplitude: float = WAVE_AMPLITUDE):
        if (motion == "weight") != (scene.name == "board_weight") or not scene.name.startswith("board"):
            raise ValueError(f"scene {scene.name!r} cannot be moved by motion={motion!r}")
        self.motion: BoardMotion = motion
        self.amplitude = amplitude
        self._motions: dict[int, Any] = {}

    def attach(self, world: World) -> None:
        """Look up the arrays of the simulation."""
        self._world, self._drive = world, None

    def begin(self, episodes: Episodes) -> None:
        """Draw motions."""
        for row, seed in zip(episodes.rows, episodes.seeds, strict=True):
            self._motions[int(row)] = board_motion(self.motion, int(seed), self.amplitude)
        self._stacked: Any = stack([self._motions[row] for row in range(len(self._world.qpos))])
        if self._drive is None:
            self._drive: Any = board_drive(self._world.model, self._motions[0], CONTROL_PERIOD)

    def tick(self, time: Array) -> None:
        """Drive the boards at times of each episode [s], ``[env]``."""
        world = self._world
        self._drive.apply(self._stacked, time, world.qpos, world.qvel, world.qfrc_applied)


def board_motion(motion: BoardMotion, seed: int, amplitude: float = WAVE_AMPLITUDE) -> Waves | Tilts | WeightSchedule:
    """The motion of a board in the episode of a seed; see `Board`."""
    if motion == "still":
        return Waves.still()
    if motion == "waves":
        return Waves.draw(seed, amplitude)
    return {"tilts": Tilts, "weight": WeightSchedule}[motion].draw(seed)


class Terrain:
    """Draws the heights of the tiles of the scene ``terrain``.

    Args:
        height: height of the highest tile above the floor [m], at most 0.01.
        steps: probability that all tiles have either zero height or this height.
    """

    def __init__(self, height: float = TILE_HEIGHT, steps: float = 0.0):
        if not 0 <= height <= TILE_HEIGHT:
            raise ValueError(f"height must be between 0 and {TILE_HEIGHT:g} m, got {height}")
        if not 0 <= steps <= 1:
            raise ValueError(f"steps must be a probability, got {steps}")
        self.height, self.steps = height, steps

    def attach(self, world: World) -> None:
        """Look up the arrays of the simulation."""
        self._tiles, self._geom_pos = tile_ids(world.model), world.geom_pos
        if self._geom_pos is None:
            raise ValueError("the scene has no tiles; set scene: terrain")

    def heights(self, seed: int) -> Array:
        """Heights of the tiles in the episode of a seed [m], ``[tile]``."""
        return draw_tiles(seed, self.height, self.steps)

    def begin(self, episodes: Episodes) -> None:
        """Place tiles."""
        for row, seed in zip(episodes.rows, episodes.seeds, strict=True):
            assert self._geom_pos is not None
            place_tiles(self._geom_pos[row], self._tiles, self.heights(int(seed)))


class Pushing:
    """Pushes the base in one of eight directions, once at a random time of the gait, or repeatedly.

    Args:
        impulse: impulse of a push [N s].
        every: mean time between pushes [s]; None: one push per episode.
        uniform: whether sizes are drawn between 0 and `impulse`.
    """

    def __init__(
        self,
        num_envs: int,
        duration: float,
        gait_cycle: float | None,
        impulse: float,
        every: float | None = None,
        uniform: bool = False,
    ):
        self.impulse, self._uniform, self._every = impulse, uniform, every
        self._spread = (gait_cycle or 1.0) if every is None else every
        self._count = 1 if every is None else max(1, int((duration - FIRST_PUSH) / every))
        self._pushes = [Pushes([Push.towards(0, 0.0, 0.0)] * num_envs) for _ in range(self._count)]

    def attach(self, world: World) -> None:
        """Look up the arrays of the simulation."""
        self._wrench = world.base_wrench

    def begin(self, episodes: Episodes) -> None:
        """Draw the pushes of episodes."""
        for number, pushes in enumerate(self._pushes):
            drawn = []
            for generator in episodes.generators(3 if number == 0 else 100 + number):
                direction, share = int(generator.integers(8)), generator.random()
                size = self.impulse * (generator.random() if self._uniform else 1.0)
                start = FIRST_PUSH + self._spread * (number + share if self._every else share)
                drawn.append(Push.towards(direction, size, start))
            pushes.replace(episodes.rows, drawn)

    def replace(self, rows: NDArray[np.int64], pushes: Sequence[Push]) -> None:
        """Replace the drawn pushes of robots, one push per robot."""
        for number, held in enumerate(self._pushes):
            held.replace(rows, pushes if number == 0 else [Push.towards(0, 0.0, 0.0)] * len(rows))

    def tick(self, time: Array) -> None:
        """Push at times of each episode [s], ``[env]``."""
        self._wrench[:, :3] = sum(pushes.force(time) for pushes in self._pushes)


class Randomisation:
    """Draws the parameters of each robot's model for every episode.

    Args:
        source: ``ranges``: uniform over the plausible ranges (the paper's Table I). ``intervals``: uniform over the
            model's 90 % intervals.
        names: parameters to draw; None: those of Table I that the model has, or all that have an interval.
    """

    def __init__(
        self,
        model: RobotModel,
        num_envs: int,
        source: Literal["ranges", "intervals"] = "ranges",
        names: Sequence[str] | None = None,
    ):
        self._ranges, self._model = Ranges(source, names), model
        self.drawn = {name: torch.zeros(num_envs, dtype=torch.float64) for name in self._ranges.bounds(model)}

    def attach(self, world: World) -> None:
        """Look up the arrays of the simulation."""
        if world.set_parameters is None:
            raise ValueError("only the batched environment can randomise parameters; use backend='batched'")
        self._set = world.set_parameters

    def begin(self, episodes: Episodes) -> None:
        """Draw the parameters of the robots."""
        for row, seed in zip(episodes.rows, episodes.seeds, strict=True):
            for name, value in self._ranges.draw(self._model, int(seed)).items():
                self.drawn[name][row] = value
        self._set(self.drawn)
