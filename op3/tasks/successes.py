"""Success terms: functions of the state of many robots that return whether each has reached its goal, ``[env]``.

An episode succeeds if it does not fail and all these terms hold at its last step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from op3.tasks.state import State

__all__ = ["Travelled", "at_target"]


class Travelled:
    """The base has moved forward in the world by at least a distance since its episode began.

    Args:
        distance: smallest distance [m].
    """

    def __init__(self, num_envs: int, distance: float):
        self.distance = distance
        self._new = torch.ones(num_envs, dtype=torch.bool)
        self._start = torch.zeros(num_envs, dtype=torch.float64)

    def begin(self, rows: Tensor) -> None:
        """Begin the episodes of a mask of robots."""
        self._new |= rows

    def __call__(self, state: State) -> Tensor:
        """Whether each robot has moved this far, ``[env]``; the first step of an episode counts as its start."""
        place = state.snapshot.place[:, 0]
        self._start = torch.where(self._new, place, self._start)
        self._new = torch.zeros_like(self._new)
        return place - self._start >= self.distance


def at_target(state: State, distance: float, name: str = "target") -> Tensor:
    """The tip of an arm is within a distance of its target.

    Args:
        distance: largest distance [m].
        name: name of the command, a position relative to the base [m].
    """
    return torch.linalg.vector_norm(state.tip_position - state.commands[name], dim=-1) <= distance
