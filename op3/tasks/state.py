"""The state of many robots after a policy step, which is the input of terms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from op3.tasks.snapshot import Snapshot, rotation
from op3.tasks.whole_step import StepStatistics


@dataclass(frozen=True, eq=False)
class State:
    """Many robots, float64 tensors ``[env, ...]``; channels of the log keep their names and units.

    Attributes:
        snapshot: the robots at the end of the step.
        step: means and peaks over the step; with ``whole_step: false`` in the task, values at its end.
        action: taken in the step, ``[env, action]`` in [-1, 1].
        previous_action: action of the previous step.
        time: time since each episode began [s], ``[env]``.
        phase: phase of the gait in cycles, ``[env]``; zeros for a task without a gait.
        commands: current commands by name, ``[env, number]``.
    """

    snapshot: Snapshot
    step: StepStatistics
    action: Tensor
    previous_action: Tensor
    time: Tensor
    phase: Tensor
    commands: Mapping[str, Tensor]

    @property
    def joint_position(self) -> Tensor:
        """Measured joint angles, ``[env, joint]`` in rad."""
        return self.snapshot.readings["joint_position"]

    @property
    def joint_velocity(self) -> Tensor:
        """Measured joint velocities, ``[env, joint]`` in rad/s."""
        return self.snapshot.readings["joint_velocity"]

    @property
    def joint_current(self) -> Tensor:
        """Measured motor currents, ``[env, joint]`` in A."""
        return self.snapshot.current

    @property
    def orientation(self) -> Tensor:
        """Roll, pitch and yaw of the base, ``[env, 3]`` in rad."""
        return self.snapshot.readings["orientation"]

    @property
    def angular_velocity(self) -> Tensor:
        """Angular velocity of the base in its frame, ``[env, 3]`` in rad/s."""
        return self.snapshot.readings["angular_velocity"]

    @property
    def linear_acceleration(self) -> Tensor:
        """Specific force of the IMU in its frame, +g upwards at rest, ``[env, 3]`` in m/s^2."""
        return self.snapshot.specific_force

    @property
    def base_height(self) -> Tensor:
        """Height of the base's origin above the ground's, ``[env]`` in m."""
        return self.snapshot.height

    @property
    def base_velocity(self) -> Tensor:
        """Velocity of the base in the world, ``[env, 3]`` in m/s."""
        return self.snapshot.velocity

    @property
    def heading_velocity(self) -> Tensor:
        """Forwards and to the left of the base's heading [m/s], and its rate of turning [rad/s], ``[env, 3]``."""
        yaw = self.orientation[:, 2]
        cosine, sine = torch.cos(yaw), torch.sin(yaw)
        x, y = self.base_velocity[:, 0], self.base_velocity[:, 1]
        upwards = rotation(self.snapshot.quaternion)[:, 2]
        return torch.stack([cosine * x + sine * y, cosine * y - sine * x, (upwards * self.angular_velocity).sum(1)], -1)

    def along(self, command: str) -> tuple[Tensor, Tensor]:
        """Speed along a commanded velocity, and the commanded speed, ``[env]`` in m/s."""
        asked = self.commands[command][:, :2]
        speed = torch.linalg.vector_norm(asked, dim=1)
        return (self.heading_velocity[:, :2] * asked).sum(1) / speed.clamp(min=1e-9), speed

    @property
    def tip_position(self) -> Tensor:
        """Position of an arm's tip relative to its base, in the base's frame, ``[env, 3]`` in m."""
        if self.snapshot.tip_position is None:
            raise ValueError("the robot file has no tip; add tip: <site at the end of the arm>")
        return self.snapshot.tip_position
