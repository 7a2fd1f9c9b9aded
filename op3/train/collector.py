"""Rolls a policy out in many environments at once, across the ends of their episodes."""

import dataclasses
from collections.abc import Callable, Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

STORED = ("observation", "action", "reward", "next_observation", "terminated", "done")
"""What a replay buffer keeps of a rollout, in the order of `op3.train.ReplayBuffer.extend`."""

Policy = Callable[[Tensor], Tensor]
"""Observations [env, observation] to actions [env, action] in [-1, 1]."""


@dataclasses.dataclass
class Episodes:
    """Returns and lengths of the episodes that ended in a rollout.

    Attributes:
        returns: sum of rewards of each.
        lengths: steps of each.
        terminated: whether each was ended by the task and not by time.
    """

    returns: Tensor
    lengths: Tensor
    terminated: Tensor


class EpisodeCounter:
    """Adds up the rewards and steps of episodes that span several rollouts.

    Args:
        count: environments side by side.
    """

    def __init__(self, count: int):
        self._returns = torch.zeros(count)
        self._lengths = torch.zeros(count, dtype=torch.long)

    def add(self, reward: Tensor, terminated: Tensor, done: Tensor) -> Episodes:
        """The episodes that ended in a rollout.

        Args:
            reward: [time, env].
            terminated: [time, env].
            done: [time, env].
        """
        ended = []
        for gained, fell, over in zip(reward, terminated, done, strict=True):
            self._returns += gained
            self._lengths += 1
            ended.append((self._returns[over], self._lengths[over], fell[over]))
            self._returns[over] = 0.0
            self._lengths[over] = 0
        return Episodes(*(torch.cat(values) for values in zip(*ended, strict=True)))


class Collector:
    """Steps a batched TorchRL environment; episodes that end begin anew by themselves.

    Args:
        environment: with batch size [env] and the keys ``observation`` and ``action``.
        extras: further keys of ``next`` to keep, for example the terms of the reward.
    """

    def __init__(self, environment: EnvBase, extras: tuple[tuple[str, ...], ...] = ()):
        if len(environment.batch_size) != 1:
            raise ValueError(f"the environment must have one batch dimension, got {tuple(environment.batch_size)}")
        self.environment, self.extras = environment, extras
        self.count = environment.batch_size[0]
        self._now: TensorDictBase | None = None
        self._counter = EpisodeCounter(self.count)

    def restart(self, seed: int) -> None:
        """Seed the environments and begin an episode in each."""
        self.environment.set_seed(seed)
        self._now = self.environment.reset()
        self._counter = EpisodeCounter(self.count)

    def practise(self, practice: Mapping[str, float]) -> None:
        """Tell the environments what to practise, see `op3.envs.BatchedEnv.practise`."""
        if practice:
            self.environment.practise(**practice)  # pyright: ignore[reportCallIssue]

    def collect(self, policy: Policy, steps: int) -> tuple[TensorDict, Episodes]:
        """A rollout of `steps` steps of every environment.

        Args:
            policy: chooses the actions.
            steps: of every environment.

        Returns:
            TensorDict [time, env] with ``observation``, ``action``, ``reward``, ``next_observation``,
            ``terminated``, ``done`` and the extras, in float32; and the episodes that ended.

        Raises:
            RuntimeError: if `restart` was not called.
            ValueError: if an observation or a reward is not finite.
        """
        if self._now is None:
            raise RuntimeError("a collector begins with restart(seed)")
        rows, now = [], self._now
        for _ in range(steps):
            observation = now["observation"].to(torch.float32)
            action = policy(observation)
            now["action"] = action.to(self.environment.device or "cpu")
            step, now = self.environment.step_and_maybe_reset(now)
            after = step["next"]
            row = {
                "observation": observation,
                "action": action.cpu(),
                "reward": after["reward"].view(self.count).to(torch.float32),
                "next_observation": after["observation"].to(torch.float32),
                "terminated": after["terminated"].view(self.count),
                "done": after["done"].view(self.count),
            }
            row |= {"/".join(key): after[key].view(self.count, -1).to(torch.float32) for key in self.extras}
            rows.append(row)
        self._now = now
        rollout = TensorDict({name: torch.stack([row[name] for row in rows]) for name in rows[0]}, [steps, self.count])
        check_finite(rollout)
        return rollout, self._counter.add(rollout["reward"], rollout["terminated"], rollout["done"])

    def close(self) -> None:
        """End the environments."""
        self.environment.close(raise_if_closed=False)


def check_finite(rollout: TensorDictBase) -> None:
    """Refuse a rollout with an observation or a reward that is not finite."""
    for name in ("next_observation", "reward"):
        if not bool(torch.isfinite(rollout[name]).all()):
            raise ValueError(f"the environment gave a {name} that is not finite; check its model file")
