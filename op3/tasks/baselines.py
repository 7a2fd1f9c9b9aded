"""Policies without learning: what any trained one must beat."""

import torch
from torch import Tensor

from op3.policy import ActionMap


class Hold:
    """Holds the stand pose, stiffly by default.

    Args:
        p_gain: of every controlled joint [A/rad]; None: the highest, 6 A/rad.
        action_map: what actions mean.
    """

    def __init__(self, p_gain: float | None = None, action_map: ActionMap | None = None):
        self._action = torch.from_numpy((action_map or ActionMap.around_stand()).stand(p_gain))

    def act(self, observation: Tensor) -> Tensor:
        """The same action, whatever is seen: ``[..., action]``."""
        return self._action.to(observation).expand(*observation.shape[:-1], -1)


class Zero:
    """Action zero: the stand pose with gains in the middle of their range."""

    def __init__(self, action_map: ActionMap | None = None):
        self._size = (action_map or ActionMap.around_stand()).size

    def act(self, observation: Tensor) -> Tensor:
        """Zeros ``[..., action]``."""
        return observation.new_zeros(*observation.shape[:-1], self._size)


class Random:
    """Uniform actions.

    Args:
        seed: of the actions.
        action_map: what actions mean.
    """

    def __init__(self, seed: int = 0, action_map: ActionMap | None = None):
        self._size = (action_map or ActionMap.around_stand()).size
        self._generator = torch.Generator().manual_seed(seed)

    def act(self, observation: Tensor) -> Tensor:
        """Uniform in [-1, 1], ``[..., action]``."""
        shape = (*observation.shape[:-1], self._size)
        return 2.0 * torch.rand(shape, generator=self._generator, dtype=observation.dtype) - 1.0
