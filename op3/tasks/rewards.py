"""Reward terms: functions of the state of many robots that return ``[env]``; a task gives each a weight.

``alive``, ``command``, ``smooth`` and ``bipedal`` are the reward of the paper (eq. 8 and Table II; Siekmann et al.
2021, eq. 2); the others are op3's. Norms are Euclidean. The formulae are separate functions of tensors, which the
evaluation of a log also uses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.special import ive
from torch import Tensor

from op3.policy.heading import wrapped
from op3.robot import Robot
from op3.robot.register_units import GRAVITY
from op3.tasks.privileged import VelocityError

if TYPE_CHECKING:
    from op3.tasks.state import State

__all__ = [
    "TrackVelocity",
    "action_rate",
    "alive",
    "bipedal",
    "clearance",
    "command",
    "distance_to_target",
    "heading",
    "overload",
    "planted",
    "self_contact",
    "smooth",
    "speed_bonus",
    "upright",
]

STANCE_SHARE = 0.7
"""Share of the cycle in which a foot carries the robot; paper, 0.7:0.3."""

PHASE_CONCENTRATION = 20.0
"""Concentration of the von Mises distribution of a phase boundary; its standard deviation is 3.6 % of the cycle.

Siekmann et al. (2021) smooth the boundaries in this way; the paper gives no number.
"""

FOOT_OFFSETS = {2: (0.0, 0.5), 4: (0.0, 0.5, 0.5, 0.0)}
"""Phase of each foot in the cycle when the phase of the gait is 0, by the number of feet: two half a cycle apart; four
in diagonal pairs (a trot), where the file names both front feet and then both hind feet."""

LOADED_SHARE = 0.648
"""Force above which a foot counts as loaded, as a share of the weight that it carries when all feet stand.

Siekmann et al. (2021) use 10 N, which is this share of 15.4 N, half the weight of the OP3.
"""


def _penalty(size: Tensor) -> Tensor:
    """``-(1 - exp(-size))``, in [-1, 0]."""
    return torch.expm1(-size)


def command_term(velocity: Tensor, desired: Tensor, orientation: Tensor, forward: float, sideways: float) -> Tensor:
    """R_cmd: penalty on the deviation from the commanded velocity and from upright, in [-3, 0].

    Args:
        velocity: velocity of the body forwards and sideways, ``[..., 2]`` in m/s.
        forward: K_xd, steepness of the penalty on forward speed [s/m].
        sideways: K_yd, steepness of the penalty on sideways speed [s/m].
        orientation: roll and pitch, ``[..., 2 | 3]`` in rad; further columns are ignored, and level is desired.
    """
    error = (desired - velocity).abs()
    return (
        _penalty(forward * error[..., 0])
        + _penalty(sideways * error[..., 1])
        + _penalty(4.0 * torch.linalg.vector_norm(orientation[..., :2], dim=-1))
    )


def norm(values: Tensor) -> Tensor:
    """Euclidean norm over the last axis."""
    return torch.linalg.vector_norm(values, dim=-1)


def smooth_term(action_change: Tensor, current: Tensor, motion: Tensor) -> Tensor:
    """R_smt: changes of the action, motor currents, and motion of the body, in [-3, 0].

    Args:
        action_change: norm of a_t - a_(t-1), both scaled to [-1, 1], ``[...]``.
        current: norm of the currents of all motors, ``[...]`` in A.
        motion: norm of the body's angular velocity [rad/s] plus that of its acceleration without gravity [m/s^2],
            ``[...]``.
    """
    return _penalty(0.1 * action_change) + _penalty(0.5 * current) + _penalty(0.1 * motion)


def _swing_series(terms: int = 24) -> tuple[Tensor, Tensor]:
    """Fourier coefficients of the smoothed swing indicator, those of the interval times those of von Mises."""
    n = np.arange(1, terms + 1)
    swing = 1.0 - STANCE_SHARE
    weight = 2.0 * np.sin(np.pi * n * swing) / (np.pi * n) * ive(n, PHASE_CONCENTRATION) / ive(0, PHASE_CONCENTRATION)
    return torch.from_numpy(weight), torch.from_numpy(2 * np.pi * n)


_WEIGHT, _FREQUENCY = _swing_series()


def swing_probability(phase: Tensor) -> Tensor:
    """Probability that a foot is in swing at its phase [cycles]: 1 in the middle of [0, 0.3], 0 in the middle of [0.3,
    1].

    The interval's boundaries are smoothed with a von Mises density, computed as a Fourier series.
    """
    swing = 1.0 - STANCE_SHARE
    angle = (phase - swing / 2).double()[..., None] * _FREQUENCY.to(phase.device)
    return (swing + (torch.cos(angle) * _WEIGHT.to(phase.device)).sum(-1)).clamp(0.0, 1.0)


def swing_of_feet(phase: Tensor, feet: int = 2) -> Tensor:
    """Probability that each foot is in swing, ``[..., foot]``.

    Args:
        phase: phase of the gait, ``[...]`` in cycles.
        feet: number of feet, a key of `FOOT_OFFSETS`.
    """
    return swing_probability(phase.double()[..., None] + torch.tensor(FOOT_OFFSETS[feet], dtype=torch.float64))


def loaded_force(robot: Robot) -> float:
    """Force above which one of the robot's feet counts as loaded [N]."""
    return LOADED_SHARE * float(robot.bare_model.body_mass.sum()) * GRAVITY / len(robot.file.feet)


