"""The DC motor behind its gear ratio."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from op3.robot.joints import GEAR_RATIO
from op3.servo import law
from op3.servo.effect import Clock, Effect, ModelEdit, Parameter, Prepared, Signals, Stage, register


@register
@dataclass(frozen=True)
class Motor(Effect):
    """DC motor with a current controller, or driven by voltage, paper eqs. (1) and (2).

    Where the bus voltage limits the current, the torque falls with velocity: ``K V / R - K^2 w / R``. Its
    derivative goes to the physics as damping to be integrated implicitly; evaluated at the old velocity alone,
    the back-EMF mimics a terminal resistance that is 6 % too high at 1 ms.

    Attributes:
        gear_ratio: motor turns per turn of the joint.
        drive: whether the driver regulates current or applies a voltage.
    """

    name: ClassVar[str] = "motor"
    stage: ClassVar[Stage] = Stage.MOTOR
    equation: ClassVar[str] = "tau_m = N Kt I, I = (V - N Kt w) / R, V = clip(R I* + N Kt w, -V_bus, V_bus)"
    source: ClassVar[str] = "paper eqs. (1), (2); ranges from Table I; gear ratio 353.5, ROBOTIS e-Manual"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("torque_constant", "N m/A", 0.003, 0.009, 0.006, None, "at the motor shaft", least=0.0),
        Parameter("terminal_resistance", "ohm", 4.0, 9.0, 6.5, None, "of the motor and its driver", least=1e-3),
        Parameter("armature", "kg m^2", 0.0025, 0.011, 0.00675, None, "rotor inertia seen at the joint", least=0.0),
    )
    edits: ClassVar[tuple[ModelEdit, ...]] = (ModelEdit("dof_armature", "joint_dof", "set", "armature"),)

    gear_ratio: float = GEAR_RATIO
    drive: Literal["current", "voltage"] = "current"

    def prepare(self, values: Mapping[str, Tensor], clock: Clock) -> Prepared:
        """Joint-side torque constant K and the factors that contain it."""
        constant = values["torque_constant"] * self.gear_ratio
        resistance = values["terminal_resistance"]
        return {
            "constant": constant,
            "resistance": resistance,
            "back_emf_damping": constant * constant / resistance,
        }

    def reset(self, signals: Signals, prepared: Prepared) -> None:
        """The first current was wanted before."""
        if self.drive == "current":
            signals.state[self.name] = law.stacked(signals.target_current, signals.bus_voltage)

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Voltage, current, torque, and the part of the torque that is linear in velocity."""
        constant, resistance = prepared["constant"], prepared["resistance"]
        back_emf_damping = prepared["back_emf_damping"]
        if signals.factors:  # temperature has changed the motor
            constant = constant * signals.factors.get("torque_constant", 1.0)
            resistance = resistance * signals.factors.get("terminal_resistance", 1.0)
            back_emf_damping = constant * constant / resistance
        back_emf = constant * signals.velocity
        if self.drive == "current":
            if law.SUPPLY in signals.state:
                signals.bus_voltage = law.settled_voltage(
                    signals.bus_voltage, signals.state[law.SUPPLY], signals.target_current, back_emf, resistance
                )
            signals.state[self.name] = law.stacked(signals.target_current, signals.bus_voltage)
            signals.voltage = law.current_control(signals.target_current, back_emf, resistance, signals.bus_voltage)
            signals.duty = signals.voltage / signals.bus_voltage
            implicit = signals.voltage.abs() >= signals.bus_voltage
        else:
            signals.voltage = signals.voltage * signals.torque_enable
            implicit = signals.torque_enable > 0
        current = (signals.voltage - back_emf) / resistance
        signals.current = current if self.drive == "current" else current * signals.torque_enable
        signals.motor_torque = constant * signals.current
        signals.applied_torque = signals.motor_torque
        signals.damping = torch.where(implicit, back_emf_damping, 0.0)

    @staticmethod
    def as_it_is(signals: Signals, prepared: Prepared) -> tuple[Tensor, Tensor]:
        """Torque constant on the joint side and resistance, with what temperature has made of them."""
        factors = signals.factors
        constant = prepared["constant"] * factors.get("torque_constant", 1.0)
        return constant, prepared["resistance"] * factors.get("terminal_resistance", 1.0)

    def report(self, signals: Signals, prepared: Prepared) -> None:
        """Read the current of now: what is wanted at the end of the step, as far as the supply allows it."""
        if self.drive != "current":
            return
        constant, resistance = self.as_it_is(signals, prepared)
        wanted, bus_voltage = signals.state[self.name]
        back_emf = constant * signals.velocity
        least, most = (-bus_voltage - back_emf) / resistance, (bus_voltage - back_emf) / resistance
        now = torch.minimum(torch.maximum(wanted + law.ahead(signals.state), least), most)
        signals.measured_current = signals.measured_current + now - signals.current
