"""Networks: normalisation of observations, a squashed Gaussian policy, Q functions and their ensemble."""

import functools
import math
import time
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

SMALLEST_STD, LARGEST_STD = math.exp(-5.0), 2.7
"""Bounds of a policy's standard deviation, before tanh."""

SMALLEST_SCALE = 0.01
"""Floor of the scale of an observation, in its unit: numbers that have hardly changed are not amplified."""

_LARGEST_INITIAL_ACTION = 0.97
_ACTIVATIONS = {"relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU, "tanh": nn.Tanh}


class Normaliser(nn.Module):
    """clip((observation - mean) / scale) with mean and standard deviation of the observations given to `update`.

    Calls do not change the statistics, and therefore evaluations do not either.

    Args:
        size: numbers in an observation.
        clip: bound of a normalised observation.
    """

    mean: Tensor
    scale: Tensor
    count: Tensor
    exact_mean: Tensor
    squares: Tensor

    def __init__(self, size: int, clip: float):
        super().__init__()
        self.clip = clip
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))
        self.register_buffer("count", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("exact_mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(size, dtype=torch.float64))

    @torch.no_grad()
    def update(self, observation: Tensor) -> None:
        """Include observations [..., observation], by merging moments (Chan et al. 1979)."""
        values = observation.reshape(-1, observation.shape[-1]).to(self.squares)
        total = self.count + len(values)
        mean = values.mean(0)
        difference = mean - self.exact_mean
        self.squares += (values - mean).square().sum(0) + difference.square() * self.count * len(values) / total
        self.exact_mean += difference * len(values) / total
        self.count.copy_(total)
        self.mean.copy_(self.exact_mean)
        self.scale.copy_((self.squares / total).sqrt().clamp(min=SMALLEST_SCALE))

    @torch.no_grad()
    def assume(self, mean: Tensor, scale: Tensor, count: int) -> None:
        """Set the state after `count` observations of this mean and scale; the last numbers may be missing."""
        width = len(mean)
        self.mean[:width] = mean
        self.scale[:width] = scale
        self.exact_mean[:width] = mean
        self.squares[:width] = scale.double().square() * count
        self.count[:width] = count

    def forward(self, observation: Tensor) -> Tensor:
        """Normalised observations [..., observation]; the last numbers may be missing."""
        width = observation.shape[-1]
        return ((observation - self.mean[:width]) / self.scale[:width]).clamp_(-self.clip, self.clip)


class PolicyNetwork(nn.Module):
    """Normalised observations to mean and standard deviation of the action before tanh.

    Args:
        observation_size: numbers in an observation; further inputs are ignored.
        action_size: numbers in an action.
        hidden: units of the hidden layers.
        activation: activation function of the hidden layers.
        initial_action: mean action [action] of the untrained policy for every observation; zeros if None.
        initial_std: standard deviation of the untrained policy before tanh.
        largest_std: bound of the standard deviation; None: it is constant.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        hidden: Sequence[int],
        activation: str = "relu",
        initial_action: Tensor | None = None,
        initial_std: float = 0.2,
        largest_std: float | None = LARGEST_STD,
    ):
        super().__init__()
        outputs = action_size if largest_std is None else 2 * action_size
        self.mlp = MLP(observation_size, outputs, num_cells=list(hidden), activation_class=_ACTIVATIONS[activation])
        self.observation_size, self.action_size = observation_size, action_size
        self._std, self._largest_std = initial_std, largest_std
        action = torch.zeros(action_size) if initial_action is None else torch.as_tensor(initial_action).float()
        last = self.mlp[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.weight.mul_(0.01)
            last.bias[:action_size] = action.clamp(-_LARGEST_INITIAL_ACTION, _LARGEST_INITIAL_ACTION).atanh()
            last.bias[action_size:] = math.log(initial_std)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation [..., action]."""
        values = self.mlp(observation[..., : self.observation_size])
        if self._largest_std is None:
            return values, torch.full_like(values, self._std)
        mean, log_std = values.chunk(2, -1)
        return mean, log_std.clamp(math.log(SMALLEST_STD), math.log(self._largest_std)).exp()


class QNetwork(nn.Module):
    """Value of an action.

    The first layer has separate weights for observation and action, so that a policy's gradient does not pass through
    the observation's weights.

    Args:
        observation_size: numbers in an observation.
        action_size: numbers in an action.
        hidden: units of the hidden layers, ReLU each.
        layer_norm: whether every hidden layer is normalised before its ReLU.
        bfloat16: whether matrices are multiplied in bfloat16; weights and values stay in float32.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        hidden: Sequence[int],
        layer_norm: bool = True,
        bfloat16: bool = False,
    ):
        super().__init__()
        self.in_bfloat16 = bfloat16
        self.observation = nn.Linear(observation_size, hidden[0])
        self.action = nn.Linear(action_size, hidden[0], bias=False)
        bound = (observation_size + action_size) ** -0.5  # as for a joint layer
        for values in (*self.observation.parameters(), *self.action.parameters()):
            nn.init.uniform_(values, -bound, bound)
        norms = [[nn.LayerNorm(units)] if layer_norm else [] for units in hidden]
        linears = [nn.Linear(*sizes) for sizes in zip(hidden, (*hidden[1:], 1), strict=True)]
        layers = [(*norm, nn.ReLU(inplace=True), linear) for norm, linear in zip(norms, linears, strict=True)]
        self.rest = nn.Sequential(*(module for layer in layers for module in layer))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Values [..., 1] of actions [..., action] on normalised observations [..., observation]."""
        with torch.autocast(observation.device.type, torch.bfloat16, enabled=self.in_bfloat16):
            value = self.rest(self.observation(observation) + self.action(action))
        return value.float()


class Ensemble(nn.Module):
    """An ensemble of Q functions with the same architecture.

    Args:
        members: Q functions.
    """

    def __init__(self, members: Sequence[QNetwork]):
        super().__init__()
        self.members = nn.ModuleList(members)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Values [member, ...]."""
        if self.members[0].in_bfloat16:  # converted once for all members
            observation, action = observation.bfloat16(), action.bfloat16()
        return torch.stack([member(observation, action).squeeze(-1) for member in self.members])


@torch.no_grad()
def approach(module: nn.Module, goal: nn.Module, share: float) -> None:
    """Move a module's parameters by a share towards those of another of the same architecture."""
    torch._foreach_lerp_([*module.parameters()], [*goal.parameters()], share)  # pyright: ignore


@functools.cache
def bfloat16_is_faster(device: torch.device) -> bool:
    """Whether bfloat16 is faster than float32 on a device, including conversions.

    On CPUs this is measured: one processor with avx512_bf16 is twice as fast in bfloat16, another half as fast.
    """
    if device.type != "cpu":
        return True

    def best(dtype: torch.dtype) -> float:
        first, second = (torch.ones(512, 256, dtype=dtype), torch.ones(256, 256, dtype=dtype))
        times = []
        for _ in range(8):
            began = time.perf_counter()
            torch.mm(first, second)
            times.append(time.perf_counter() - began)
        return min(times)

    return best(torch.float32) > 1.5 * best(torch.bfloat16)
