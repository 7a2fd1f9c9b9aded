"""What the servo's sensors say that is not so."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi
from typing import ClassVar, Literal

import torch
from torch import Tensor

from op3.servo import law
from op3.servo.effect import Clock, Effect, Parameter, Prepared, Scope, Signals, Stage, register
from op3.servo.effects.electrical import left_after_step


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

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Shift the reading."""
        signals.measured_position = signals.measured_position + prepared["encoder_offset"]


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

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Bend the reading, and with it the velocity if the servo computes it from that."""
        bend, angle = prepared["encoder_nonlinearity"], signals.position + prepared["encoder_nonlinearity_phase"]
        signals.measured_position = signals.measured_position + bend * torch.sin(angle)
        if self.velocity == "bent":
            signals.measured_velocity = signals.measured_velocity * (1.0 + bend * torch.cos(angle))


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

    def prepare(self, values: Mapping[str, Tensor], clock: Clock) -> Prepared:
        """Share of a deviation that a step leaves, and of a change that lags behind."""
        time_constant = values["velocity_time_constant"]
        left = left_after_step(time_constant, clock.timestep)
        return {"left": left, "behind": time_constant / clock.timestep * (1.0 - left)}

    def reset(self, signals: Signals, prepared: Prepared) -> None:
        """The velocity was held for long."""
        signals.state[self.name] = law.stacked(signals.measured_velocity, signals.measured_velocity)

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Filter what has happened since the memory was last renewed, a step ago."""
        if self.name not in signals.state:
            return  # nothing is known of the past yet
        filtered, velocity = signals.state[self.name]
        now = signals.measured_velocity
        deviation = prepared["left"] * (filtered - velocity)
        signals.state["velocity_now"] = now
        signals.measured_velocity = now + deviation - prepared["behind"] * (now - velocity)

    def finish(self, signals: Signals, prepared: Prepared) -> None:
        """Renew the memory."""
        signals.state[self.name] = law.stacked(signals.measured_velocity, signals.state["velocity_now"])
