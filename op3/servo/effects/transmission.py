"""Between gear and link: play and elasticity, with the rotor as a body of its own.

Where one of the two effects is on, the rotor's inertia leaves the link's degree of freedom, and motor, gear and
friction act on the rotor. The law integrates it; the link feels the torque in the contact, which is solved together
with the link's velocity at the end of the step: the pair is stable at any stiffness, and only the contact damps it. The
encoder sits on the output, as in the Dynamixel X series. What lies behind the play, the last wheels and the horn, turns
with the link: a light foot that rattles within the play does so at another rate with it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from op3.servo import law
from op3.servo.effect import Clock, Effect, Parameter, Prepared, Scope, Signals, Stage, register

STEADY = 0.25
"""How much of the spring's torque per step acts against a change of velocity, as an inertia of ``STEADY h^2 K`` would:
from 0.25 on the scheme is stable at any stiffness, and it damps nothing. What it adds is 1 to 5 % of a rotor."""

UNLOADED = 0.03
"""Load below which a measured motion does not tell on which flank a loose gear lies [N m]."""

MOST_BEHIND = 0.5
"""At most this share of the armature turns with the link."""

LEAST_COMPLIANCE = 1e-6
"""Stands for a rigid transmission where none acts [rad/(N m)]."""

ROTOR = "rotor"
"""Key of the memory: angle before the step, and the velocity after it as ``constant + gain * link velocity``, and the
direction in which it slipped, stacked."""


class Transmission(Effect):
    """What backlash and compliance share."""

    stiff: ClassVar[bool] = True
    damping_ratio: float

    @staticmethod
    def behind(values: Mapping[str, Tensor]) -> Tensor:
        """Inertia behind play and spring [kg m^2], where there are any, by the effects' parameters and the armature."""
        own = torch.zeros_like(values["armature"])
        for size, inertia in (("gear_compliance", "wheel_inertia"), ("backlash_half_gap", "output_inertia")):
            if size in values:
                own = torch.where(values[size] > 0, values[inertia], own)
        return torch.minimum(own, MOST_BEHIND * values["armature"])

    @staticmethod
    def rotor_angle(position: Tensor, load_torque: Tensor, prepared: Prepared) -> Tensor:
        """Angle of the rotor [rad] at rest: on the flank that carries the load, the spring bent by it.

        The start of the hidden state from data: tau_a is minus the torque transmitted to the link, for example
        minus ``M qdd + h`` by inverse dynamics.

        Args:
            position: of the link [rad], ``[sim, joint]``.
            load_torque: tau_a [N m].
            prepared: of the effect, see `prepare`.
        """
        return position - torch.sign(load_torque) * prepared["half_gap"] - load_torque / prepared["stiffness"]

    def _prepared(self, half_gap: Tensor, compliance: Tensor, armature: Tensor, clock: Clock) -> Prepared:
        active = (half_gap > 0) | (compliance > 0)
        stiffness = 1.0 / compliance.clamp(min=LEAST_COMPLIANCE)
        friction = 2.0 * self.damping_ratio * torch.sqrt(stiffness * armature)
        return {
            "active": active,
            "half_gap": half_gap,
            "stiffness": stiffness,
            "steadying": STEADY * clock.timestep * stiffness,
            # torque per difference of velocities at the end of the step
            "grip": STEADY * clock.timestep * stiffness + friction,
            "armature": armature,
            "timestep": torch.tensor(clock.timestep, dtype=half_gap.dtype),
        }

    def reset(self, signals: Signals, prepared: Prepared) -> None:
        """The rotor rests against the flank that carries the load, and moves with the link."""
        if not prepared["active"].any() and ROTOR in signals.state:
            return  # the other of the two effects acts, and has made its memory
        angle = self.rotor_angle(signals.position, signals.load_torque, prepared)
        velocity = signals.velocity.clone()
        none = torch.zeros_like(angle)
        signals.state[ROTOR] = law.stacked(angle - prepared["timestep"] * velocity, velocity, none, none)
        signals.state[LINK] = law.stacked(signals.position, signals.velocity)
        signals.state[PUSH] = law.stacked(none, none)

    def balance(self, signals: Signals, prepared: Prepared, torque: Tensor, rests: Tensor) -> Tensor:
        """Put the rotor against the flank that carries the load, bent by it, and let it move with the link.

        On a contact this stiff the noise of a measured angle would be a large torque. Where there is next to no load
        the rotor stays where it is.
        """
        if not prepared["active"].any():
            return torque
        push, contact = signals.state[PUSH]
        load = contact - torque
        placed = prepared["active"] & (rests | (load.abs() > UNLOADED))
        angle, constant, gain, slips = signals.state[ROTOR]
        velocity = torch.where(rests, 0.0, signals.velocity)
        bent = self.rotor_angle(signals.position, -load, prepared) - prepared["timestep"] * velocity
        signals.state[ROTOR] = law.stacked(
            torch.where(placed, bent, angle),
            torch.where(placed, velocity, constant),
            torch.where(placed, 0.0, gain),
            torch.where(placed, 0.0, slips),
        )
        return torch.where(prepared["active"], push - load, torque)

    @staticmethod
    def _rotor_velocity(signals: Signals) -> Tensor:
        """At the end of the last step; friction stops the rotor, it does not reverse it."""
        _, constant, gain, slips = signals.state[ROTOR]
        velocity = constant + gain * signals.velocity
        return torch.where(slips * velocity < 0, 0.0, velocity)

    def motor_side(self, signals: Signals, prepared: Prepared) -> None:
        """The rotor's velocity: what turns against the voltage when it limits the current."""
        if prepared["active"].any():
            signals.velocity = torch.where(prepared["active"], self._rotor_velocity(signals), signals.velocity)

    def begin(self, signals: Signals, prepared: Prepared) -> None:
        """Move the rotor to the end of the last step, and let motor and friction see it instead of the link."""
        if not prepared["active"].any():
            return
        angle, _, gain, slips = signals.state[ROTOR]
        velocity = self._rotor_velocity(signals)
        angle = angle + prepared["timestep"] * velocity
        signals.state[LINK] = law.stacked(signals.position, signals.velocity)
        signals.state[ROTOR] = law.stacked(angle, velocity, gain, slips)
        signals.position = torch.where(prepared["active"], angle, signals.position)
        signals.velocity = torch.where(prepared["active"], velocity, signals.velocity)

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Solve the rotor's step with the link's, and hand the contact's torque to the link."""
        active = prepared["active"]
        if not active.any():
            return
        step, grip, half_gap = prepared["timestep"], prepared["grip"], prepared["half_gap"]
        angle, velocity = signals.state[ROTOR][:2]
        link, link_velocity = signals.state[LINK]
        inertia = prepared["armature"] + step * signals.damping
        torque, bound = signals.applied_torque, signals.friction_bound
        # where the rotor would be without the link decides which flank it meets
        free = velocity + step * torque / inertia
        free = torch.copysign((free.abs() - step * bound / inertia).clamp(min=0.0), free)
        apart = angle - link
        side = torch.sign(apart + step * (free - link_velocity))
        side = torch.where((apart + step * (free - link_velocity)).abs() > half_gap, side, 0.0)
        bent = prepared["stiffness"] * (apart - side * half_gap) - prepared["steadying"] * (velocity - link_velocity)
        pushes = side * (bent + grip * (free - link_velocity)) > 0
        touches = (half_gap == 0) | ((side != 0) & pushes)
        bent, grip = torch.where(touches, bent, 0.0), torch.where(touches, grip, 0.0)
        # the rotor's velocity after the step: friction holds it, or opposes it
        total = inertia + step * grip
        impulse = inertia * velocity + step * (torque - bent)
        moves = impulse + step * grip * link_velocity
        slips = torch.where(moves.abs() > step * bound, torch.sign(moves), 0.0)
        constant = torch.where(slips != 0, (impulse - step * bound * slips) / total, 0.0)
        gain = torch.where(slips != 0, step * grip / total, 0.0)
        signals.state[ROTOR] = law.stacked(angle, constant, gain, slips)
        # the contact's torque is bent + grip (rotor velocity - link velocity), both after the step
        signals.state[PUSH] = law.stacked(torque, bent + grip * (constant + gain * link_velocity - link_velocity))
        falls = grip * (1.0 - gain)
        contact = bent + grip * constant - falls * link_velocity
        signals.applied_torque = torch.where(active, contact, signals.applied_torque)
        signals.damping = torch.where(active, falls - prepared["armature"] / step, signals.damping)
        signals.friction_bound = torch.where(active, 0.0, bound)


