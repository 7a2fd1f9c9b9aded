"""How an episode begins: a pure function of a task and a seed, for every simulator alike."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from op3.robot import Scene, Tilts, Waves, WeightSchedule, draw_tiles
from op3.tasks.pushes import Push
from op3.tasks.task import Task

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Beginning:
    """An episode's first state, and what will move the ground.

    Attributes:
        qpos: full position ``[nq]``.
        qvel: full velocity ``[nv]``.
        board: what moves the board; None where there is none.
        tiles: heights of the terrain's tiles [m], ``[tile]``; None where there are none.
        push: what will push the trunk; None where nothing does.
        phase: of the gait [cycles].
    """

    qpos: Array
    qvel: Array
    board: Waves | Tilts | WeightSchedule | None
    tiles: Array | None
    push: Push | None
    phase: float


def begin(task: Task, scene: Scene, seed: int) -> Beginning:
    """The beginning of the episode of a seed: about the stand pose, on the ground, nearly at rest."""
    rng = np.random.default_rng([seed, 1])
    robot = scene.robot_file
    scatter, legs, position = task.placement, robot.indices(robot.controlled), robot.home.copy()
    position[legs] += scatter.joint_position * rng.standard_normal(len(legs))
    qpos = scene.initial_qpos(position)
    # a free base and twenty joints first; what else the scene holds starts at rest
    qvel = np.zeros(len(qpos) - 1)
    qvel[0:2] = scatter.velocity * rng.standard_normal(2)
    qvel[3:5] = scatter.angular_velocity * rng.standard_normal(2)
    qvel[6 + legs] = scatter.joint_velocity * rng.standard_normal(len(legs))
    tiles = draw_tiles(seed, task.terrain_height, task.terrain_steps) if task.scene == "terrain" else None
    push = Push.draw(seed, task.push, task.cycle or 1.0) if task.push else None
    phase = np.random.default_rng([seed, 2]).random() if task.first_phase is None else task.first_phase
    return Beginning(qpos, qvel, board_of(task, seed), tiles, push, phase)


def board_of(task: Task, seed: int) -> Waves | Tilts | WeightSchedule | None:
    """What moves the board in the episode of a seed; None for a task without a board."""
    if task.board == "still":
        return Waves.still()
    kinds = {"waves": Waves, "tilts": Tilts, "weight": WeightSchedule}
    return None if task.board is None else kinds[task.board].draw(seed)


def episode_seed(seed: int, index: int, episode: int) -> int:
    """The seed of an environment's k-th episode, whatever happens in the others."""
    return int(np.random.SeedSequence([seed, index, episode]).generate_state(1)[0])
