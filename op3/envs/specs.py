"""The keys of an environment, the same for every backend."""

import torch
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from op3.policy import ActionMap
from op3.tasks.task import Task

PEAKS = ("force", "acceleration")
"""Largest force on a foot [N] and acceleration of the body [m/s^2] within a step, for logs."""


def set_specs(env: EnvBase, task: Task, action_map: ActionMap, num_envs: int) -> None:
    """Give an environment its specs.

    Observations, actions and rewards are float32; ``reward_terms`` holds the weighted contributions to the reward,
    which is 1 plus their sum.
    """
    batch = torch.Size([num_envs])

    def numbers(width: int) -> Unbounded:
        return Unbounded(shape=torch.Size([num_envs, width]), dtype=torch.float32)

    def flag() -> Binary:
        return Binary(n=1, shape=torch.Size([num_envs, 1]), dtype=torch.bool)

    env.observation_spec = Composite(
        observation=numbers(task.observation_size),
        reward_terms=Composite({name: numbers(1) for name in task.reward_terms}, shape=batch),
        peak=Composite({name: numbers(1) for name in PEAKS}, shape=batch),
        shape=batch,
    )
    env.action_spec = Bounded(-1.0, 1.0, shape=torch.Size([num_envs, action_map.size]), dtype=torch.float32)
    env.reward_spec = numbers(1)
    env.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=batch)
