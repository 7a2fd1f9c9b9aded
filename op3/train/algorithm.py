"""Base class of algorithms: networks, a policy with an exploring copy, and two stages of learning."""

import copy
import dataclasses
import math
from abc import ABC, abstractmethod
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, TanhNormal

from op3.common.settings import Count, Number, Positive, Some, settings
from op3.policy import Manifest, PolicyBundle
from op3.policy.mirror import Mirror
from op3.train.networks import LARGEST_STD, SMALLEST_STD, Normaliser, PolicyNetwork, approach

NORMALISED = "normalised"
"""Key of the normalised ``observation``, followed by the ``privileged`` one that a task may have for critics only."""

Measures = dict[str, Tensor]
"""Scalars by name, for logs."""


@settings("algorithm")
class AlgorithmSettings:
    """Common settings of algorithms.

    Attributes:
        hidden: units of the policy's hidden layers.
        activation: activation of the policy's hidden layers.
        critic_hidden: units of the critics' hidden layers; None: as in the policy.
        rollout: steps of every environment per rollout.
        discount: discount per policy step.
        initial_std: standard deviation of the untrained policy before tanh.
        largest_std: bound of the standard deviation; a small value keeps exploration where critics have data.
        clip: bound of a normalised observation.
        averaging: decay per update of a running average of the policy's weights. The policy that is evaluated and kept
            has the average, or the latest weights if this is 0.
    """

    hidden: Some[Count] = (256, 256)
    activation: Literal["relu", "elu", "silu", "tanh"] = "relu"
    critic_hidden: Some[Count] | None = None
    rollout: Count = 8
    discount: Annotated[Number, Field(ge=0, lt=1)] = 0.98
    initial_std: Positive = 0.2
    largest_std: Annotated[Number, Field(gt=SMALLEST_STD)] = LARGEST_STD
    clip: Positive = 10.0
    averaging: Annotated[Number, Field(ge=0, lt=1)] = 0.0


