"""Soft actor-critic (Haarnoja et al. 2018, with automatic temperature), arranged for few and fast updates."""

import copy
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from op3.policy import Manifest, PolicyBundle
from op3.settings import Count, NotNegative, Number, Positive, Some, Whole, settings
from op3.train.networks import LARGEST_STD, SMALLEST_STD, Actor, TwinCritics
from op3.train.normaliser import Normaliser
from op3.train.replay_buffer import Batch

NORMALISED = 10_000
"""Observations that a normalisation taken over from another policy counts for."""


@settings()
class SACSettings:
    """Settings of the algorithm.

    Attributes:
        hidden: units of the policy's hidden layers.
        critic_hidden: units of the critics' hidden layers; those of the policy where None.
        layer_norm: whether the critics' hidden layers are normalised.
        discount: per policy step.
        n_step: steps of the return before the critics take over.
        batch: transitions per update.
        actor_rate: learning rate of the policy and the temperature.
        critic_rate: learning rate of the critics.
        target_rate: share by which the target critics follow per update.
        actor_every: critic updates per policy update.
        actor_after: critic updates before the first policy update, so that it does not follow untrained critics.
        initial_std: standard deviation of the untrained policy before tanh.
        largest_std: bound of the standard deviation; a small one keeps exploration where critics have data.
        initial_temperature: of the entropy bonus.
        target_entropy: per number of the action [nats].
        clip: bound of a normalised observation.
        bfloat16: whether the critics multiply in bfloat16; None: where the processor has instructions for it
            (avx512_bf16 or amx_bf16); others take forty times as long for it as for float32.
        compile: whether the losses run through torch.compile; on a GPU with CUDA graphs.
    """

    hidden: Some[Count] = (256, 256)
    critic_hidden: Some[Count] | None = None
    layer_norm: bool = True
    discount: Annotated[NotNegative, Field(lt=1)] = 0.98
    n_step: Count = 3
    batch: Count = 256
    actor_rate: Positive = 3e-4
    critic_rate: Positive = 3e-4
    target_rate: Positive = 0.005
    actor_every: Count = 1
    actor_after: Whole = 0
    initial_std: Positive = 0.2
    largest_std: Annotated[Number, Field(gt=SMALLEST_STD)] = LARGEST_STD
    initial_temperature: Positive = 0.01
    target_entropy: Number = -1.0
    clip: Positive = 10.0
    bfloat16: bool | None = False
    compile: bool = False


def _arithmetic(bfloat16: bool | None) -> torch.dtype:
    """What critics multiply in; None: bfloat16 where this processor has instructions for it."""
    if bfloat16 is None:
        has = torch.cpu.get_capabilities()
        bfloat16 = bool(has.get("avx512_bf16") or has.get("amx_bf16"))
    return torch.bfloat16 if bfloat16 else torch.float32


