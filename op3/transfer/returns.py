"""Returns under R_eval of one policy on many candidate models at once, without recording the episodes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from math import ceil
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from op3.envs.batched import BatchedEnv
from op3.policy import PolicyBundle
from op3.robot import load_robot
from op3.servo import RobotModel
from op3.tasks.evaluation import evaluation_terms, swayed, travel_term
from op3.tasks.snapshot import Snapshot
from op3.tasks.task import POLICY_PERIOD, Task, find_task

ROWS = 96
"""Number of robots that one thread simulates together; half as many cost 6 % more each, twice as many 2 %."""


@dataclass(frozen=True, eq=False)
class Returns:
    """Returns of a policy on candidate models.

    The walked distance is read once per policy step instead of every tick as in a log, changing returns by below 0.1 %.

    Attributes:
        returns: R_eval summed over the steps of an episode, ``[candidate, episode]``; NaN if the simulation failed.
        fallen: whether the episode ended in a fall, ``[candidate, episode]``.
    """

    returns: Tensor
    fallen: Tensor


class ReturnsBench:
    """Runs the same episodes on every candidate: common random numbers, so that candidates only differ by their model.

    No time is spent after a fall, because the simulation continues with the next candidate.

    Args:
        model: effects, and the values of parameters that candidates do not give.
        num_threads: threads that step the physics; 0 for all processors.
    """

    def __init__(
        self,
        policy: PolicyBundle,
        model: RobotModel,
        task: str | Task = "balance_eval",
        episodes: int = 10,
        seed: int = 0,
        *,
        num_threads: int = 0,
    ):
        if episodes < 1:
            raise ValueError(f"the returns need at least one episode, got {episodes}")
        self.policy, self.model, self.task = policy, model, find_task(task)
        self.episodes, self.seed = episodes, seed
        self._num_threads = num_threads
        self._env: BatchedEnv | None = None
        self.simulated_seconds = 0.0

    def run(
        self,
        parameters: Mapping[str, Tensor] | None = None,
        candidates: int = 1,
        episodes: Sequence[int] | None = None,
    ) -> Returns:
        """The returns of all candidates.

        Args:
            parameters: shared values by name, ``[candidate]``; separate values of joints change in proportion
                (`RobotModel.for_joints`).
            episodes: numbers of the episodes to run; None: all episodes.
        """
        numbers = range(self.episodes) if episodes is None else episodes
        joints = load_robot(self.task.robot).joints
        values = {
            name: self.model.for_joints(name, torch.as_tensor(value, dtype=torch.float64), joints)
            for name, value in (parameters or {}).items()
        }
        total = candidates * len(numbers)
        env = self._environment(_rows(total))
        tally, waiting = _Tally(env, self.task, total), iter(range(total))

        def place(rows: Tensor, state: TensorDictBase | None = None) -> Any:
            """Assign the next episodes to rows while any remain; return the state of all rows."""
            jobs = list(islice(waiting, len(rows)))
            if not jobs:
                return state
            rows = rows[: len(jobs)]
            tally.jobs[rows], tally.running[rows] = torch.tensor(jobs), True
            if values:
                candidate = tally.jobs.clamp(min=0) // len(numbers)
                env.set_parameters({name: value[candidate] for name, value in values.items()})
            return env.begin({int(row): numbers[job % len(numbers)] for row, job in zip(rows, jobs, strict=True)})

        state = place(torch.arange(env.num_envs))
        while tally.running.any():
            before = env.snapshot()
            action = self.policy.act(state["observation"]).clamp(-1.0, 1.0)
            state["action"] = action.float()
            state = env.step(state)["next"]
            self.simulated_seconds += POLICY_PERIOD * int(tally.running.sum())
            tally.note(before, action)
            done = (state["done"][:, 0] & tally.running).nonzero()[:, 0]
            if len(done):
                tally.finish(done, env.snapshot(), state)
                state = place(done, state)
        shape = (candidates, len(numbers))
        return Returns(tally.returns.view(shape), tally.fallen.view(shape))

    def _environment(self, rows: int) -> BatchedEnv:
        if self._env is None or self._env.num_envs != rows:
            self._env = BatchedEnv(
                self.task,
                self.model,
                rows,
                self.seed,
                action_map=self.policy.manifest.action_map,
                num_threads=self._num_threads,
            )
        return self._env


def _rows(total: int) -> int:
    """Number of robots for which the last round of episodes leaves few of them idle."""
    return ceil(total / ceil(total / ROWS))


class _Tally:
    """Accumulates rewards of running episodes and returns of finished ones."""

    def __init__(self, env: BatchedEnv, task: Task, total: int):
        self._task, self._env = task, env
        count = env.num_envs
        self.jobs = torch.full((count,), -1)
        self.running = torch.zeros(count, dtype=torch.bool)
        self._sum, self._steps = torch.zeros(count, dtype=torch.float64), torch.zeros(count, dtype=torch.int64)
        self._previous = torch.zeros(count, env.action_map.size, dtype=torch.float64)
        self._start, self._reached = torch.zeros(count, dtype=torch.float64), torch.zeros(count, dtype=torch.float64)
        self.returns = torch.full((total,), torch.nan, dtype=torch.float64)
        self.fallen = torch.zeros(total, dtype=torch.bool)

    def note(self, before: Snapshot, action: Tensor) -> None:
        """Add a step, evaluated with the sensors at its beginning as in a log of the robot."""
        fresh = (self._steps == 0)[:, None]
        action = action.double()
        previous = torch.where(fresh, action, self._previous)
        orientation, rates = before.readings["orientation"], before.readings["angular_velocity"]
        velocity = swayed(rates, self._env.scene.robot_file) if self._task.cycle is None else None
        reward = evaluation_terms(
            self._task, action, previous, before.current, orientation, rates, before.specific_force, velocity
        )
        if before.tip is not None:
            self._start = torch.where(fresh[:, 0], before.tip, self._start)
            self._reached = torch.where(fresh[:, 0], before.tip, torch.maximum(self._reached, before.tip))
        self._sum = torch.where(fresh[:, 0], 0.0, self._sum) + reward
        self._steps += 1
        self._previous = action

    def finish(self, rows: Tensor, now: Snapshot, state: TensorDictBase) -> None:
        """Finish the episodes of these rows."""
        jobs, total = self.jobs[rows], self._sum[rows]
        if now.tip is not None:
            reached = torch.maximum(self._reached, now.tip)[rows] - self._start[rows]
            speed = reached / (self._steps[rows] * POLICY_PERIOD)
            total = total + self._steps[rows] * travel_term(self._task, speed)
        failed = self._env.simulation.failed[rows]
        self.returns[jobs] = torch.where(failed, torch.nan, total)
        self.fallen[jobs] = state["terminated"][rows, 0]
        self._steps[rows] = 0
        self.running[rows] = False
