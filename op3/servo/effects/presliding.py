"""How friction takes hold: through bristles that bend before they slip."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from op3.servo import law
from op3.servo.effect import Clock, Effect, Parameter, Prepared, Scope, Signals, Stage, register


@register
@dataclass(frozen=True)
class LuGre(Effect):
    """Presliding: all friction of the joint acts through an elastic bristle (LuGre) instead of gripping rigidly.

    The bound F that the other frictions make up becomes the level at which the bristle slips. Its deflection z is
    integrated exactly over a step for the speed that the last step's acceleration foretells at its end, and linearly in
    the velocity at its end, which goes to the physics as implicit damping: stable at 1 ms from any softness down to a
    rigid grip. Slipping for the speed at the beginning instead, a joint that gains speed would be braked by more than
    F, as if its rotor were heavier. The bristle's own damping acts on the mean rate of its deflection over the step,
    and so vanishes while the joint slides.

    Attributes:
        damping_ratio: of the rotor alone on its bristle; without damping a held joint rings like a bell.
    """

    name: ClassVar[str] = "lugre"
    stage: ClassVar[Stage] = Stage.TRANSMISSION
    equation: ClassVar[str] = (
        "tau_fric = z / s + sigma_1 dz/dt, dz/dt = w - |w| z / (s F), sigma_1 = 2 zeta sqrt(Ja / s)"
    )
    source: ClassVar[str] = "Canudas de Wit et al. (1995), sigma_0 = 1 / s; F from the other effects"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("bristle_compliance", "rad/(N m)", 0.0, 0.05, 0.0, 0.0, "s; 20 to 200 N m/rad", least=0.0),
    )
    borrows: ClassVar[tuple[str, ...]] = ("armature",)
    size: ClassVar[str] = "bristle_compliance"
    smallest: ClassVar[float] = 0.003
    secants: ClassVar[tuple[Mapping[str, float], ...]] = ({"bristle_compliance": 0.005}, {"bristle_compliance": 0.02})
    fingerprint: ClassVar[str] = "a smooth, nearly elastic start of motion over 1 to 3 mrad after each reversal"
    confounders: ClassVar[tuple[str, ...]] = ("stribeck", "compliance", "backlash")
    separating_experiment: ClassVar[str] = "torque steps below break-away: elastic give with hysteresis"
    alias_class: ClassVar[str] = "near_rest"
    scopes: ClassVar[tuple[Scope, ...]] = ("shared", "joint", "side")

    damping_ratio: float = 0.2

    def prepare(self, values: Mapping[str, Tensor], clock: Clock) -> Prepared:
        """Where bristles are soft, and how soft; and the torque per deflection gained in a step by damping."""
        compliance = values["bristle_compliance"]
        timestep = torch.tensor(clock.timestep, dtype=compliance.dtype)
        soft = (compliance > 0).to(compliance.dtype)
        held = compliance.clamp(min=1e-9)
        stiffness = soft / held
        armature = values["armature"] if "armature" in values else torch.zeros_like(compliance)
        # kept off zero, where the root has no derivative
        damping = 2.0 * self.damping_ratio * soft * torch.sqrt((armature / held).clamp(min=1e-12))
        return {
            "compliance": held,
            "stiffness": stiffness,
            "rate": damping / clock.timestep,
            "whole": stiffness + damping / clock.timestep,
            "rigid": 1.0 - soft,
            "timestep": timestep,
        }

    def reset(self, signals: Signals, prepared: Prepared) -> None:
        """Bristles of a joint that moves are fully bent, those of one at rest are straight."""
        straight = torch.zeros_like(signals.velocity)
        bent = 1e9 * torch.sign(signals.velocity)  # the level of friction bounds it in the first step
        signals.state[self.name] = law.stacked(bent, straight + 1.0, straight, signals.velocity)

    @classmethod
    def deflection(cls, signals: Signals) -> Tensor:
        """How far bristles are bent at the beginning of a step, which the velocity has just become known for [rad]."""
        before, left, gain, _ = signals.state[cls.name]
        return torch.addcmul(before * left, gain, signals.velocity)

    def balance(self, signals: Signals, prepared: Prepared, torque: Tensor, rests: Tensor) -> Tensor:
        """Bristles of resting joints take up the torque; the level of friction bounds them in the next step."""
        bent = self.deflection(signals) + prepared["compliance"] * torch.where(rests, torque, 0.0)
        before = signals.state[self.name][3]
        signals.state[self.name] = law.stacked(bent, torch.ones_like(bent), torch.zeros_like(bent), before)
        return prepared["rigid"] * torque

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Put the bristle's torque in place of the bound."""
        step, compliance = prepared["timestep"], prepared["compliance"]
        limit = (signals.friction_bound * compliance).clamp(min=1e-12)
        deflection = self.deflection(signals).clamp(-limit, limit)
        foretold = (2.0 * signals.velocity - signals.state[self.name][3]).abs()
        # a joint that an impact has slowed down may be foretold to rest, and would be gripped by far more than F
        speed = torch.maximum(foretold, 0.5 * signals.velocity.abs())
        # share of a deflection that a step leaves, and how much deflection a unit of velocity adds in it
        slip = (step * speed / limit).clamp(min=1e-9)
        left, gain = torch.exp(-slip), step * -torch.expm1(-slip) / slip
        signals.state[self.name] = law.stacked(deflection, left, gain, signals.velocity)
        later = torch.addcmul(deflection * left, gain, signals.velocity)
        grip = prepared["whole"] * later - prepared["rate"] * deflection
        signals.applied_torque = signals.applied_torque - grip
        signals.damping = torch.addcmul(signals.damping, gain, prepared["whole"])
        signals.friction_bound = prepared["rigid"] * signals.friction_bound
