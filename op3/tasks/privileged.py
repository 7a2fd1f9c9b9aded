"""Privileged observations: values that exist only in simulation, for critics.

Asymmetric actor-critic (Pinto et al. 2017): a policy can only use sensors, while the critics that train it may use
more. A term is a function or class of the state that returns ``[env, number]``; its attribute ``mirror`` has the sign
of each number's mirror image in the robot's plane of symmetry. A class has memory and returns 0 when an episode begins.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from op3.tasks.state import State

__all__ = ["VelocityError", "base_height", "heading_velocity"]


def mirrored(*signs: float) -> Callable[[Any], Any]:
    """Set the signs of a term's mirror image, one for each of its numbers."""

    def marked(term: Any) -> Any:
        term.mirror = signs
        return term

    return marked


@mirrored(1.0, -1.0, -1.0)
def heading_velocity(state: State) -> Tensor:
    """Forwards and to the left of the base's heading [m/s], and its rate of turning [rad/s]."""
    return state.heading_velocity


@mirrored(1.0)
def base_height(state: State) -> Tensor:
    """Height of the base's origin above the ground [m]."""
    return state.base_height[:, None]


@mirrored(1.0, -1.0, -1.0)
class VelocityError:
    """Velocity minus the commanded velocity [m/s, m/s, rad/s], averaged over a stride.

    Args:
        time_constant: time constant of the average [s].
        name: name of the command.
    """

    def __init__(self, num_envs: int, policy_period: float, time_constant: float = 0.5, name: str = "velocity"):
        self.name = name
        self._keep = float(np.exp(-policy_period / time_constant))
        self._error = torch.zeros(num_envs, 3, dtype=torch.float64)

    def begin(self, rows: Tensor) -> None:
        """Begin the episodes of a mask of robots."""
        self._error[rows] = 0.0

    def __call__(self, state: State) -> Tensor:
        """The average, ``[env, 3]``."""
        error = state.heading_velocity - state.commands[self.name]
        self._error = self._keep * self._error + (1.0 - self._keep) * error
        return self._error
