"""The heading that a robot under velocity commands should have: computed identically in simulation and on the robot."""

from math import pi

import torch
from torch import Tensor

LARGEST = 0.3
"""Largest difference between heading and reference [rad]; beyond it the reference follows, so that a robot that was
turned by hand or lags behind a command does not turn back.
"""


def wrapped(angle: Tensor) -> Tensor:
    """An angle wrapped to [-pi, pi) [rad]."""
    return torch.remainder(angle + pi, 2 * pi) - pi


class HeadingReference:
    """Integrates commanded turning rates, limited to a range around the measured heading.

    Args:
        count: number of robots.
    """

    def __init__(self, count: int):
        self.heading = torch.zeros(count, dtype=torch.float64)

    def begin(self, rows: Tensor, yaw: Tensor) -> None:
        """Begin the episodes of a mask of robots ``[robot]`` at their measured yaw, ``[robot]`` in rad."""
        self.heading = torch.where(rows, yaw, self.heading)

    def step(self, yaw: Tensor, rate: Tensor, period: float) -> Tensor:
        """Advance by one policy step.

        Args:
            yaw: measured heading, ``[robot]`` in rad.
            rate: commanded turning rate in the step, ``[robot]`` in rad/s.
            period: period of the step [s].

        Returns:
            The reference, ``[robot]`` in rad.
        """
        ahead = wrapped(self.heading + period * rate - yaw).clamp(-LARGEST, LARGEST)
        self.heading = yaw + ahead
        return self.heading