def bipedal_term(swing: Tensor, foot_force: Tensor, foot_speed: Tensor, loaded: float) -> Tensor:
    """R_bipedal: force on a foot that should swing, speed of a foot that should stand, in [-2, 0].

    Siekmann et al. (2021), eq. (2): in swing C_frc = -1 and C_spd = 0, in stance C_frc = 0 and C_spd = -1.

    Args:
        swing: probability that each foot is in swing, ``[..., foot]``.
        foot_force: size of the force on each foot, ``[..., foot]`` in N.
        foot_speed: speed of the feet over the ground, ``[..., foot]`` in m/s.
        loaded: force at which a foot counts as loaded [N].
    """
    # twice the mean equals the sum for two feet and gives the same weight to a gait with four
    loading = _penalty((foot_force / loaded).square())
    moving = _penalty(2.0 * foot_speed.square())
    return 2.0 * (swing * loading + (1.0 - swing) * moving).mean(-1)


def body_acceleration(specific_force: Tensor, orientation: Tensor) -> Tensor:
    """Acceleration of the body without gravity, in its own frame, ``[..., 3]`` in m/s^2.

    Args:
        specific_force: accelerometer reading, +9.81 upwards at rest, ``[..., 3]`` in m/s^2.
        orientation: roll, pitch and yaw, ``[..., 3]`` in rad.
    """
    roll, pitch = orientation[..., 0], orientation[..., 1]
    up = torch.stack([-torch.sin(pitch), torch.sin(roll) * torch.cos(pitch), torch.cos(roll) * torch.cos(pitch)], -1)
    return specific_force - GRAVITY * up


def alive(state: State) -> Tensor:
    """The constant 1 of eq. (8), earned in every step without a fall."""
    return torch.ones_like(state.time)


def command(
    state: State, forward: float, sideways: float, velocity: Sequence[float] = (0.0, 0.0), name: str | None = None
) -> Tensor:
    """R_cmd of the paper, in [-3, 0].

    Args:
        forward: K_xd, steepness of the penalty on forward speed [s/m].
        sideways: K_yd, steepness of the penalty on sideways speed [s/m].
        velocity: desired velocity, forwards and to the left in the world [m/s].
        name: name of a command that is desired instead, in the robot's heading frame.
    """
    if name is None:
        desired, actual = torch.tensor(velocity, dtype=torch.float64), state.base_velocity
    else:
        desired, actual = state.commands[name][:, :2], state.heading_velocity
    return command_term(actual[:, :2], desired, state.orientation, forward, sideways)


def smooth(state: State) -> Tensor:
    """R_smt of the paper: changes of the action, motor currents, and motion of the body, in [-3, 0]."""
    motion = state.step.angular_velocity + state.step.acceleration
    return smooth_term(norm(state.action - state.previous_action), state.step.current, motion)


def bipedal(state: State, robot: Robot, name: str | None = None) -> Tensor:
    """R_bipedal of the paper, for two or four feet.

    Args:
        name: name of a command; all feet should stand while it is zero. None: the gait never stops.
    """
    return bipedal_term(_swing(state, name), state.step.foot_force, state.step.foot_speed, loaded_force(robot))


def clearance(state: State, height: float = 0.02, name: str | None = None) -> Tensor:
    """Penalty on swinging feet below a height above the lowest foot: twice the mean relative shortfall, in [-2, 0].

    Args:
        height: clearance from which the penalty is zero [m].
        name: name of a command, as for `bipedal`.
    """
    low = (1.0 - state.step.foot_clearance / height).clamp(min=0.0)
    return -2.0 * (_swing(state, name) * low).mean(-1)


