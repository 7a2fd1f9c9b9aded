"""One episode in each of many environments, with a policy that does not explore."""

from collections.abc import Callable

import torch
from torch import Tensor
from torchrl.envs import EnvBase

Policy = Callable[[Tensor], Tensor]
"""Observations [env, observation] to actions [env, action] in [-1, 1]."""


@torch.no_grad()
def evaluate(
    environment: EnvBase,
    policy: Policy,
    seed: int,
    longest: int,
    watch: Callable[[Tensor, Tensor], None] | None = None,
) -> dict[str, float]:
    """Evaluate a policy over one episode of each environment.

    Args:
        environment: batched environment [env], which is seeded and reset so that a seed gives the same episodes.
        policy: chooses the actions.
        seed: seed of the episodes.
        longest: largest number of steps of an episode; longer episodes count as survived.
        watch: function called before each step with the actions [env, action] and a mask [env] of running environments.

    Returns:
        ``return`` and ``length`` (mean over the episodes), and the shares ``upright``, not terminated, and ``success``,
        if the environment has such a ``measure``.
    """
    environment.set_seed(seed)
    now, count = environment.reset(), environment.batch_size[0]
    returns, lengths = torch.zeros(count), torch.zeros(count)
    running, terminated = torch.ones(count, dtype=torch.bool), torch.zeros(count, dtype=torch.bool)
    succeeded = torch.zeros(count)
    for _ in range(longest):
        now["action"] = policy(now["observation"].float())
        if watch is not None:
            watch(now["action"], running)
        step, now = environment.step_and_maybe_reset(now)
        reward, fell, done = (step["next", name].view(count) for name in ("reward", "terminated", "done"))
        returns += torch.where(running, reward, 0.0)
        lengths += running
        success = step.get(("next", "measure", "success"), None)
        if success is not None:
            succeeded = torch.where(running, success.view(count), succeeded)
        terminated |= running & fell
        running &= ~done
        if not bool(running.any()):
            break
    measures = {"return": returns, "length": lengths, "upright": (~terminated).float()}
    if now.get(("measure", "success"), None) is not None:
        measures["success"] = succeeded
    return {name: float(values.mean()) for name, values in measures.items()}
