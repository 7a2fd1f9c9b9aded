"""The part of the servo law that the emulated bus and firmware stand in for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from op3.servo import Effect, RobotModel, Signals, Stage, law
from op3.servo.effect import Prepared
from op3.servo.effects import Motor

UNBOUNDED = 1e3
"""Stands for a current without bound [A]."""

BUS_EFFECTS = ("latency", "packet_drop")
"""Effects that the emulated bus has by itself."""


class BusCommand(Effect):
    """Goal currents as they stand in the servos' registers, in ``signals.state``; `SimPhysics` writes them."""

    name: ClassVar[str] = "bus_command"
    stage: ClassVar[Stage] = Stage.COMMAND
    equation: ClassVar[str] = "I* = goal current"
    source: ClassVar[str] = "the emulated servo's registers"

    GOALS: ClassVar[tuple[str, ...]] = ("goal_current", "goal_duty", "by_voltage", "bound")

    def reset(self, signals: Signals, prepared: Prepared) -> None:
        """No current is asked for."""
        for name in self.GOALS:
            signals.state[name] = torch.zeros_like(signals.position)
        signals.state["bound"] = torch.full_like(signals.position, UNBOUNDED)

    def tick(self, signals: Signals, prepared: Prepared) -> None:
        """Ask for the goal current."""
        if "goal_current" in signals.state:
            signals.target_current = signals.state["goal_current"] * signals.torque_enable


@dataclass(frozen=True)
class ServoDrive(Motor):
    """The motor with the driver of a real servo: per joint off, regulating current, or applying a voltage.

    A joint that is off carries no current at any speed. One that applies a voltage keeps its current within a bound,
    as current-based position control does.
    """

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Voltage, current, torque, and the part of the torque that is linear in velocity."""
        state, enabled, bus = signals.state, signals.torque_enable, signals.bus_voltage
        state[self.name] = law.stacked(signals.target_current, bus)
        constant, resistance = self.as_it_is(signals, prepared)
        back_emf = constant * signals.velocity
        by_voltage = state["by_voltage"] > 0
        applied = state["goal_duty"] * bus
        reach = resistance * state["bound"]
        within = torch.minimum(torch.maximum(applied, back_emf - reach), back_emf + reach)
        regulated = back_emf + resistance * signals.target_current
        signals.voltage = torch.clamp(torch.where(by_voltage, within, regulated), -bus, bus)
        signals.duty = signals.voltage / bus * enabled
        signals.current = (signals.voltage - back_emf) / resistance * enabled
        signals.motor_torque = constant * signals.current
        signals.applied_torque = signals.motor_torque
        fixed = by_voltage & (within == applied) | (signals.voltage.abs() >= bus)
        signals.damping = torch.where(fixed, constant * constant / resistance, 0.0) * enabled

    def report(self, signals: Signals, prepared: Prepared) -> None:
        """Read the current of now, of a joint that applies a voltage only where that is all there is."""
        before = signals.measured_current
        super().report(signals, prepared)
        constant, resistance = self.as_it_is(signals, prepared)
        now = before + (signals.voltage - constant * signals.velocity) / resistance - signals.current
        applied = torch.where(signals.duty.abs() < 1.0, before, now)
        regulated = torch.where(signals.state["by_voltage"] > 0, applied, signals.measured_current)
        signals.measured_current = torch.where(signals.torque_enable > 0, regulated, before)


def behind_bus(model: RobotModel) -> RobotModel:
    """A model as it stands behind the bus: without a PD and delays of its own, its motor driven by the firmware.

    Raises:
        ValueError: if the model's motor does not regulate current.
    """
    motor = model.effect("motor")
    if not isinstance(motor, Motor) or motor.drive != "current":
        raise ValueError(
            "the emulated servos regulate current, but this model's motor applies a voltage; give a model of the OP3's"
            " servos, with `motor: {drive: current}`"
        )
    gone = [e.name for e in model.effects if e.stage in (Stage.COMMAND, Stage.CONTROLLER) or e.name in BUS_EFFECTS]
    drive = ServoDrive(gear_ratio=motor.gear_ratio)  # pyright: ignore[reportCallIssue]
    return model.without(*gone).with_effect(BusCommand()).with_effect(drive)