def planted(state: State, height: float = 0.02, name: str | None = None) -> Tensor:
    """Penalty on raised heels and toes of standing feet: twice their mean relative height, in [-2, 0].

    Args:
        height: height of a foot's highest key point at which the penalty reaches its maximum [m].
        name: name of a command, as for `bipedal`.
    """
    high = (state.step.foot_rise / height).clamp(max=1.0)
    return -2.0 * ((1.0 - _swing(state, name)) * high).mean(-1)


def _swing(state: State, name: str | None) -> Tensor:
    feet = state.step.foot_force.shape[-1]
    if feet not in FOOT_OFFSETS:
        raise ValueError(f"a gait needs two or four feet, got {feet} feet")
    swing = swing_of_feet(state.phase, feet)
    return swing if name is None else swing * state.commands[name].ne(0.0).any(-1, keepdim=True)


def self_contact(state: State) -> Tensor:
    """Penalty on self-contact: minus the share of the step in which the robot touches itself."""
    return -state.step.self_contact


def overload(state: State, robot: Robot) -> Tensor:
    """Penalty on currents above the continuous rating of a servo, in [-1, 0].

    An episode is much shorter than the minute over which a robot averages currents before it limits them, so a policy
    that must stand for longer needs this penalty. Heat is proportional to the squared current; up to half of a servo's
    continuous current is free.
    """
    continuous = torch.tensor([servo.continuous_current for servo in robot.servos], dtype=torch.float64)
    load = (state.joint_current / continuous).square()
    return _penalty((load - 0.5).clamp(min=0.0).sum(-1))


def speed_bonus(state: State, velocity: float = 0.3, name: str | None = None) -> Tensor:
    """Forward speed up to a desired one [m/s]; standing still is a local optimum of the paper's reward.

    Args:
        velocity: desired forward velocity in the world [m/s].
        name: name of a command whose direction and speed are desired instead.
    """
    if name is None:
        return state.base_velocity[:, 0].clamp(-abs(velocity), abs(velocity))
    along, speed = state.along(name)
    return along.clamp(-speed, speed)


class TrackVelocity:
    """Penalty on the velocity error, in [-3, 0], averaged over a stride because a body sways as it walks.

    Args:
        forward: steepness of the penalty on forward speed [s/m].
        sideways: steepness of the penalty on sideways speed [s/m].
        turning: steepness of the penalty on the rate of turning [s/rad].
        time_constant: time constant of the average [s].
        name: name of the command.
    """

    def __init__(
        self,
        num_envs: int,
        policy_period: float,
        forward: float = 10.0,
        sideways: float = 10.0,
        turning: float = 3.0,
        time_constant: float = 0.5,
        name: str = "velocity",
    ):
        self.forward, self.sideways, self.turning = forward, sideways, turning
        self._error = VelocityError(num_envs, policy_period, time_constant, name)

    def begin(self, rows: Tensor) -> None:
        """Begin the episodes of a mask of robots."""
        self._error.begin(rows)

    def __call__(self, state: State) -> Tensor:
        """The term, ``[env]``."""
        steepness = torch.tensor([self.forward, self.sideways, self.turning], dtype=torch.float64)
        return _penalty(steepness * self._error(state).abs()).sum(-1)


def heading(state: State, steepness: float = 4.0) -> Tensor:
    """Penalty on the difference between the robot's heading and the commanded heading, in [-1, 0].

    Args:
        steepness: steepness of the penalty [1/rad].
    """
    return _penalty(steepness * wrapped(state.orientation[:, 2] - state.commands["heading"][:, 0]).abs())


def upright(state: State) -> Tensor:
    """Penalty on roll and pitch of the base, in [-1, 0]."""
    return _penalty(4.0 * norm(state.orientation[:, :2]))


def distance_to_target(state: State, name: str = "target", scale: float = 0.1) -> Tensor:
    """Penalty on the distance of an arm's tip from its commanded position, in [-1, 0].

    Args:
        name: name of the command, a position relative to the base [m].
        scale: distance at which 63 % of the penalty is reached [m].
    """
    return _penalty(norm(state.tip_position - state.commands[name]) / scale)


def action_rate(state: State) -> Tensor:
    """Penalty on changes of the action, in [-1, 0]."""
    return _penalty(0.1 * norm(state.action - state.previous_action))
