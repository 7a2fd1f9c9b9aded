"""Torque and friction that depend on the joint's angle."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, pi, sin
from typing import ClassVar

from op3.servo.effect import Effect, Parameter, Scope, Stage, register


@register
@dataclass(frozen=True)
class Cogging(Effect):
    """Torque ripple of meshing teeth, periodic in the joint's angle."""

    name: ClassVar[str] = "cogging"
    stage: ClassVar[Stage] = Stage.GEAR
    equation: ClassVar[str] = "tau += A sin(n q + phi)"
    source: ClassVar[str] = "gear mesh, n teeth of the last stages; the rotor's own cogging lies above what a log shows"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("cogging_amplitude", "N m", -0.05, 0.05, 0.0, 0.0, "A, at the joint"),
        Parameter("cogging_phase", "rad", -pi, pi, 0.0, None, "phi"),
        Parameter("cogging_periods", "-", 6.0, 60.0, 24.0, None, "n, ripples per turn of the joint", least=0.0),
    )
    size: ClassVar[str] = "cogging_amplitude"
    smallest: ClassVar[float] = 0.005
    secants: ClassVar[tuple[Mapping[str, float], ...]] = tuple(
        {"cogging_amplitude": 0.01, "cogging_phase": phase, "cogging_periods": periods}
        for periods in (12.0, 24.0, 36.0, 48.0)
        for phase in (0.0, pi / 2)
    )
    fingerprint: ClassVar[str] = "a narrow line in the spectrum over position, which moves with speed in time"
    confounders: ClassVar[tuple[str, ...]] = ("position_friction", "encoder_nonlinearity", "stribeck")
    separating_experiment: ClassVar[str] = "slow sweeps at two speeds: a ripple keeps its place in angle"
    alias_class: ClassVar[str] = "ripple"
    scopes: ClassVar[tuple[Scope, ...]] = ("joint",)

    @staticmethod
    def apply(s, p):
        """Add the ripple."""
        s.applied_torque += p.cogging_amplitude * sin(p.cogging_periods * s.position + p.cogging_phase)


@register
@dataclass(frozen=True)
class CableSpring(Effect):
    """A cable across the joint pulls like a spring, beside the servo: the gear does not carry its torque."""

    name: ClassVar[str] = "cable_spring"
    stage: ClassVar[Stage] = Stage.PARALLEL
    equation: ClassVar[str] = "tau -= k (q - q0)"
    source: ClassVar[str] = "cable harness across a joint, 0.02 to 0.3 N m/rad"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("cable_stiffness", "N m/rad", 0.0, 0.3, 0.0, 0.0, "k", least=0.0),
        Parameter("cable_rest_angle", "rad", -1.5, 1.5, 0.0, None, "q0"),
    )
    memory: ClassVar[tuple[str, ...]] = ("pull",)
    size: ClassVar[str] = "cable_stiffness"
    smallest: ClassVar[float] = 0.02
    secants: ClassVar[tuple[Mapping[str, float], ...]] = (
        {"cable_stiffness": 0.05, "cable_rest_angle": 0.0},
        {"cable_stiffness": 0.05, "cable_rest_angle": 1.0},
    )
    fingerprint: ClassVar[str] = "a function of the angle, the same in both directions, whatever the robot's attitude"
    confounders: ClassVar[tuple[str, ...]] = ("link_com", "com_offset", "encoder_offset", "current_offset")
    separating_experiment: ClassVar[str] = "turn the base by a quarter: gravity turns, a spring does not"
    alias_class: ClassVar[str] = "gravity_phase"
    scopes: ClassVar[tuple[Scope, ...]] = ("joint", "side")

    @staticmethod
    def begin(s, p):
        """Take the cable's part out of what the link asks of the gear."""
        s.cable_spring_pull = p.cable_stiffness * (p.cable_rest_angle - s.link_position)
        s.load_torque += s.cable_spring_pull

    @staticmethod
    def apply(s, p):
        """Pull."""
        s.applied_torque += s.cable_spring_pull


@register
@dataclass(frozen=True)
class PositionFriction(Effect):
    """Friction that is higher at some angles than at others: a bent shaft, a worn tooth, a rubbing cable.

    Attributes:
        periods: of the friction per turn of the joint.
    """

    name: ClassVar[str] = "position_friction"
    stage: ClassVar[Stage] = Stage.FRICTION
    equation: ClassVar[str] = "tau_fric += A (1 + cos(n (q - q_w))) / 2"
    source: ClassVar[str] = "eccentric output shaft: one period per turn"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("position_friction", "N m", 0.0, 0.2, 0.0, 0.0, "A, friction added at the worst angle", least=0.0),
        Parameter("position_friction_angle", "rad", -pi, pi, 0.0, None, "q_w, the worst angle"),
    )
    size: ClassVar[str] = "position_friction"
    smallest: ClassVar[float] = 0.02
    secants: ClassVar[tuple[Mapping[str, float], ...]] = tuple(
        {"position_friction": 0.05, "position_friction_angle": angle} for angle in (0.0, pi / 2, pi, -pi / 2)
    )
    fingerprint: ClassVar[str] = "odd in velocity, with a width of the hysteresis loop that changes over the angle"
    confounders: ClassVar[tuple[str, ...]] = ("coulomb", "load_friction", "dte", "cogging")
    separating_experiment: ClassVar[str] = "slow sweep over the whole range at two loads or two attitudes"
    alias_class: ClassVar[str] = "position_friction"
    scopes: ClassVar[tuple[Scope, ...]] = ("joint",)

    periods: float = 1.0

    @staticmethod
    def apply(s, p):
        """Raise the bound."""
        wave = cos(p.position_friction_periods * (s.position - p.position_friction_angle))
        s.friction_bound += 0.5 * p.position_friction * (1.0 + wave)
