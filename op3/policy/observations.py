"""Observation terms: functions of a robot's sensor readings, used in simulation and on the robot.

Each takes a `Sensed` and its own parameters and returns ``[..., number]`` in SI units. A parameter called ``robot``
receives the robot. Functions of your own package work too, if the task names them by ``function``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from op3.policy.forward_kinematics import leg_kinematics, tip_kinematics
from op3.policy.heading import wrapped
from op3.robot import Robot

__all__ = [
    "angular_velocity",
    "command",
    "heading_error",
    "joint_position",
    "joint_velocity",
    "key_point_position",
    "key_point_velocity",
    "orientation",
    "phase",
    "previous_action",
    "tip_position",
]


@dataclass(frozen=True, eq=False)
class Sensed:
    """Values that a robot's computer has at a policy step, float64 tensors ``[..., number]``.

    Attributes:
        joint_position: measured joint angles, ``[..., joint]`` in rad, in the robot's order.
        joint_velocity: measured joint velocities, ``[..., joint]`` in rad/s.
        previous_action: the policy's last action, ``[..., action]`` in [-1, 1].
        orientation: roll, pitch and yaw of the base, ``[..., 3]`` in rad; yaw is relative to the beginning of the
            episode. None without an IMU.
        angular_velocity: angular velocity in the base's frame, ``[..., 3]`` in rad/s; None without an IMU.
        phase: phase of the gait, ``[...]`` in cycles; None for a task without a gait.
        commands: commands by name, ``[..., number]``.
    """

    joint_position: Tensor
    joint_velocity: Tensor
    previous_action: Tensor
    orientation: Tensor | None = None
    angular_velocity: Tensor | None = None
    phase: Tensor | None = None
    commands: Mapping[str, Tensor] = field(default_factory=dict)
    _computed: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict, init=False, repr=False)

    def key_points(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Position [m] and velocity [m/s] of the key points of the soles relative to the base, in its frame."""
        if robot.name not in self._computed:
            legs = leg_kinematics(robot, self.joint_position.device)
            self._computed[robot.name] = legs.key_points(self.joint_position.double(), self.joint_velocity.double())
        return self._computed[robot.name]


def key_point_position(sensed: Sensed, robot: Robot) -> Tensor:
    """Key points of the soles relative to the base, in its frame [m], ``[..., 3 key point]``."""
    return sensed.key_points(robot)[0].flatten(-2)


def key_point_velocity(sensed: Sensed, robot: Robot) -> Tensor:
    """Velocity of the key points relative to the base [m/s], ``[..., 3 key point]``."""
    return sensed.key_points(robot)[1].flatten(-2)


def joint_position(sensed: Sensed, robot: Robot) -> Tensor:
    """Joint angles relative to the home pose [rad]."""
    return sensed.joint_position - torch.from_numpy(robot.home).to(sensed.joint_position)


def tip_position(sensed: Sensed, robot: Robot) -> Tensor:
    """Position of the tip of an arm relative to its base, from its joint angles [m]."""
    return tip_kinematics(robot, sensed.joint_position.device).position(sensed.joint_position.double())


def joint_velocity(sensed: Sensed) -> Tensor:
    """Joint velocities [rad/s]."""
    return sensed.joint_velocity


def previous_action(sensed: Sensed) -> Tensor:
    """The last action, in [-1, 1]."""
    return sensed.previous_action


def orientation(sensed: Sensed, yaw: bool = True) -> Tensor:
    """Roll, pitch and, unless omitted, yaw of the base [rad]."""
    return _of_imu(sensed.orientation)[..., : 3 if yaw else 2]


def angular_velocity(sensed: Sensed) -> Tensor:
    """Angular velocity of the base in its frame [rad/s]."""
    return _of_imu(sensed.angular_velocity)


def phase(sensed: Sensed, command: str | None = None) -> Tensor:
    """Sine and cosine of the gait's phase, equal at the beginning and the end of a cycle.

    Args:
        command: name of a command; while it is zero, the robot stands and both numbers are 0. None: it always walks.
    """
    if sensed.phase is None:
        raise ValueError("the task has no gait")
    angle = 2 * torch.pi * sensed.phase
    signal = torch.stack([torch.sin(angle), torch.cos(angle)], -1)
    return signal if command is None else signal * sensed.commands[command].ne(0.0).any(-1, keepdim=True)


def command(sensed: Sensed, name: str = "velocity") -> Tensor:
    """A command by its name in the task."""
    return _asked(sensed, name)


def heading_error(sensed: Sensed) -> Tensor:
    """Measured heading minus the heading of the commanded velocity [rad]."""
    reference = _asked(sensed, "heading")
    return wrapped(_of_imu(sensed.orientation)[..., 2:] - reference)


def _asked(sensed: Sensed, name: str) -> Tensor:
    if name not in sensed.commands:
        raise ValueError(f"the task has no command {name!r}; it has {', '.join(sensed.commands) or 'none'}")
    return sensed.commands[name]


def _of_imu(values: Tensor | None) -> Tensor:
    if values is None:
        raise ValueError("the robot has no IMU")
    return values
