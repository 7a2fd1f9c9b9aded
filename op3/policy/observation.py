"""What a policy sees: functions of what a robot can sense, the same in simulation and on the robot."""

from __future__ import annotations

from itertools import accumulate, pairwise

import torch
from torch import Tensor

from op3.policy.leg_kinematics import leg_kinematics

BALANCE_LAYOUT: dict[str, int] = {
    "key_point_position": 18,
    "key_point_velocity": 18,
    "previous_action": 20,
    "orientation": 3,
    "angular_velocity": 3,
}
"""Parts of one observation and their widths, in order (paper, section "Action space, observation space")."""

WALK_LAYOUT: dict[str, int] = {**BALANCE_LAYOUT, "phase": 2}
"""The same for walking, which also sees the phase of the gait."""


def layout_slices(layout: dict[str, int]) -> dict[str, slice]:
    """Where each part of one observation lies on its last axis."""
    edges = pairwise(accumulate(layout.values(), initial=0))
    return {name: slice(first, last) for name, (first, last) in zip(layout, edges, strict=True)}


def observe(
    joint_position: Tensor,
    joint_velocity: Tensor,
    orientation: Tensor,
    angular_velocity: Tensor,
    previous_action: Tensor,
    phase: Tensor | None = None,
) -> Tensor:
    """One observation, without its history.

    Args:
        joint_position: measured, ``[..., joint]`` in rad, in the robot's order.
        joint_velocity: measured, ``[..., joint]`` in rad/s.
        orientation: roll, pitch and yaw of the trunk, ``[..., 3]`` in rad; yaw counts from where the episode began.
        angular_velocity: in the trunk's frame, ``[..., 3]`` in rad/s.
        previous_action: the policy's last action, ``[..., 20]`` in [-1, 1].
        phase: of the gait, ``[...]`` in cycles; None for balance.

    Returns:
        ``[..., 62]``, or ``[..., 64]`` with a phase, float64: parts as in `BALANCE_LAYOUT` or `WALK_LAYOUT`, SI units.
        Key points are relative to the trunk, in its frame.
    """
    position, velocity = leg_kinematics().key_points(joint_position.double(), joint_velocity.double())
    parts = [position.flatten(-2), velocity.flatten(-2), previous_action, orientation, angular_velocity]
    if phase is not None:
        parts.append(phase_signal(phase))
    return torch.cat([part.to(torch.float64) for part in parts], -1)


def phase_signal(phase: Tensor) -> Tensor:
    """Sine and cosine of a phase ``[...]`` in cycles, ``[..., 2]``: equal at the beginning and the end of a cycle."""
    angle = 2 * torch.pi * phase
    return torch.stack([torch.sin(angle), torch.cos(angle)], -1)


class History:
    """The latest observation followed by the ``length`` ones before it, newest first.

    At the start of an episode there are none before it, so the first one stands in for them.

    Args:
        length: number of earlier observations; paper, 1 for balance and 3 for walking.
    """

    def __init__(self, length: int):
        if length < 0:
            raise ValueError(f"history length must be at least 0, got {length}")
        self.length = length
        self._stack: Tensor | None = None

    def reset(self, observation: Tensor, rows: Tensor | None = None) -> Tensor:
        """Begin with this observation.

        Args:
            observation: ``[..., observation]``.
            rows: mask over the first axis of those that begin anew; None for all.

        Returns:
            ``[..., (length + 1) * observation]``.
        """
        filled = torch.stack([observation] * (self.length + 1), -2)
        if rows is not None and self._stack is not None:
            filled = torch.where(rows.view(-1, *[1] * (filled.ndim - 1)), filled, self._stack)
        self._stack = filled
        return filled.flatten(-2)

    def push(self, observation: Tensor) -> Tensor:
        """Add the latest observation and return ``[..., (length + 1) * observation]``.

        Raises:
            RuntimeError: if `reset` was not called before.
        """
        if self._stack is None:
            raise RuntimeError("a history begins with reset(observation)")
        self._stack = torch.cat([observation[..., None, :], self._stack[..., :-1, :]], -2)
        return self._stack.flatten(-2)
