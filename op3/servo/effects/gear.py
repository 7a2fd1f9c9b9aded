"""Losses of the gear train that depend on load."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from op3.servo import law
from op3.servo.effect import Clock, Effect, Parameter, Prepared, Scope, Signals, Stage, register
from op3.servo.effects.presliding import LuGre

_SHARE: dict[str, Any] = {"least": 0.0, "most": 1.0}


@register
@dataclass(frozen=True)
class DirectionalEfficiency(Effect):
    """Directional transmission efficiency (DTE): a gear is harder to drive from its output.

    The passive form is the default: it loses the same torque as the printed rule while the joint moves, holds
    the same range of loads at rest, and never adds energy. The form by power goes by the direction of motion.

    Attributes:
        form: ``passive``, a friction bound by the torques; ``power``, one by the direction of motion; or ``printed``,
            the brake torque of paper eq. (3).
    """

    name: ClassVar[str] = "dte"
    stage: ClassVar[Stage] = Stage.GEAR
    equation: ClassVar[str] = (
        "tau_loss = (1 - eta_fw) |tau_m| where the motor leads, (1 - eta_bw) |tau_a| where the load leads"
    )
    source: ClassVar[str] = "paper eq. (3), its second condition corrected; ranges from Table I"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "forward_efficiency",
            "-",
            0.6,
            1.0,
            1.0,
            1.0,
            "torque that arrives when the motor drives",
            least=0.0,
            most=1.0,
        ),
        Parameter(
            "backward_efficiency",
            "-",
            0.6,
            1.0,
            0.8,
            1.0,
            "torque that arrives when the load drives",
            least=0.0,
            most=1.0,
        ),
    )
    size: ClassVar[str] = "backward_efficiency"
    smallest: ClassVar[float] = 0.03
    secants: ClassVar[tuple[Mapping[str, float], ...]] = ({"backward_efficiency": -0.05}, {"backward_efficiency": -0.2})
    fingerprint: ClassVar[str] = (
        "in proportion to the load where the load drives (lowering, braking, landing), none where the motor drives"
    )
    confounders: ClassVar[tuple[str, ...]] = (
        "load_friction",
        "directional_friction",
        "antagonistic_friction",
        "torque_constant",
        "payload",
    )
    separating_experiment: ClassVar[str] = (
        "hold test: creep the load up and down at rest; the hysteresis of the current grows with load for "
        "friction; two loads"
    )
    alias_class: ClassVar[str] = "load_loss"
    scopes: ClassVar[tuple[Scope, ...]] = ("shared", "joint", "side")

    form: Literal["passive", "printed", "power"] = "passive"

    def prepare(self, values: Mapping[str, Tensor], clock: Clock) -> Prepared:
        """Efficiencies and losses."""
        return {
            "forward_efficiency": values["forward_efficiency"],
            "backward_efficiency": values["backward_efficiency"],
            "forward_loss": 1.0 - values["forward_efficiency"],
            "backward_loss": 1.0 - values["backward_efficiency"],
            "backward_share": 1.0 / values["backward_efficiency"].clamp(min=1e-3) - 1.0,
        }

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Lose torque, as friction or as a brake."""
        motor, load = signals.motor_torque, signals.load_torque
        if self.form == "passive":
            leads = law.motor_leads(motor, load)
            signals.friction_bound = signals.friction_bound + law.dte_passive_loss(
                motor, load, leads, prepared["forward_loss"], prepared["backward_loss"]
            )
            # the loss falls with the motor torque when the joint gains speed, so less of the motor's damping arrives
            lost = prepared["forward_loss"] * torch.sign(motor * signals.velocity)
            signals.damping = signals.damping * (1.0 - torch.where(leads, lost, 0.0))
        elif self.form == "power":
            # bristles of presliding tell the direction in which the teeth are strained, before the joint moves
            direction = LuGre.deflection(signals) if LuGre.name in signals.state else signals.velocity
            signals.friction_bound = signals.friction_bound + law.dte_power_loss(
                motor, load, direction, prepared["forward_loss"], prepared["backward_share"]
            )
        else:
            signals.applied_torque = signals.applied_torque + law.dte_brake(
                motor, load, prepared["forward_efficiency"], prepared["backward_efficiency"]
            )
            forward, backward = law.dte_zones(
                motor, load, prepared["forward_efficiency"], prepared["backward_efficiency"]
            )
            arrives = torch.where(forward, prepared["forward_efficiency"], torch.where(backward, 1.0, 0.0))
            signals.damping = signals.damping * arrives
