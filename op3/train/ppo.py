"""Proximal policy optimisation (Schulman et al. 2017), with TorchRL's loss and advantages."""

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from op3.common.settings import Count, NotNegative, Positive, Share, settings
from op3.train.algorithm import NORMALISED, Algorithm, AlgorithmSettings, Explorer, Measures

KEPT = (NORMALISED, "action", "action_log_prob", "advantage", "value_target")
"""Keys that the loss reads."""


@settings("algorithm")
class PPOSettings(AlgorithmSettings):
    """Settings of PPO.

    Attributes:
        rate: learning rate.
        gae: lambda of the advantages.
        clip_ratio: clipping range of the probability ratio.
        entropy: weight of the entropy bonus.
        epochs: passes over a rollout.
        batch: transitions per update.
        largest_gradient: bound of the gradient's norm.
    """

    rollout: Count = 32
    rate: Positive = 3e-4
    gae: Share = 0.95
    clip_ratio: Positive = 0.2
    entropy: NotNegative = 0.0
    epochs: Count = 5
    batch: Count = 512
    largest_gradient: Positive = 1.0


class PPO(Algorithm):
    """Policy and value function, trained between rollouts on only the latest rollout."""

    Settings = PPOSettings

    def build(self) -> None:
        """Make the value function, the loss and the advantages."""
        chosen = self.settings
        hidden = list(chosen.critic_hidden or chosen.hidden)
        value = ValueOperator(MLP(self.critic_input_size, 1, num_cells=hidden, activation_class=nn.ReLU), [NORMALISED])
        self.loss = ClipPPOLoss(
            self.stochastic_actor(), value, clip_epsilon=chosen.clip_ratio, entropy_coeff=chosen.entropy
        )
        self.loss.set_keys(sample_log_prob="action_log_prob")
        self.advantage = GAE(gamma=chosen.discount, lmbda=chosen.gae, value_network=value)
        size = chosen.rollout * self.environments
        self.buffer = ReplayBuffer(
            storage=LazyTensorStorage(size, device=self.device),
            sampler=SamplerWithoutReplacement(),
            batch_size=min(chosen.batch, size),
        )

    def optimise(self) -> None:
        """One optimiser for all parameters."""
        self.optimisers["loss"] = torch.optim.Adam(self.loss.parameters(), self.settings.rate, fused=True)

    def make_explorer(self) -> Explorer:
        """An explorer that stores the probability of its actions."""
        return Explorer(self.normaliser, self.network, self.environments, scored=True)

    def take(self, rollout: TensorDictBase) -> Measures:
        """Learn from a rollout that the current policy has collected."""
        rollout = self.normalise(rollout.to(self.device))
        with torch.no_grad():
            self.advantage(rollout)
        measures: Measures = {}
        for _ in range(self.settings.epochs):
            self.buffer.empty()
            self.buffer.extend(rollout.select(*KEPT).reshape(-1))
            for batch in self.buffer:
                losses = self.loss(batch)
                names = [name for name in losses.sorted_keys if name.startswith("loss_")]
                self.optimisers["loss"].zero_grad()
                sum(losses[name] for name in names).backward()
                nn.utils.clip_grad_norm_(self.loss.parameters(), self.settings.largest_gradient)
                self.optimisers["loss"].step()
                self.count_update()
                measures = {name: losses[name].detach() for name in (*names, "entropy")}
        self.normaliser.update(self.critic_inputs(rollout))
        return measures
