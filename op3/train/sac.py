"""Soft actor-critic (Haarnoja et al. 2018, with automatic temperature)."""

import copy
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.modules import TanhNormal

from op3.common.settings import Number, Positive, settings
from op3.train.algorithm import NORMALISED, Measures
from op3.train.networks import Ensemble, approach
from op3.train.off_policy import OffPolicy, OffPolicySettings


@settings("algorithm")
class SACSettings(OffPolicySettings):
    """Settings of soft actor-critic.

    Attributes:
        initial_temperature: initial weight of the entropy bonus.
        target_entropy: target entropy per number of the action [nats].
    """

    initial_temperature: Positive = 0.01
    target_entropy: Number = -1.0


class SAC(OffPolicy):
    """Policy, two critics, temperature.

    The losses equal those of `torchrl.objectives.SACLoss` with ``loss_function="l2"``, halved for the critics. They are
    implemented here because functional modules and vmap take a third of an update of such networks on a CPU
    (`experiments/benchmarks/learner_speed.py`).
    """

    Settings = SACSettings

    def build(self) -> None:
        """Make critics, their targets, temperature and buffer."""
        self.critics = Ensemble([self.q_network(), self.q_network()])
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.log_temperature = nn.Parameter(torch.tensor(self.settings.initial_temperature).log())
        self.make_buffer()

    def optimise(self) -> None:
        """One optimiser for the critics, and one for policy and temperature."""
        policy = [*self.network.parameters(), self.log_temperature]
        self.optimisers["critics"] = torch.optim.Adam(self.critics.parameters(), self.settings.critic_rate, fused=True)
        self.optimisers["policy"] = torch.optim.Adam(policy, self.settings.actor_rate, fused=True)

    def update(self, batch: TensorDictBase) -> Measures:
        """One gradient step of the critics and, every `actor_every` updates, of policy and temperature."""
        loss, value = self.critic_loss(batch)
        self.step("critics", loss)
        measures = {"critic_loss": loss.detach(), "value": value.detach()}
        if self.actor_is_due:
            loss, entropy = self.policy_loss(batch)
            self.step("policy", loss)
            measures |= {"actor_loss": loss.detach(), "entropy": entropy.detach()}
        approach(self.target_critics, self.critics, self.settings.target_rate)
        return measures | {"temperature": self.log_temperature.detach().exp()}

    def sample(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Actions [..., action] of the policy for normalised observations, and their log probabilities [...]."""
        # safe_tanh would keep actions away from 1; here probabilities come with the samples
        return TanhNormal(*self.network(observation), safe_tanh=False).rsample_and_log_prob()

    def critic_loss(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Loss of the critics, and their mean value."""
        after: Any = batch["next"]
        with torch.no_grad():
            action, log_prob = self.sample(after[NORMALISED])
            value = self.target_critics(after[NORMALISED], action).amin(0) - self.log_temperature.exp() * log_prob
            discount = self.settings.discount ** batch["steps_to_next_obs"] * ~after["terminated"].squeeze(-1)
            target = torch.addcmul(after["reward"].squeeze(-1), discount, value)
        value = self.critics(batch[NORMALISED], batch["action"])
        return 0.5 * (value - target).square().mean(1).sum(), value.mean()

    def policy_loss(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Sum of the losses of policy and temperature, whose gradients are separate; and the entropy."""
        action, log_prob = self.sample(batch[NORMALISED])
        temperature, entropy = self.log_temperature.exp(), -log_prob.mean()
        loss = -temperature.detach() * entropy - self.critics(batch[NORMALISED], action).amin(0).mean()
        wanted = self.settings.target_entropy * self.action_size
        return loss + self.log_temperature * (entropy.detach() - wanted), entropy

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *options: Any) -> None:
        """Load the state; checkpoints of earlier versions contain the policy's weights a second time as ``actor``."""
        for name in [name for name in state_dict if name.startswith(f"{prefix}actor.")]:
            del state_dict[name]
        super()._load_from_state_dict(state_dict, prefix, *options)
