"""One episode in each of many environments, with a policy that does not explore."""

import torch
from torchrl.envs import EnvBase

from op3.train.collector import Collector, Policy


def evaluate(environment: EnvBase, policy: Policy, seed: int, longest: int) -> dict[str, float]:
    """How a policy fares over one episode of each environment.

    Args:
        environment: batched, [env]; it is seeded and reset, so that a seed gives the same episodes each time.
        policy: chooses the actions.
        seed: of the episodes.
        longest: most steps of an episode; what runs on counts as survived.

    Returns:
        ``return`` and ``length`` (mean over the episodes) and ``upright``, the share not terminated.
    """
    collector = Collector(environment)
    collector.restart(seed)
    returns, lengths = torch.zeros(collector.count), torch.zeros(collector.count)
    running = torch.ones(collector.count, dtype=torch.bool)
    terminated = torch.zeros(collector.count, dtype=torch.bool)
    for _ in range(longest):
        rollout, _ = collector.collect(policy, 1)
        returns += torch.where(running, rollout["reward"][0], 0.0)
        lengths += running
        terminated |= running & rollout["terminated"][0]
        running &= ~rollout["done"][0]
        if not bool(running.any()):
            break
    return {
        "return": float(returns.mean()),
        "length": float(lengths.mean()),
        "upright": float((~terminated).float().mean()),
    }
