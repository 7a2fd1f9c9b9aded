"""Reward terms as functions of tensors (paper, eq. 8 and Table II; Siekmann et al. 2021, eq. 2).

Every term is at most 0, and the reward is 1 plus their weighted sum. Norms are Euclidean.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import ive
from torch import Tensor

from op3.robot import load_robot
from op3.robot.units import GRAVITY

STANCE_SHARE = 0.7
"""Share of the cycle in which a foot carries the robot; paper, 0.7:0.3."""

PHASE_CONCENTRATION = 20.0
"""Concentration of the von Mises distribution of a phase boundary; its standard deviation is 3.6 % of the cycle.

Siekmann et al. (2021) smooth the boundaries in this way; the paper gives no number.
"""

FOOT_OFFSETS = (0.0, 0.5)
"""Where in the cycle the left and the right foot are when the phase is 0: half a cycle apart."""

FORCE_SCALE = 100.0
"""Square of the force at which a foot counts as loaded [N^2], as Siekmann et al. (2021).

Half the OP3's weight is 17 N, which gives 1 - exp(-2.9) = 0.94, so the number serves without scaling.
"""


@dataclass(frozen=True)
class Coefficients:
    """Weights of the reward (paper, Table II).

    Attributes:
        bipedal: K_bipedal.
        command: K_cmd.
        smooth: K_smooth.
        forward: K_xd, steepness of the penalty on forward speed [s/m].
        sideways: K_yd, steepness of the penalty on sideways speed [s/m].
    """

    bipedal: float
    command: float
    smooth: float
    forward: float
    sideways: float


BALANCE = Coefficients(bipedal=0.0, command=0.6, smooth=0.1, forward=2.0, sideways=2.0)
"""Training of the balancing task."""

WALK = Coefficients(bipedal=0.4, command=0.3, smooth=0.1, forward=15.0, sideways=1.0)
"""Training of the walking task."""

EVALUATION = Coefficients(bipedal=0.0, command=0.6, smooth=0.1, forward=2.0, sideways=2.0)
"""R_eval, for both tasks."""


def _penalty(size: Tensor) -> Tensor:
    """``-(1 - exp(-size))``, in [-1, 0]."""
    return torch.expm1(-size)


def command_term(velocity: Tensor, desired: Tensor, orientation: Tensor, coefficients: Coefficients) -> Tensor:
    """R_cmd: how far the body is from the commanded velocity and from upright, in [-3, 0].

    Args:
        velocity: of the body forwards and sideways, ``[..., 2]`` in m/s.
        orientation: roll and pitch, more columns are ignored, ``[..., 2 | 3]`` in rad; level is desired.
    """
    error = (desired - velocity).abs()
    return (
        _penalty(coefficients.forward * error[..., 0])
        + _penalty(coefficients.sideways * error[..., 1])
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


def overload_term(current: Tensor) -> Tensor:
    """Currents that a servo cannot carry for long, in [-1, 0]; not in the paper.

    An episode is much shorter than the minute over which a robot averages currents before it limits them, so a policy
    that is to stand for longer must be told of it. Heat goes with the square of the current; half of what a servo
    carries for ever costs nothing.

    Args:
        current: of all motors, ``[..., joint]`` in A.
    """
    load = (current / load_robot().servos[0].continuous_current).square()
    return _penalty((load - 0.5).clamp(min=0.0).sum(-1))


def clearance_term(phase: Tensor, clearance: Tensor, height: float) -> Tensor:
    """How far feet that should swing are below a height above the other foot, in [-2, 0]; not in the paper.

    Args:
        phase: of the gait, ``[...]`` in cycles.
        clearance: of the left and the right foot, ``[..., 2]`` in m.
        height: from which nothing is lost [m].
    """
    offsets = torch.tensor(FOOT_OFFSETS, dtype=torch.float64)
    swing = swing_probability(phase.double()[..., None] + offsets)
    return -(swing * (1.0 - clearance / height).clamp(min=0.0)).sum(-1)


def _swing_series(terms: int = 24) -> tuple[Tensor, Tensor]:
    """Fourier coefficients of the smoothed swing indicator: those of the interval times those of von Mises."""
    n = np.arange(1, terms + 1)
    swing = 1.0 - STANCE_SHARE
    weight = 2.0 * np.sin(np.pi * n * swing) / (np.pi * n) * ive(n, PHASE_CONCENTRATION) / ive(0, PHASE_CONCENTRATION)
    return torch.from_numpy(weight), torch.from_numpy(2 * np.pi * n)


_WEIGHT, _FREQUENCY = _swing_series()


def swing_probability(phase: Tensor) -> Tensor:
    """How surely a foot is in swing at its phase [cycles]: 1 in the middle of [0, 0.3], 0 in the middle of [0.3, 1].

    The interval's boundaries are smoothed with a von Mises density, as its Fourier series.
    """
    swing = 1.0 - STANCE_SHARE
    angle = (phase - swing / 2).double()[..., None] * _FREQUENCY
    return (swing + (torch.cos(angle) * _WEIGHT).sum(-1)).clamp(0.0, 1.0)


def bipedal_term(phase: Tensor, foot_force: Tensor, foot_speed: Tensor) -> Tensor:
    """R_bipedal: force on a foot that should swing, speed of a foot that should stand, in [-2, 0].

    Siekmann et al. (2021), eq. (2): in swing C_frc = -1 and C_spd = 0, in stance C_frc = 0 and C_spd = -1.

    Args:
        phase: of the gait, ``[...]`` in cycles.
        foot_force: size of the force on the left and the right foot, ``[..., 2]`` in N.
        foot_speed: of the feet over the ground, ``[..., 2]`` in m/s.
    """
    offsets = torch.tensor(FOOT_OFFSETS, dtype=torch.float64)
    swing = swing_probability(phase.double()[..., None] + offsets)
    loaded = _penalty(foot_force.square() / FORCE_SCALE)
    moving = _penalty(2.0 * foot_speed.square())
    return (swing * loaded + (1.0 - swing) * moving).sum(-1)


def weighted(coefficients: Coefficients, command: Tensor, smooth: Tensor) -> dict[str, Tensor]:
    """Contributions to the reward by name; the reward is 1 plus their sum, see `total`."""
    return {"command": coefficients.command * command, "smooth": coefficients.smooth * smooth}


def total(terms: dict[str, Tensor]) -> Tensor:
    """Eq. (8): 1 plus the weighted terms."""
    return 1.0 + torch.stack(list(terms.values())).sum(0)


def body_acceleration(specific_force: Tensor, orientation: Tensor) -> Tensor:
    """Acceleration of the body without gravity, in its own frame, ``[..., 3]`` in m/s^2.

    Args:
        specific_force: what an accelerometer reads, +9.81 upwards at rest, ``[..., 3]`` in m/s^2.
        orientation: roll, pitch and yaw, ``[..., 3]`` in rad.
    """
    roll, pitch = orientation[..., 0], orientation[..., 1]
    up = torch.stack([-torch.sin(pitch), torch.sin(roll) * torch.cos(pitch), torch.cos(roll) * torch.cos(pitch)], -1)
    return specific_force - GRAVITY * up
