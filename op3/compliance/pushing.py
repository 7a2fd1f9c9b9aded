"""The largest push survived, per direction: a ladder of impulses on many robots side by side."""

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
"""Time after a push for which a robot must stay upright to have survived it [s]."""

ROWS = 80
"""Robots simulated together; larger batches are hardly faster per robot."""


@dataclass(frozen=True, eq=False)
class Survival:
    """Which pushes were survived.

    Attributes:
        impulse: impulse of each rung of the ladder [N s], [rung].
        survived: ``[direction, rung, episode]``.
    """

    impulse: Array
    survived: NDArray[np.bool_]

    @property
    def largest(self) -> Array:
        """Largest impulse survived, mean over states of the gait, with its 95 % interval: ``[direction, 3]`` in N s.

        The mean threshold is the area under the share that survives (Spearman-Karber); rungs stand in the middle of
        equal steps. A robot that survives the highest rung is counted as if that were its threshold.
        """
        return np.stack([self._estimate(self.survived[[i]]) for i in range(len(self.survived))])

    @property
    def mean_largest(self) -> Array:
        """The same, mean over the directions: [3] in N s."""
        return self._estimate(self.survived)

    def _estimate(self, survived: NDArray[np.bool_]) -> Array:
        step = self.impulse[1] - self.impulse[0]
        share, count = survived.mean(-1), survived.shape[-1]
        middle = step * share.sum(-1).mean()
        # the variance of a share, kept from being nothing at 0 and 1 (Agresti and Coull)
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

    Beginnings, directions and times of the pushes depend on the seed alone, so that policies meet the same; and no
    push depends on how many robots stand side by side.

    Args:
        most: impulse up to which the ladder reaches [N s].
        rungs: number of rungs of the ladder, each with so many episodes in each direction.
        episodes: see `rungs`.
        rows: robots side by side, at most; who is done with one push gets the next.
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
    """Whether each push was survived, [push]; a robot that is done gets the next one."""
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
