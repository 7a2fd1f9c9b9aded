"""The keys of an environment, the same for every backend."""

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from op3.tasks.mdp import Mdp, Outcome
from op3.tasks.whole_step import StepStatistics

MEASURES = ("peak_force", "peak_acceleration", "peak_penetration", "self_contact")
"""Quantities that training logs besides reward and success, see `op3.tasks.whole_step.StepStatistics`."""


def set_specs(env: EnvBase, mdp: Mdp) -> None:
    """Give an environment its specs.

    Observations, actions and rewards are float32; ``reward_terms`` holds the weighted contributions to the reward,
    which is their sum; ``privileged`` is only for critics, and exists only if the task has such terms.
    """
    num_envs = mdp.num_envs
    batch = torch.Size([num_envs])

    def numbers(width: int) -> Unbounded:
        return Unbounded(shape=torch.Size([num_envs, width]), dtype=torch.float32)

    def flag() -> Binary:
        return Binary(n=1, shape=torch.Size([num_envs, 1]), dtype=torch.bool)

    env.observation_spec = Composite(
        observation=numbers(mdp.observer.size),
        reward_terms=Composite({name: numbers(1) for name in mdp.task.reward_terms}, shape=batch),
        measure=Composite({name: numbers(1) for name in (*MEASURES, "success")}, shape=batch),
        shape=batch,
    )
    if mdp.privileged.shape[1]:
        env.observation_spec["privileged"] = numbers(mdp.privileged.shape[1])
    env.action_spec = Bounded(-1.0, 1.0, shape=torch.Size([num_envs, mdp.action_map.size]), dtype=torch.float32)
    env.reward_spec = numbers(1)
    env.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=batch)


def as_tensordict(
    mdp: Mdp, observation: Tensor, outcome: Outcome | None = None, statistics: StepStatistics | None = None
) -> TensorDict:
    """Output of an environment after a step, or without an outcome at the beginning of episodes."""
    count = len(observation)

    def column(values: Tensor | None) -> Tensor:
        return torch.zeros(count, 1) if values is None else values.float()[:, None]

    none = torch.zeros(count, dtype=torch.bool)
    terminated, truncated = (none, none) if outcome is None else (outcome.terminated, outcome.truncated)
    success = None if outcome is None else outcome.success
    content = {
        "observation": observation.float(),
        "reward_terms": {name: column(outcome.terms[name] if outcome else None) for name in mdp.task.reward_terms},
        "measure": {name: column(getattr(statistics, name, None)) for name in MEASURES} | {"success": column(success)},
        "done": (terminated | truncated)[:, None],
        "terminated": terminated.clone()[:, None],
        "truncated": truncated.clone()[:, None],
    }
    if mdp.privileged.shape[1]:
        content["privileged"] = mdp.privileged.float()
    if outcome is not None:
        content["reward"] = column(outcome.reward)
    return TensorDict(content, [count])
