"""Terminations: functions of the state of many robots that return whether an episode has failed, ``[env]``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from op3.policy.actions import ActionMap
from op3.robot import Robot
from op3.robot.kinematics import home_height
from op3.robot.self_collision import LARGEST_OVERLAP_AHEAD, SelfCollision

if TYPE_CHECKING:
    from op3.tasks.state import State

__all__ = ["CommandedCollision", "Lag", "height", "tilt"]


def tilt(state: State, angle: float) -> Tensor:
    """The base rolls or pitches by more than an angle [rad]."""
    return state.orientation[:, :2].abs().amax(1) > angle


def height(state: State, robot: Robot, share: float) -> Tensor:
    """The base is lower above the ground than a share of its height in the home pose."""
    return state.base_height < share * home_height(robot)


class Lag:
    """The robot lags by more than a distance behind the position that a desired forward speed gives.

    Stepping in place earns the upright reward and is a local optimum; this termination removes it in training.

    Args:
        distance: largest lag [m].
        velocity: desired forward speed [m/s].
        name: name of a command whose direction and speed are desired instead; at a zero command no robot lags.
    """

    def __init__(
        self, num_envs: int, policy_period: float, distance: float, velocity: float = 0.3, name: str | None = None
    ):
        self.velocity, self.distance, self.name = velocity, distance, name
        self._period, self._behind = policy_period, torch.zeros(num_envs, dtype=torch.float64)

    def begin(self, rows: Tensor) -> None:
        """Begin the episodes of a mask of robots."""
        self._behind[rows] = 0.0

    def __call__(self, state: State) -> Tensor:
        """Whether each robot is too far behind, ``[env]``."""
        if self.name is None:
            shortfall = (self.velocity - state.base_velocity[:, 0]) * (1.0 if self.velocity >= 0 else -1.0)
        else:
            along, speed = state.along(self.name)
            shortfall = speed - along
            self._behind = torch.where(speed > 0.0, self._behind, 0.0)
        self._behind = (self._behind + self._period * shortfall).clamp(min=0.0)
        return self._behind > self.distance


class CommandedCollision:
    """The commanded angles make parts of the robot overlap, as in the check of `op3 deploy`.

    Args:
        overlap: largest allowed depth [m].
    """

    def __init__(self, robot: Robot, action_map: ActionMap, overlap: float = LARGEST_OVERLAP_AHEAD):
        self.overlap, self._action_map = overlap, action_map
        self._parts = SelfCollision(robot, margin=0.0)

    def __call__(self, state: State) -> Tensor:
        """Whether parts overlap, ``[env]``."""
        commands = self._action_map.commands(state.action)
        inputs = (state.joint_position, commands["position_target"], commands["p_gain"])
        position, target, p_gain = (values.cpu().numpy() for values in inputs)  # MuJoCo runs on the CPU
        rows = zip(position, target, p_gain, strict=True)
        return torch.tensor([self._parts.commanded(*row, self.overlap) is not None for row in rows])