PUSH = "push"
"""Key of the memory of the torque on the rotor and that in the contact [N m], in the last step."""

LINK = "link"
"""Key of the memory of the link's position and velocity, which the law does not see during the step."""


@register
@dataclass(frozen=True)
class Backlash(Transmission):
    """Play between gear and link: the rotor crosses the gap freely when the transmitted torque changes sign.

    Attributes:
        damping_ratio: of the rotor on the stiffness of the contact, against a link at rest; half of the loss factor.
    """

    name: ClassVar[str] = "backlash"
    stage: ClassVar[Stage] = Stage.TRANSMISSION
    rank: ClassVar[int] = 1
    equation: ClassVar[str] = "tau = K dz(q_rotor - q, delta), dz(x, delta) = sign(x) max(|x| - delta, 0)"
    source: ClassVar[str] = "X series: 15 arcmin in all, delta = 2.2 mrad when new (ROBOTIS e-Manual)"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("backlash_half_gap", "rad", 0.0, 0.012, 0.0, 0.0, "delta, half of the play", least=0.0),
        Parameter("contact_stiffness", "N m/rad", 100.0, 500.0, 300.0, None, "K, of teeth and shafts", least=1.0),
        Parameter(
            "output_inertia",
            "kg m2",
            0.0,
            0.001,
            0.0,
            None,
            "J_o, part of the armature that turns with the link",
            least=0.0,
        ),
    )
    borrows: ClassVar[tuple[str, ...]] = ("armature", "gear_compliance", "wheel_inertia")
    size: ClassVar[str] = "backlash_half_gap"
    smallest: ClassVar[float] = 0.001
    secants: ClassVar[tuple[Mapping[str, float], ...]] = tuple(
        {"backlash_half_gap": gap, "contact_stiffness": 300.0, "output_inertia": 0.0005}
        for gap in (0.0015, 0.003, 0.006, 0.010)
    )
    fingerprint: ClassVar[str] = (
        "after a sign change of the transmitted torque: free flight, a jump of velocity, ringing at 20 to 60 Hz; none"
        " while the torque keeps its sign"
    )
    confounders: ClassVar[tuple[str, ...]] = ("stribeck", "lugre", "compliance", "latency")
    separating_experiment: ClassVar[str] = "hold two loads of opposite sign: a step of the angle by the play"
    alias_class: ClassVar[str] = "transmission"
    scopes: ClassVar[tuple[Scope, ...]] = ("joint", "shared", "side")

    damping_ratio: float = 0.04

    def prepare(self, values: Mapping[str, Tensor], clock: Clock) -> Prepared:
        """Gap and stiffness; the compliance of the gear train is in series where that effect is on too."""
        gap = values["backlash_half_gap"]
        compliance = torch.where(gap > 0, 1.0 / values["contact_stiffness"], 0.0)
        if "gear_compliance" in values:
            compliance = compliance + values["gear_compliance"]
        return self._prepared(gap, compliance, values["armature"] - self.behind(values), clock)