class SAC:
    """Policy, critics, temperature, and their optimisers.

    What makes an update cheap on a processor: the log-probability in one pass, both critics as one batched product,
    fused Adam, target critics followed in one call, and optionally critics in bfloat16.

    Args:
        observation_size: numbers in an observation.
        action_size: numbers in an action.
        settings: of the algorithm.
        generator: on `device`, of the initial weights, the exploration and the updates.
        initial_action: mean action [action] of the untrained policy; zeros where None.
        device: of everything.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        settings: SACSettings,
        generator: torch.Generator,
        initial_action: Tensor | None = None,
        device: torch.device | str = "cpu",
    ):
        self.settings, self.generator, self.device = settings, generator, torch.device(device)
        self.action_size = action_size
        # weights are drawn on the processor, so that a seed gives the same ones on every device
        weights = torch.Generator().manual_seed(generator.initial_seed())
        self.actor = Actor(
            observation_size,
            action_size,
            settings.hidden,
            weights,
            initial_action,
            settings.initial_std,
            settings.largest_std,
        ).to(self.device)
        self.critics = TwinCritics(
            observation_size,
            action_size,
            settings.critic_hidden or settings.hidden,
            weights,
            settings.layer_norm,
            _arithmetic(settings.bfloat16),
        ).to(self.device)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.log_temperature = torch.tensor(settings.initial_temperature, device=self.device).log().requires_grad_()
        self.normaliser = Normaliser(observation_size, self.device)
        self._policy_parameters: list[Tensor] = [*self.actor.parameters(), self.log_temperature]
        self._critic_parameters: list[Tensor] = [*self.critics.parameters()]
        self._target_parameters: list[Tensor] = [*self.targets.parameters()]
        self._actor_optimiser = torch.optim.Adam(self._policy_parameters, settings.actor_rate, fused=True)
        self._critic_optimiser = torch.optim.Adam(self._critic_parameters, settings.critic_rate, fused=True)
        self.updates = 0
        self._critic_step, self._actor_step = self._critic_loss, self._actor_loss
        if settings.compile:
            mode = "reduce-overhead" if self.device.type == "cuda" else "default"
            self._critic_step = torch.compile(self._critic_loss, mode=mode, fullgraph=True)
            self._actor_step = torch.compile(self._actor_loss, mode=mode, fullgraph=True)

    @torch.no_grad()
    def act(self, observation: Tensor, explore: float | Tensor) -> Tensor:
        """Actions [batch, action].

        Args:
            observation: [batch, observation], as the environment gives it.
            explore: multiple of the policy's standard deviation, a number or [batch, 1]; 0 is the mean.
        """
        observation = self.normaliser(observation.to(self.device, torch.float32), self.settings.clip)
        mean, log_std = self.actor(observation)
        if not isinstance(explore, float | int) or explore:
            mean = mean + explore * log_std.exp() * self._noise(mean.shape)
        return torch.tanh(mean)

    def update(self, batch: Batch) -> dict[str, Tensor]:
        """One gradient step of the critics and, every `actor_every`-th time, of policy and temperature.

        Args:
            batch: observations as the environment gives them.

        Returns:
            Measures as scalars on the device.
        """
        observation = self.normaliser(batch.observation, self.settings.clip)
        next_observation = self.normaliser(batch.next_observation, self.settings.clip)
        noise = self._noise((2, len(batch.reward), self.action_size))
        with torch.no_grad():
            target = self._target(next_observation, batch.reward, batch.discount, noise[0])
        loss, value = self._critic_step(observation, batch.action, target)
        self._step(self._critic_optimiser, loss, self._critic_parameters)
        measures = {"critic_loss": loss.detach(), "value": value.detach()}
        if self.updates >= self.settings.actor_after and self.updates % self.settings.actor_every == 0:
            loss, entropy = self._actor_step(observation, noise[1])
            self._step(self._actor_optimiser, loss, self._policy_parameters)
            measures |= {"actor_loss": loss.detach(), "entropy": entropy.detach()}
        rate = self.settings.target_rate
        torch._foreach_lerp_(self._target_parameters, self._critic_parameters, rate)  # pyright: ignore
        self.updates += 1
        measures["temperature"] = self.log_temperature.detach().exp()
        return measures

    def bundle(self, manifest: Manifest) -> PolicyBundle:
        """The policy without exploration, with the normalisation as it is now."""
        return PolicyBundle(manifest, self._policy_weights())

    def start_from(self, policy: PolicyBundle) -> None:
        """Begin with a policy's network and normalisation; critics and exploration begin anew.

        The normalisation is taken as if `NORMALISED` observations had been seen, so that it follows slowly.

        Raises:
            ValueError: if the policy has another size.
        """
        own = {name: tuple(value.shape) for name, value in self._policy_weights().items()}
        given = {name: tuple(value.shape) for name, value in policy.weights.items()}
        if own != given:
            raise ValueError(
                f"the policy to start from has hidden layers {list(policy.manifest.hidden)} and"
                f" {policy.manifest.observation_size} observations, this run {list(self.settings.hidden)} and"
                f" {len(self.normaliser.mean)}; use the settings that it was trained with"
            )
        with torch.no_grad():
            for name, value in self._policy_weights().items():
                if name.startswith("layer"):
                    value.copy_(policy.weights[name])
        mean, scale = policy.weights["observation.mean"].double(), policy.weights["observation.scale"].double()
        squares = scale.square() * NORMALISED
        self.normaliser.load_state_dict({"count": NORMALISED, "mean": mean, "squares": squares, "scale": scale})

    def _policy_weights(self) -> dict[str, Tensor]:
        """The tensors of a bundle, as views of this learner's."""
        weights = {"observation.mean": self.normaliser.mean, "observation.scale": self.normaliser.scale}
        for number, (weight, bias) in enumerate(zip(self.actor.weights, self.actor.biases, strict=True)):
            last = number == len(self.actor.weights) - 1
            rows = slice(self.action_size) if last else slice(None)
            weights |= {f"layer_{number}.weight": weight[rows], f"layer_{number}.bias": bias[rows]}
        return weights

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs to go on to the last bit."""
        return {
            "actor": self.actor.state_dict(),
            "critics": self.critics.state_dict(),
            "targets": self.targets.state_dict(),
            "log_temperature": self.log_temperature.detach(),
            "actor_optimiser": self._actor_optimiser.state_dict(),
            "critic_optimiser": self._critic_optimiser.state_dict(),
            "normaliser": self.normaliser.state_dict(),
            "generator": self.generator.get_state(),
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """The inverse of `state_dict`."""
        for name in ("actor", "critics", "targets"):
            getattr(self, name).load_state_dict(state[name])
        with torch.no_grad():
            self.log_temperature.copy_(state["log_temperature"])
        self._actor_optimiser.load_state_dict(state["actor_optimiser"])
        self._critic_optimiser.load_state_dict(state["critic_optimiser"])
        self.normaliser.load_state_dict(state["normaliser"])
        self.generator.set_state(state["generator"].cpu())
        self.updates = state["updates"]

    def _target(self, next_observation: Tensor, reward: Tensor, discount: Tensor, noise: Tensor) -> Tensor:
        """What the critics should have said [batch]."""
        action, log_prob = self.actor.sample(next_observation, noise)
        value = self.targets(next_observation, action).amin(0) - self.log_temperature.exp() * log_prob
        return torch.addcmul(reward, discount, value)

    def _critic_loss(self, observation: Tensor, action: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        value = self.critics(observation, action)
        return 0.5 * (value - target).square().mean(1).sum(), value.mean()

    def _actor_loss(self, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Loss of policy and temperature together; each reaches only its own parameters."""
        action, log_prob = self.actor.sample(observation, noise)
        temperature, entropy = self.log_temperature.exp(), -log_prob.mean()
        loss = -temperature.detach() * entropy - self.critics(observation, action).amin(0).mean()
        wanted = self.settings.target_entropy * self.action_size
        return loss + self.log_temperature * (entropy.detach() - wanted), entropy

    def _step(self, optimiser: torch.optim.Optimizer, loss: Tensor, parameters: list[Tensor]) -> None:
        # gradients of these parameters only: the policy's loss need not differentiate the critics' weights
        for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
            parameter.grad = gradient
        optimiser.step()

    def _noise(self, shape: Any) -> Tensor:
        return torch.randn(shape, generator=self.generator, device=self.device)
