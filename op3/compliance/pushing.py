"""The largest survived push by direction, from a ladder of impulses on many robots in parallel."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from op3.envs.actors import Actor
from op3.envs.batched import BatchedEnv
from op3.servo import RobotModel
from op3.tasks.pushes import DIRECTIONS, FIRST_PUSH, PUSH_DURATION, Push
from op3.tasks.task import Task, find_task

Array = NDArray[np.float64]

AFTER = 2.0
"""Time for which a robot must stay upright to survive a push [s]."""

ROWS = 80
"""Robots simulated together; larger batches are hardly faster per robot."""


@dataclass(frozen=True, eq=False)
class Survival:
    """Which pushes were survived.

    Attributes:
        impulse: impulse of each rung [N s], [rung].
        survived: ``[direction, rung, episode]``.
    """

    impulse: Array
    survived: NDArray[np.bool_]

    @property
    def largest(self) -> Array:
        """Largest impulse survived, mean over states of the gait, with its 95 % interval: ``[direction, 3]`` in N s.

        The mean threshold is the area under the share that survives (Spearman-Karber); rungs stand in the middle of
        equal steps. If a robot survives the highest rung, its threshold is taken as that rung.
        """
        return np.stack([self._estimate(self.survived[[i]]) for i in range(len(self.survived))])

    @property
    def mean_largest(self) -> Array:
        """Largest survived impulse with its interval, mean over the directions: [3] in N s."""
        return self._estimate(self.survived)

    def _estimate(self, survived: NDArray[np.bool_]) -> Array:
        step = self.impulse[1] - self.impulse[0]
        share, count = survived.mean(-1), survived.shape[-1]
        middle = step * share.sum(-1).mean()
        # the variance of a share, corrected so that it is not zero at 0 and 1 (Agresti and Coull)
        guarded = (survived.sum(-1) + 1) / (count + 2)
        half = 1.96 * step * np.sqrt((guarded * (1 - guarded) / count).sum()) / len(survived)
        return np.array([middle, max(0.0, middle - half), middle + half])


def survive_pushes(
    actor: Actor,
    model: str | RobotModel,
    task: Task,
    *,
    most: float = 3.0,
    rungs: int = 10,
    episodes: int = 5,
    seed: int = 0,
    rows: int = ROWS,
    **options: Any,
) -> Survival:
    """Push walking robots, each once, and record which stay upright.

    Initial states, directions and times of the pushes depend only on the seed, not on the number of parallel robots, so
    that all policies get the same pushes.

    Args:
        most: largest impulse of the ladder [N s].
        rungs: number of rungs of the ladder.
        episodes: number of episodes per rung and direction.
        rows: largest number of parallel robots; a robot that has finished a push gets the next one.
        **options: further arguments of `op3.envs.make_env`.
    """
    impulse = most * (np.arange(rungs) + 0.5) / rungs
    direction, rung, _ = (axis.reshape(-1) for axis in np.indices((DIRECTIONS, rungs, episodes)))
    times = FIRST_PUSH + (task.cycle or 1.0) * np.random.default_rng([seed, 4]).random(len(direction))
    pushes = [Push.towards(int(d), float(impulse[r]), float(t)) for d, r, t in zip(direction, rung, times, strict=True)]
    task = find_task(task, {"events.pushing": {"impulse": 0.0}})
    env = actor.environment(task, model, min(rows, len(pushes)), seed, **options)
    survived = _push_all(env, actor, pushes)
    return Survival(impulse, survived.reshape(DIRECTIONS, rungs, episodes))


def _push_all(env: BatchedEnv, actor: Actor, pushes: Sequence[Push]) -> NDArray[np.bool_]:
    """Whether each push was survived, [push]; a robot that has finished a push gets the next one."""
    survived = np.ones(len(pushes), dtype=bool)
    waiting, free = iter(range(len(pushes))), np.arange(env.num_envs)
    job = np.full(env.num_envs, -1)
    until = np.array([push.start + PUSH_DURATION + AFTER for push in pushes])
    state: Any = None
    while True:
        job[free] = [next(waiting, -1) for _ in free]
        begun = [int(row) for row in free if job[row] >= 0]
        if begun:
            state = env.begin({row: int(job[row]) for row in begun})
            env.mdp.event("pushing").replace(np.array(begun), [pushes[job[row]] for row in begun])
        if (job < 0).all():
            return survived
        state = actor.step(env, state)
        fallen, active = state["terminated"][:, 0].numpy(), job >= 0
        survived[job[active & fallen]] = False
        free = np.flatnonzero(active & (fallen | (env.mdp.time.numpy() >= until[job])))
