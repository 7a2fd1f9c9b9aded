"""Demonstrations: a policy that shows a learner what to do, before it learns by itself and while it does.

The learner's policy begins as an imitation. The demonstrator acts with noise, so that it shows how it recovers (Laskey
et al. 2017, "DART"); in later rounds the imitation acts, and the demonstrator says what it would have done there (Ross
et al. 2011, "DAgger"). Then a share of every batch of reinforcement learning comes from the demonstrated episodes (Ball
et al. 2023, "Efficient online reinforcement learning with offline data").
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from op3.train.checks import numbers, whole
from op3.train.collector import Collector, Episodes, Policy
from op3.train.replay import Replay
from op3.train.sac import SAC


@dataclasses.dataclass(frozen=True)
class DemonstrationSettings:
    """How a run uses demonstrations; their steps and updates do not count as those of the run.

    Attributes:
        steps: environment steps of each round.
        rounds: the demonstrator acts in the first one, the imitation so far in the others.
        noise: standard deviation of the noise on the actions, for the boldest environment; it grows evenly from 0 in
            the first one.
        cloning: updates of the imitation in each round.
        cloning_rate: learning rate of these at the beginning of a round; it falls to a tenth, in a straight line.
        share: of every batch of reinforcement learning that comes from the first round.
        imitation: weight of the imitation in the policy's loss, at the beginning of the run.
        imitation_updates: updates over which that weight falls to nothing, in a straight line.
    """

    steps: int = 20_000
    rounds: int = 3
    noise: float = 0.03
    cloning: int = 2_000
    cloning_rate: float = 1e-3
    share: float = 0.5
    imitation: float = 20.0
    imitation_updates: int = 50_000

    def __post_init__(self):
        whole(self, 1, "steps", "rounds", "imitation_updates")
        whole(self, 0, "cloning")
        numbers(self, "noise", "imitation", "share", "cloning_rate")
        for name in ("noise", "imitation"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)}")
        if not 0 <= self.share < 1:
            raise ValueError(f"share must be at least 0 and below 1, got {self.share}")
        if not self.cloning_rate > 0:
            raise ValueError(f"cloning_rate must be positive, got {self.cloning_rate}")

    def imitation_after(self, updates: int) -> float:
        """Weight of the imitation after some updates."""
        return self.imitation * max(0.0, 1.0 - updates / self.imitation_updates)


class Shown:
    """What was demonstrated.

    Attributes:
        replay: the episodes of the first round, with the actions taken.
        observation: where the demonstrator was asked, [step, observation].
        answer: what it would have done, [step, action].
    """

    def __init__(self, replay: Replay, observation: Tensor, answer: Tensor):
        self.replay, self.observation, self.answer = replay, observation, answer

    def sample(self, size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Observations [batch, observation] and answers [batch, action], drawn evenly."""
        row = torch.randint(len(self.answer), (size,), generator=generator, device=self.answer.device)
        return self.observation.index_select(0, row), self.answer.index_select(0, row)

    def add(self, observation: Tensor, answer: Tensor) -> None:
        """Append answers [..., action] to observations [..., observation]."""
        self.observation = torch.cat([self.observation, observation.flatten(0, -2).to(self.observation)])
        self.answer = torch.cat([self.answer, answer.flatten(0, -2).to(self.answer)])

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs."""
        return {"replay": self.replay.state_dict(), "observation": self.observation.cpu(), "answer": self.answer.cpu()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """The inverse of `state_dict`."""
        self.replay.load_state_dict(state["replay"])
        self.observation = state["observation"].to(self.observation.device)
        self.answer = state["answer"].to(self.answer.device)


@dataclasses.dataclass(frozen=True, eq=False)
class Demonstrations:
    """A demonstrator and its environments.

    Attributes:
        collector: of environments of their own.
        policy: of the demonstrator, observations [env, observation] to actions [env, action].
        settings: of their use.
        seed: of environments and noise.
    """

    collector: Collector
    policy: Policy
    settings: DemonstrationSettings
    seed: int = 0

    def none(self, sac: SAC) -> Shown:
        """Nothing demonstrated yet."""
        size = len(sac.normaliser.mean)
        count, device = self.collector.count, sac.device
        replay = Replay(self._rows() * count, count, size, sac.action_size, device)
        return Shown(replay, torch.zeros(0, size, device=device), torch.zeros(0, sac.action_size, device=device))

    def show(self, sac: SAC, say: Callable[[str], None] = print) -> Shown:
        """Let the learner's policy imitate the demonstrator; its normalisation takes what it sees into account."""
        shown, generator = self.none(sac), torch.Generator().manual_seed(self.seed)
        noise = torch.linspace(0.0, self.settings.noise, self.collector.count)[:, None]
        for number in range(self.settings.rounds):
            acting = self.policy if number == 0 else _Imitation(sac)

            def noisy(observation: Tensor, acting: Policy = acting) -> Tensor:
                action = acting(observation).cpu()
                return (action + noise * torch.randn(action.shape, generator=generator)).clamp(-1.0, 1.0)

            self.collector.restart(self.seed + number)
            rollout, episodes = self.collector.collect(noisy, self._rows())
            sac.normaliser.update(rollout["observation"])
            if number == 0:
                shown.replay.extend(*(rollout[name] for name in STORED))
                shown.replay.cut()
            shown.add(rollout["observation"], torch.stack([self.policy(row) for row in rollout["observation"]]))
            batches = (shown.sample(sac.settings.batch, sac.generator) for _ in range(self.settings.cloning))
            left = sac.imitate(batches, self.settings.cloning, self.settings.cloning_rate)
            who = "demonstrator" if number == 0 else "imitation"
            say(f"round {number + 1}: the {who}'s {_summary(episodes)}; then cloned to {left:.4f}")
        return shown

    def _rows(self) -> int:
        """Steps of each environment in a round."""
        return max(2, -(-self.settings.steps // self.collector.count))


STORED = ("observation", "action", "reward", "next_observation", "terminated", "done")
"""Keys of a rollout that a replay buffer keeps, in its order."""


class _Imitation:
    """A learner's policy without exploration."""

    def __init__(self, sac: SAC):
        self._sac = sac

    def __call__(self, observation: Tensor) -> Tensor:
        return self._sac.act(observation, 0.0)


def _summary(episodes: Episodes) -> str:
    if not len(episodes.returns):
        return "episodes did not end"
    fell = int(episodes.terminated.sum())
    return f"return {float(episodes.returns.mean()):.1f}, {fell} of {len(episodes.returns)} fell"
