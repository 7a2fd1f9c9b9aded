"""How friction takes hold: through bristles that bend before they slip."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from op3.servo.effect import Clock, Effect, Parameter, Prepared, Scope, Signals, Stage, register


@register
@dataclass(frozen=True)
class LuGre(Effect):
    """Presliding: all friction of the joint acts through an elastic bristle (LuGre) instead of gripping rigidly.

    The bound F that the other frictions make up becomes the level at which the bristle slips. Its deflection z is
    integrated exactly over a step for the speed at its beginning, and linearly in the velocity at its end, which goes
    to the physics as implicit damping: stable at 1 ms from any softness down to a rigid grip.
    """

    name: ClassVar[str] = "lugre"
    stage: ClassVar[Stage] = Stage.TRANSMISSION
    equation: ClassVar[str] = "tau_fric = z / s, dz/dt = w - |w| z / (s F)"
    source: ClassVar[str] = "Canudas de Wit et al. (1995), sigma_0 = 1 / s, sigma_1 = 0; F from the other effects"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("bristle_compliance", "rad/(N m)", 0.0, 0.05, 0.0, 0.0, "s; 20 to 200 N m/rad", least=0.0),
    )
    size: ClassVar[str] = "bristle_compliance"
    smallest: ClassVar[float] = 0.003
    secants: ClassVar[tuple[Mapping[str, float], ...]] = ({"bristle_compliance": 0.005}, {"bristle_compliance": 0.02})
    fingerprint: ClassVar[str] = "a smooth, nearly elastic start of motion over 1 to 3 mrad after each reversal"
    confounders: ClassVar[tuple[str, ...]] = ("stribeck", "compliance", "backlash")
    separating_experiment: ClassVar[str] = "torque steps below break-away: elastic give with hysteresis"
    alias_class: ClassVar[str] = "near_rest"
    scopes: ClassVar[tuple[Scope, ...]] = ("shared", "joint", "side")

    def prepare(self, values: Mapping[str, Tensor], clock: Clock) -> Prepared:
        """Where bristles are soft, and how soft."""
        compliance = values["bristle_compliance"]
        timestep = torch.tensor(clock.timestep, dtype=compliance.dtype)
        return {"soft": compliance > 0, "compliance": compliance.clamp(min=1e-9), "timestep": timestep}

    def reset(self, signals: Signals, prepared: Prepared) -> None:
        """Bristles of a joint that moves are fully bent, those of one at rest are straight."""
        straight = torch.zeros_like(signals.velocity)
        bent = 1e9 * torch.sign(signals.velocity)  # the level of friction bounds it in the first step
        signals.state[self.name] = torch.stack([bent, straight + 1.0, straight])

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Put the bristle's torque in place of the bound."""
        step, compliance = prepared["timestep"], prepared["compliance"]
        deflection, left, gain = signals.state[self.name]
        limit = (signals.friction_bound * compliance).clamp(min=1e-12)
        deflection = (deflection * left + gain * signals.velocity).clamp(-limit, limit)
        # share of a deflection that a step leaves, and how much deflection a unit of velocity adds in it
        slip = (step * signals.velocity.abs() / limit).clamp(min=1e-9)
        left, gain = torch.exp(-slip), step * -torch.expm1(-slip) / slip
        signals.state[self.name] = torch.stack([deflection, left, gain])
        grip = (deflection * left + gain * signals.velocity) / compliance
        soft = prepared["soft"]
        signals.applied_torque = signals.applied_torque - torch.where(soft, grip, 0.0)
        signals.damping = signals.damping + torch.where(soft, gain / compliance, 0.0)
        signals.friction_bound = torch.where(soft, 0.0, signals.friction_bound)
