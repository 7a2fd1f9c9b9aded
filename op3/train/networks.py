"""Networks of soft actor-critic: a Gaussian policy squashed by tanh, and two critics evaluated as one."""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

SMALLEST_STD, LARGEST_STD = math.exp(-5.0), 2.7
"""Bounds of the policy's standard deviation, before tanh."""

_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)
_LARGEST_INITIAL_ACTION = 0.97


def uniform(shape: Sequence[int], inputs: int, generator: torch.Generator) -> nn.Parameter:
    """Weights uniform within 1/sqrt(inputs), as `torch.nn.Linear` draws them, from an explicit generator."""
    bound = inputs**-0.5
    return nn.Parameter((2.0 * torch.rand(tuple(shape), generator=generator) - 1.0) * bound)


class Actor(nn.Module):
    """A policy: observations to the mean and logarithmic standard deviation of the action before tanh.

    Args:
        observation_size: numbers in an observation.
        action_size: numbers in an action.
        hidden: units of the hidden layers, ReLU each.
        generator: of the initial weights.
        initial_action: mean action [action] of the untrained policy; zeros where None.
        initial_std: standard deviation of the untrained policy before tanh.
        largest_std: bound of it, before tanh.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        hidden: Sequence[int],
        generator: torch.Generator,
        initial_action: Tensor | None = None,
        initial_std: float = 0.2,
        largest_std: float = LARGEST_STD,
    ):
        super().__init__()
        self.action_size = action_size
        self._log_std_range = math.log(SMALLEST_STD), math.log(largest_std)
        sizes = (observation_size, *hidden, 2 * action_size)
        self.weights = nn.ParameterList([uniform((o, i), i, generator) for i, o in pairwise(sizes)])
        self.biases = nn.ParameterList([uniform((o,), i, generator) for i, o in pairwise(sizes)])
        action = torch.zeros(action_size) if initial_action is None else torch.as_tensor(initial_action).float()
        with torch.no_grad():
            # a small last layer, so that the untrained policy is the initial action whatever it sees
            self.weights[-1].mul_(0.01)
            action = action.clamp(-_LARGEST_INITIAL_ACTION, _LARGEST_INITIAL_ACTION)
            self.biases[-1][:action_size] = torch.atanh(action)
            self.biases[-1][action_size:] = math.log(initial_std)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation [batch, action] before tanh for normalised observations."""
        values = observation
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            values = functional.relu(functional.linear(values, weight, bias))
        values = functional.linear(values, self.weights[-1], self.biases[-1])
        mean, log_std = values[..., : self.action_size], values[..., self.action_size :]
        return mean, log_std.clamp(*self._log_std_range)

    def sample(self, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions and their log-probability.

        Args:
            observation: [batch, observation], normalised.
            noise: [batch, action], standard normal.

        Returns:
            action [batch, action] in (-1, 1) and log_prob [batch].
        """
        mean, log_std = self(observation)
        raw = mean + log_std.exp() * noise
        # log N(raw) - log d tanh/d raw in one pass, with 1 - tanh(x)^2 = 4 / (e^x + e^-x)^2
        jacobian = 2.0 * (math.log(2.0) - raw - functional.softplus(-2.0 * raw))
        log_prob = (-0.5 * noise.square() - log_std - jacobian - _HALF_LOG_TWO_PI).sum(-1)
        return torch.tanh(raw), log_prob


class TwinCritics(nn.Module):
    """Two Q functions of the same shape, evaluated by one batched matrix product per layer.

    Args:
        observation_size: numbers in an observation.
        action_size: numbers in an action.
        hidden: units of the hidden layers, ReLU each.
        generator: of the initial weights.
        layer_norm: whether every hidden layer is normalised before its ReLU.
        dtype: of the matrix products; weights and results stay in float32.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        hidden: Sequence[int],
        generator: torch.Generator,
        layer_norm: bool = True,
        dtype: torch.dtype = torch.float32,
    ):
        super().__init__()
        self.dtype = dtype
        sizes = (observation_size + action_size, *hidden, 1)
        self.weights = nn.ParameterList([uniform((2, i, o), i, generator) for i, o in pairwise(sizes)])
        self.biases = nn.ParameterList([uniform((2, 1, o), i, generator) for i, o in pairwise(sizes)])
        scales = [nn.Parameter(torch.ones(2, 1, units)) for units in hidden] if layer_norm else []
        shifts = [nn.Parameter(torch.zeros(2, 1, units)) for units in hidden] if layer_norm else []
        self.scales, self.shifts = nn.ParameterList(scales), nn.ParameterList(shifts)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Q values [critic, batch] for normalised observations [batch, observation] and actions [batch, action]."""
        dtype = self.dtype
        values = torch.cat([observation, action], -1).to(dtype).expand(2, -1, -1)
        for number in range(len(self.weights) - 1):
            values = torch.baddbmm(self.biases[number].to(dtype), values, self.weights[number].to(dtype))
            if len(self.scales):
                values = functional.layer_norm(values, values.shape[-1:])
                values = torch.addcmul(self.shifts[number].to(dtype), values, self.scales[number].to(dtype))
            values = functional.relu(values)
        values = torch.baddbmm(self.biases[-1].to(dtype), values, self.weights[-1].to(dtype))
        return values.squeeze(-1).float()
