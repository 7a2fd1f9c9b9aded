"""Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018), with TorchRL's loss."""

from typing import Any

from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.data import Bounded
from torchrl.objectives import LossModule, TD3Loss

from op3.common.settings import Positive, settings
from op3.train.algorithm import NORMALISED
from op3.train.networks import PolicyNetwork
from op3.train.off_policy import OffPolicy, OffPolicySettings


@settings("algorithm")
class TD3Settings(OffPolicySettings):
    """Settings of TD3; `initial_std` is the constant standard deviation of its exploration.

    Attributes:
        policy_noise: standard deviation of the noise on the target's action.
        noise_clip: bound of that noise.
    """

    policy_noise: Positive = 0.2
    noise_clip: Positive = 0.5


class TD3(OffPolicy):
    """A deterministic policy and two critics."""

    Settings = TD3Settings

    def policy_network(self, initial_action: Tensor | None) -> PolicyNetwork:
        """The policy's network; only its mean is learned."""
        chosen = self.settings
        sizes = self.observation_size, self.action_size
        return PolicyNetwork(
            *sizes, chosen.hidden, chosen.activation, initial_action, chosen.initial_std, largest_std=None
        )

    def make_loss(self) -> LossModule:
        """TorchRL's loss of TD3."""
        parts: Any = (
            TensorDictModule(self.network, [NORMALISED], ["loc", "scale"]),
            TensorDictModule(Tensor.tanh, ["loc"], ["action"]),
        )
        loss = TD3Loss(
            TensorDictSequential(*parts),
            self.critic(),
            action_spec=Bounded(-1.0, 1.0, self.action_size),
            policy_noise=self.settings.policy_noise,
            noise_clip=self.settings.noise_clip,
            loss_function="l2",
        )
        loss.make_value_estimator(gamma=self.settings.discount)
        return loss