@register
@dataclass(frozen=True)
class Compliance(Transmission):
    """Elasticity of gear train and bracket between rotor and link.

    Where `backlash` is on too, that effect solves both in series, and this one only lends its parameter.

    Attributes:
        damping_ratio: of the rotor on the gear train's stiffness, against a link at rest; half of the loss factor.
    """

    name: ClassVar[str] = "compliance"
    stage: ClassVar[Stage] = Stage.TRANSMISSION
    rank: ClassVar[int] = 1
    equation: ClassVar[str] = "tau = (q_rotor - q) / c"
    source: ClassVar[str] = "gear train and bracket, 50 to 500 N m/rad, loss factor 0.02 to 0.1"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("gear_compliance", "rad/(N m)", 0.0, 0.02, 0.0, 0.0, "c = 1 / K", least=0.0),
        Parameter(
            "wheel_inertia",
            "kg m2",
            0.0,
            0.001,
            0.0,
            None,
            "J_o, part of the armature that turns with the link; of a loose gear `output_inertia` does",
            least=0.0,
        ),
    )
    borrows: ClassVar[tuple[str, ...]] = ("armature", "backlash_half_gap", "output_inertia")
    size: ClassVar[str] = "gear_compliance"
    smallest: ClassVar[float] = 0.002
    # the inertia behind the gears moves the resonance too, and no refit crosses from one period of it to the next
    secants: ClassVar[tuple[Mapping[str, float], ...]] = (
        {"gear_compliance": 0.004, "wheel_inertia": 0.0005},
        {"gear_compliance": 0.008, "wheel_inertia": 0.0008},
        {"gear_compliance": 0.015, "wheel_inertia": 0.0005},
    )
    fingerprint: ClassVar[str] = "an extra resonance at sqrt(1 / (c J)); IMU against kinematics in proportion to load"
    confounders: ClassVar[tuple[str, ...]] = ("backlash", "lugre", "current_lag", "link_inertia")
    separating_experiment: ClassVar[str] = "static ladder of loads with IMU or camera; chirp up to the resonance"
    alias_class: ClassVar[str] = "transmission"
    scopes: ClassVar[tuple[Scope, ...]] = ("joint", "shared", "side")

    damping_ratio: float = 0.04

    def prepare(self, values: Mapping[str, Tensor], clock: Clock) -> Prepared:
        """Stiffness; none where backlash takes it along."""
        compliance = values["gear_compliance"]
        own = torch.zeros_like(compliance) if "backlash_half_gap" in values else compliance
        return self._prepared(torch.zeros_like(compliance), own, values["armature"] - self.behind(values), clock)
