"""Collecting in several processes, each with a batch of environments, through TorchRL's synchronous collector."""

import copy
from collections.abc import Callable, Iterator
from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import EnvBase
from torchrl.weight_update import MultiProcessWeightSyncScheme

from op3.train.collector import EpisodeCounter, Episodes, check_finite
from op3.train.sac import SAC, Exploring

MakeEnvironment = Callable[[int], EnvBase]
"""Makes a batched environment from a seed; it must be picklable, such as a function of a module or a partial of one."""


class WorkerPolicy(nn.Module):
    """A copy of a learner's policy that explores with a generator of its own.

    Args:
        sac: whose policy is copied.
        boldness: of each environment [env, 1], from 0 (the policy's own standard deviation) to 1 (the boldest).
        seed: of the exploration.
    """

    mean: Tensor
    scale: Tensor
    boldest: Tensor

    def __init__(self, sac: SAC, boldness: Tensor, seed: int):
        super().__init__()
        self.actor = copy.deepcopy(sac.actor).cpu().requires_grad_(False)
        self.clip, self.seed = sac.settings.clip, seed
        self.register_buffer("mean", sac.normaliser.mean.cpu().clone())
        self.register_buffer("scale", sac.normaliser.scale.cpu().clone())
        self.register_buffer("boldest", torch.ones(()))
        self.boldness = boldness
        self._generator: torch.Generator | None = None

    def forward(self, observation: Tensor) -> Tensor:
        """Actions [env, action] for observations [env, observation]."""
        if self._generator is None:  # made in the worker, since generators do not travel between processes
            self._generator = torch.Generator().manual_seed(self.seed)
        observation = ((observation.to(torch.float32) - self.mean) / self.scale).clamp(-self.clip, self.clip)
        mean, log_std = self.actor(observation)
        noise = torch.randn(mean.shape, generator=self._generator)
        return torch.tanh(mean + self.boldest**self.boldness * log_std.exp() * noise)


class ProcessCollector:
    """Environments in `processes` processes; every rollout waits for all of them.

    The same seed gives the same rollouts. `restart` starts new processes, which takes some seconds each.

    Args:
        make_environment: makes the environments of one process from a seed.
        processes: how many.
        environments: of each process.
        extras: further keys of ``next`` to keep, for example the terms of the reward.
    """

    def __init__(
        self,
        make_environment: MakeEnvironment,
        processes: int,
        environments: int,
        extras: tuple[tuple[str, ...], ...] = (),
    ):
        if processes < 1 or environments < 1:
            raise ValueError(f"processes and environments must be at least 1, got {processes} and {environments}")
        self._make, self._processes, self._each, self._extras = make_environment, processes, environments, extras
        self.count = processes * environments
        self._seed: int | None = None
        self._workers: MultiSyncCollector | None = None
        self._rollouts: Iterator[TensorDictBase] = iter(())
        self._counter = EpisodeCounter(self.count)

    def restart(self, seed: int) -> None:
        """End the processes; the next rollout starts new ones from this seed."""
        self.close()
        self._seed, self._counter = seed, EpisodeCounter(self.count)

    def collect(self, policy: Exploring, steps: int) -> tuple[TensorDict, Episodes]:
        """As `op3.train.Collector.collect`; `steps` must be the same from one restart to the next."""
        if self._seed is None:
            raise RuntimeError("a collector begins with restart(seed)")
        if self._workers is None:
            self._start(policy.sac, steps, self._seed)
        assert self._workers is not None
        self._send(policy)
        data = next(self._rollouts)
        # [process, env, time] as TorchRL stacks it, [time, process * env] as everywhere here
        rows = data.reshape(self.count, -1).transpose(0, 1)
        rollout = TensorDict(
            {
                "observation": rows["observation"].float(),
                "action": rows["action"].float(),
                "reward": rows["next", "reward"].squeeze(-1).float(),
                "next_observation": rows["next", "observation"].float(),
                "terminated": rows["next", "terminated"].squeeze(-1),
                "done": rows["next", "done"].squeeze(-1),
                **{"/".join(key): rows["next", *key].float() for key in self._extras},
            },
            [steps, self.count],
        ).clone()  # the workers write the next rollout into the same memory
        check_finite(rollout)
        return rollout, self._counter.add(rollout["reward"], rollout["terminated"], rollout["done"])

    def close(self) -> None:
        """End the processes."""
        if self._workers is not None:
            self._workers.shutdown()
        self._workers = None

    def _start(self, sac: SAC, steps: int, seed: int) -> None:
        seeds = [seed * self._processes + number for number in range(self._processes)]
        boldness = torch.linspace(0.0, 1.0, self.count)[:, None].split(self._each)
        factories = [partial(worker_policy, sac, *each) for each in zip(boldness, seeds, strict=True)]
        self._workers = MultiSyncCollector(
            [partial(self._make, one) for one in seeds],
            policy_factory=factories,
            weight_sync_schemes={"policy": MultiProcessWeightSyncScheme()},
            frames_per_batch=self.count * steps,
            total_frames=-1,
            cat_results="stack",
            num_sub_threads=1,
        )
        self._rollouts = iter(self._workers)

    def _send(self, policy: Exploring) -> None:
        assert self._workers is not None
        worker = worker_policy(policy.sac, torch.zeros(1, 1), 0)
        worker.module.boldest.copy_(policy.noise.max())
        self._workers.update_policy_weights_(TensorDict.from_module(worker).data)


def worker_policy(sac: SAC, boldness: Tensor, seed: int) -> TensorDictModule:
    """A learner's exploring policy for a collector of TorchRL, on this machine or on others.

    Args:
        sac: whose policy is copied.
        boldness: of each environment of the worker [env, 1], from 0 to 1.
        seed: of the exploration.
    """
    return TensorDictModule(WorkerPolicy(sac, boldness, seed), ["observation"], ["action"])
