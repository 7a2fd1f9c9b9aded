"""What the servo's sensors say that is not so."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, exp, pi, sin
from typing import ClassVar, Literal

from op3.servo.effect import Effect, Parameter, Scope, Stage, register
from op3.servo.law import lags_per_step

BENT = 0
"""Place of a velocity that bends with the angle in its list."""


@register
@dataclass(frozen=True)
class EncoderOffset(Effect):
    """The encoder's zero is not the joint's zero."""

    name: ClassVar[str] = "encoder_offset"
    stage: ClassVar[Stage] = Stage.SENSING
    equation: ClassVar[str] = "q_measured = q + b"
    source: ClassVar[str] = "homing of a servo horn; Rhoban's servo bench fits -0.126 rad on its STS3032"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("encoder_offset", "rad", -0.2, 0.2, 0.0, 0.0, "reading at the joint's true zero"),
    )
    size: ClassVar[str] = "encoder_offset"
    smallest: ClassVar[float] = 0.003
    secants: ClassVar[tuple[Mapping[str, float], ...]] = ({"encoder_offset": 0.01},)
    fingerprint: ClassVar[str] = (
        "a constant angle: gravity of the links acts in another phase; foot pose and IMU disagree with the joint angles"
    )
    confounders: ClassVar[tuple[str, ...]] = (
        "link_com",
        "com_offset",
        "cable_spring",
        "current_offset",
        "encoder_nonlinearity",
    )
    separating_experiment: ClassVar[str] = (
        "turn the base: gravity terms turn with it; compare the IMU with forward kinematics"
    )
    alias_class: ClassVar[str] = "gravity_phase"
    scopes: ClassVar[tuple[Scope, ...]] = ("joint", "shared", "side")

    @staticmethod
    def sense(s, p):
        """Shift the reading."""
        s.measured_position += p.encoder_offset


@register
@dataclass(frozen=True)
class EncoderNonlinearity(Effect):
    """The encoder's reading bends with the angle: a magnet that sits off its axis.

    Attributes:
        velocity: ``bent``: the servo computes its velocity from this reading. ``apart``: it has it from the motor's own
            sensor, or corrects it, and the angle alone bends.
    """

    name: ClassVar[str] = "encoder_nonlinearity"
    stage: ClassVar[Stage] = Stage.SENSING
    equation: ClassVar[str] = "q_measured = q + a sin(q + p)"
    source: ClassVar[str] = "AS5045 class of magnetic encoders: up to 9 to 25 mrad by a magnet off centre"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("encoder_nonlinearity", "rad", -0.03, 0.03, 0.0, 0.0, "a", least=-0.5, most=0.5),
        Parameter("encoder_nonlinearity_phase", "rad", -pi, pi, 0.0, None, "p"),
    )
    size: ClassVar[str] = "encoder_nonlinearity"
    smallest: ClassVar[float] = 0.003
    secants: ClassVar[tuple[Mapping[str, float], ...]] = (
        {"encoder_nonlinearity": 0.01, "encoder_nonlinearity_phase": 0.0},
        {"encoder_nonlinearity": 0.01, "encoder_nonlinearity_phase": pi / 2},
    )
    fingerprint: ClassVar[str] = "an error of the angle that repeats every turn; IMU against kinematics over the angle"
    confounders: ClassVar[tuple[str, ...]] = ("encoder_offset", "link_com", "cable_spring", "cogging")
    separating_experiment: ClassVar[str] = "slow sweep over the whole range, IMU against forward kinematics"
    alias_class: ClassVar[str] = "gravity_phase"
    scopes: ClassVar[tuple[Scope, ...]] = ("joint",)

    velocity: Literal["bent", "apart"] = "bent"

    @staticmethod
    def sense(s, p):
        """Bend the reading, and with it the velocity if the servo computes it from that."""
        angle = s.position + p.encoder_nonlinearity_phase
        s.measured_position += p.encoder_nonlinearity * sin(angle)
        if p.encoder_nonlinearity_velocity == BENT:
            s.measured_velocity *= 1.0 + p.encoder_nonlinearity * cos(angle)


@register
@dataclass(frozen=True)
class VelocityFilter(Effect):
    """The servo filters the velocity that it reports; first order, exact for a velocity that changes linearly."""

    name: ClassVar[str] = "velocity_filter"
    stage: ClassVar[Stage] = Stage.SENSING
    rank: ClassVar[int] = 1
    equation: ClassVar[str] = "dw_measured/dt = (w - w_measured) / Tw"
    source: ClassVar[str] = "velocity estimate of a servo's firmware, 2 to 15 ms"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("velocity_time_constant", "s", 0.0, 0.02, 0.0, 0.0, "Tw", least=0.0),
    )
    memory: ClassVar[tuple[str, ...]] = ("filtered", "velocity", "now", "knows")
    constants: ClassVar[tuple[str, ...]] = ("left", "behind")
    size: ClassVar[str] = "velocity_time_constant"
    smallest: ClassVar[float] = 0.001
    secants: ClassVar[tuple[Mapping[str, float], ...]] = (
        {"velocity_time_constant": 0.002},
        {"velocity_time_constant": 0.008},
    )
    fingerprint: ClassVar[str] = "reported velocity lags the derivative of the reported angle; no torque beyond Kd"
    confounders: ClassVar[tuple[str, ...]] = ("latency", "current_lag", "terminal_resistance")
    separating_experiment: ClassVar[str] = "compare reported velocity with the derivative of the angle"
    alias_class: ClassVar[str] = "timing"
    scopes: ClassVar[tuple[Scope, ...]] = ("shared", "joint")

    @staticmethod
    def prepare(p):
        """Share of a deviation that a step leaves, and of a change that lags behind."""
        p.velocity_filter_left = exp(-lags_per_step(p.velocity_time_constant, p.timestep))
        p.velocity_filter_behind = p.velocity_time_constant / p.timestep * (1.0 - p.velocity_filter_left)

    @staticmethod
    def reset(s, p):
        """The velocity was held for long."""
        s.velocity_filter_filtered = s.velocity_filter_velocity = s.measured_velocity
        s.velocity_filter_knows = 1.0

    @staticmethod
    def sense(s, p):
        """Filter what has happened since the memory was last renewed, a step ago."""
        now = s.measured_velocity
        s.velocity_filter_now = now
        if s.velocity_filter_knows == 0.0:
            return
        deviation = p.velocity_filter_left * (s.velocity_filter_filtered - s.velocity_filter_velocity)
        s.measured_velocity = now + deviation - p.velocity_filter_behind * (now - s.velocity_filter_velocity)

    @staticmethod
    def finish(s, p):
        """Renew the memory."""
        s.velocity_filter_filtered, s.velocity_filter_velocity = s.measured_velocity, s.velocity_filter_now