class Algorithm(nn.Module, ABC):
    """Learns a policy from rollouts of a batched environment.

    `take` must finish before the next rollout begins; `learn` may run while it is collected. The state dictionary holds
    everything that a bitwise identical continuation needs, except torch's global generator, which `op3.train.train`
    seeds whenever all episodes restart.

    Args:
        environment: batched environment with ``observation`` and ``action`` in [-1, 1].
        seed: seed of the initial weights.
        initial_action: mean action [action] of the untrained policy; None: zeros.
        mirror: the environment's plane of symmetry, for algorithms that use it.
        device: device of the networks.
        **settings: settings of the algorithm, see its `Settings`.

    Raises:
        ValueError: if a setting is unknown or impossible.
    """

    Settings: type[AlgorithmSettings] = AlgorithmSettings

    def __init__(
        self,
        environment: EnvBase,
        *,
        seed: int = 0,
        initial_action: Tensor | None = None,
        mirror: Mirror | None = None,
        device: torch.device | str = "cpu",
        **settings: Any,
    ):
        super().__init__()
        self.settings: Any = self.Settings(**settings)
        if len(environment.batch_size) != 1:
            raise ValueError(f"the environment must have one batch dimension, got {tuple(environment.batch_size)}")
        self.environments = environment.batch_size[0]
        self.observation_size = environment.observation_spec["observation"].shape[-1]
        self.action_size = environment.action_spec.shape[-1]
        self.critic_keys = [name for name in ("observation", "privileged") if name in environment.observation_spec]
        self.critic_input_size = sum(environment.observation_spec[name].shape[-1] for name in self.critic_keys)
        self.mirror, self.device = mirror, torch.device(device)
        self.normalisation = getattr(self.settings, "normalisation", "running")
        self.updates = 0
        self.optimisers: dict[str, torch.optim.Optimizer] = {}
        torch.manual_seed(seed)  # weights are drawn on the CPU, so that a seed gives the same weights on every device
        self.normaliser = Normaliser(self.critic_input_size, self.settings.clip)
        self.network = self.policy_network(initial_action)
        self.average = copy.deepcopy(self.network).requires_grad_(False) if self.settings.averaging else None
        self.build()
        self.to(self.device)
        self.optimise()
        self._explorer = (self.make_explorer(),)  # in a tuple, which keeps it out of the state dictionary
        self.restart(seed)

    @abstractmethod
    def build(self) -> None:
        """Make all networks except `network`, which is the policy's."""

    @abstractmethod
    def optimise(self) -> None:
        """Make the optimisers by name."""

    @abstractmethod
    def take(self, rollout: TensorDictBase) -> Measures:
        """Receive a rollout [env, time] before the next one begins; ``done`` is set where an episode ends."""

    def learn(self) -> Measures:
        """Learn from the rollouts taken, while the next one is collected in another thread."""
        return {}

    @property
    def explorer(self) -> "Explorer":
        """The policy that collects rollouts: a copy, so that this policy may change at the same time."""
        return self._explorer[0]

    def follow(self) -> None:
        """Copy the current policy to the explorer."""
        self.explorer.follow()

    def restart(self, seed: int) -> None:
        """Restart the exploration, because all episodes restart."""
        self.explorer.generator.manual_seed(seed)

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        """Actions [..., action] without exploration for observations [..., observation]."""
        network = self.average or self.network
        return network(self.normaliser(observation.to(self.device, torch.float32)))[0].tanh().to(observation)

    def bundle(self, manifest: Manifest) -> PolicyBundle:
        """The policy without exploration, with the present normalisation, which the manifest records."""
        chosen = self.settings
        network = {"hidden": chosen.hidden, "activation": chosen.activation, "clip": chosen.clip}
        manifest = dataclasses.replace(manifest, normalisation=self.normalisation, **network)
        return PolicyBundle(manifest, self._policy_weights(self.average or self.network))

    def start_from(self, policy: PolicyBundle) -> None:
        """Start with a policy's network and normalisation, and with new critics and exploration.

        The normalisation counts for as many observations as the policy has learned from, so that it changes no faster
        than in the policy's own training.

        Raises:
            ValueError: if the policy has another size.
        """
        here, there = self._policy_weights(self.network), policy.weights
        shapes = [{name: value.shape for name, value in weights.items()} for weights in (here, there)]
        known, chosen = policy.manifest, self.settings
        if shapes[0] != shapes[1] or known.activation != chosen.activation:
            raise ValueError(
                f"the initial policy has hidden layers {list(known.hidden)} ({known.activation}) and "
                f"{known.observation_size} observations, but this run has {list(chosen.hidden)} ({chosen.activation})"
                f" and {self.observation_size}; use the settings with which the policy was trained"
            )
        with torch.no_grad():
            for name, value in here.items():
                value.copy_(there[name])
        if self.average is not None:
            self.average.load_state_dict(self.network.state_dict())
        self.normaliser.assume(there["observation.mean"], there["observation.scale"], max(known.training.steps or 0, 1))

    def policy_network(self, initial_action: Tensor | None) -> PolicyNetwork:
        """The policy's network, before tanh."""
        chosen = self.settings
        return PolicyNetwork(
            self.observation_size,
            self.action_size,
            chosen.hidden,
            chosen.activation,
            initial_action,
            chosen.initial_std,
            chosen.largest_std,
        )

    def stochastic_actor(self) -> ProbabilisticActor:
        """The policy as TorchRL's losses expect it: normalised observations to squashed Gaussian actions."""
        return ProbabilisticActor(
            TensorDictModule(self.network, [NORMALISED], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
            return_log_prob=True,
        )

    def make_explorer(self) -> "Explorer":
        """See `explorer`."""
        return Explorer(self.normaliser, self.network, self.environments)

    def normalise(self, batch: TensorDictBase) -> TensorDictBase:
        """Add normalised observations to a batch of transitions, in place."""
        places: Any = (batch, batch["next"])
        for place in places:
            place[NORMALISED] = self.normaliser(self.critic_inputs(place))
        return batch

    def critic_inputs(self, place: TensorDictBase) -> Tensor:
        """Observations and privileged observations, ``[..., observation + privileged]``."""
        return torch.cat([place[name] for name in self.critic_keys], -1)

    def step(self, name: str, loss: Tensor) -> None:
        """One step of an optimiser, with the gradient of only its own parameters."""
        optimiser = self.optimisers[name]
        parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
        for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
            parameter.grad = gradient
        optimiser.step()

    def count_update(self) -> None:
        """Update the running average of the policy."""
        self.updates += 1
        if self.average is not None:
            approach(self.average, self.network, 1.0 - self.settings.averaging)

    def get_extra_state(self) -> dict[str, Any]:
        """State besides weights and buffers."""
        return {"updates": self.updates} | {name: one.state_dict() for name, one in self.optimisers.items()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """The inverse of `get_extra_state`."""
        self.updates = state["updates"]
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state[name])

    def _policy_weights(self, network: PolicyNetwork) -> dict[str, Tensor]:
        """The tensors of a bundle, as views of this policy's tensors."""
        weights: dict[str, Tensor] = {
            "observation.mean": self.normaliser.mean[: self.observation_size],
            "observation.scale": self.normaliser.scale[: self.observation_size],
        }
        layers = [layer for layer in network.mlp if isinstance(layer, nn.Linear)]
        for number, layer in enumerate(layers):
            rows = slice(self.action_size) if layer is layers[-1] else slice(None)
            weights |= {f"layer_{number}.weight": layer.weight[rows], f"layer_{number}.bias": layer.bias[rows]}
        return weights


class Explorer(TensorDictModuleBase):
    """A frozen copy of a policy with separate exploration, whose noise increases from the first to the last robot.

    Args:
        normaliser: normaliser of the policy.
        network: network of the policy.
        count: number of robots.
        scored: whether to store the log probability of actions, as ``action_log_prob``.
    """

    in_keys: Any = ["observation"]
    out_keys: Any = ["action"]

    def __init__(self, normaliser: Normaliser, network: PolicyNetwork, count: int, scored: bool = False):
        super().__init__()
        self._scored = scored
        self._sources = (normaliser, network)
        self._copies = nn.ModuleList(copy.deepcopy(self._sources)).requires_grad_(False)
        device = normaliser.mean.device
        self._rank = torch.linspace(0.0, 1.0, count, device=device)[:, None]
        self._noise_scale = torch.ones(count, 1, device=device)
        self.generator = torch.Generator(device)

    def follow(self, largest_noise: float = 1.0) -> None:
        """Copy the current policy.

        Args:
            largest_noise: multiple of the policy's standard deviation for the last robot; the first has 1, the others
                are evenly spaced in the logarithm.
        """
        for here, source in zip(self._copies, self._sources, strict=True):
            here.load_state_dict(source.state_dict())
        self._noise_scale = torch.exp(self._rank * math.log(largest_noise))

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Set ``action`` [env, action] for ``observation`` [env, observation]."""
        observation, (normaliser, network) = tensordict["observation"], self._copies
        mean, std = network(normaliser(observation.to(self._rank)))
        noise = torch.randn(mean.shape, generator=self.generator, device=mean.device)
        action = torch.tanh(mean + self._noise_scale * std * noise)
        if self._scored:
            tensordict["action_log_prob"] = TanhNormal(mean, std).log_prob(action).to(observation.device)
        return tensordict.set("action", action.to(observation.device))
