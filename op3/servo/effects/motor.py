"""The DC motor behind its gear ratio."""

from typing import Literal

import numpy as np

from op3.servo.effect import Effect, ModelEdit, Parameter, Stage, register
from op3.servo.law import clip
from op3.servo.machine_code import part

CURRENT, VOLTAGE = range(2)
"""Indices of the drives in their list."""

SETTLING = 4
"""Newton steps until the voltage has converged."""

LEAST_VOLTAGE = 1.0
"""Lowest voltage of a bus [V]."""


@register
class Motor(Effect):
    """DC motor with a current controller, or driven by voltage, paper eqs. (1) and (2).

    Where the bus voltage limits the current, the torque falls with velocity: ``K V / R - K^2 w / R``. Its
    derivative goes to the physics as damping to be integrated implicitly; evaluated at the old velocity alone,
    the back-EMF mimics a terminal resistance that is 6 % too high at 1 ms.

    Attributes:
        gear_ratio: motor turns per turn of the joint.
        drive: whether the driver regulates current or applies a voltage.
    """

    name = "motor"
    stage = Stage.MOTOR
    equation = "tau_m = N Kt I, I = (V - N Kt w) / R, V = clip(R I* + N Kt w, -V_bus, V_bus)"
    source = "paper eqs. (1), (2); ranges from Table I; gear ratio 353.5, ROBOTIS e-Manual"
    parameters = (
        Parameter("torque_constant", "N m/A", 0.003, 0.009, 0.006, None, "at the motor shaft", least=0.0),
        Parameter("terminal_resistance", "ohm", 4.0, 9.0, 6.5, None, "of the motor and its driver", least=1e-3),
        Parameter("armature", "kg m^2", 0.0025, 0.011, 0.00675, None, "rotor inertia seen at the joint", least=0.0),
    )
    # no maker of hobby servos states their spread; data of motors hold within +-10 % (Beckhoff AM8100, "technical
    # data"), taken here as two standard deviations
    spread = {"torque_constant": 0.05, "terminal_resistance": 0.05}
    memory = ("wanted", "bus_voltage")
    constants = ("constant",)
    edits = (ModelEdit("dof_armature", "joint_dof", "set", "armature"),)

    gear_ratio: float = 353.5
    drive: Literal["current", "voltage"] = "current"

    @staticmethod
    def prepare(p):
        p.motor_constant = p.torque_constant * p.motor_gear_ratio

    @staticmethod
    def reset(s, p):
        """The first target current was already acting before the start."""
        s.motor_wanted, s.motor_bus_voltage = s.target_current, s.bus_voltage

    @staticmethod
    def apply(s, p):
        """Voltage, current, torque, and the part of the torque that is linear in velocity."""
        constant = p.motor_constant * s.torque_constant_factor
        resistance = p.terminal_resistance * s.resistance_factor
        back_emf, enabled, bus = constant * s.velocity, s.torque_enable, s.bus_voltage
        s.motor_wanted, s.motor_bus_voltage = s.target_current, bus
        if p.motor_drive == VOLTAGE:
            s.voltage *= enabled
            implicit = enabled > 0.0
        else:
            s.voltage = clip(back_emf + resistance * s.target_current, -bus, bus)
            s.duty = s.voltage / bus
            implicit = abs(s.voltage) >= bus
        s.current = (s.voltage - back_emf) / resistance
        if p.motor_drive == VOLTAGE:
            s.current *= enabled
        s.motor_torque = constant * s.current
        s.applied_torque = s.motor_torque
        s.damping = constant * constant / resistance if implicit else 0.0

    @staticmethod
    def report(s, p):
        """Report the current at the end of the step, limited by the supply."""
        if p.motor_drive == VOLTAGE:
            return
        constant = p.motor_constant * s.torque_constant_factor
        resistance = p.terminal_resistance * s.resistance_factor
        back_emf, bus = constant * s.velocity, s.motor_bus_voltage
        now = clip(s.motor_wanted + s.ahead, (-bus - back_emf) / resistance, (bus - back_emf) / resistance)
        s.measured_current += now - s.current


@part
def settle(s, p):
    """Let the bus voltage of a robot fall with the currents that it lets through: ``V = V0 - R_s sum |I(V)|``.

    If no servo regenerates, the currents fall with the voltage, and there is one solution. Newton steps from above
    reach it once they have identified the servos whose current the voltage limits.

    Args:
        s: signals of its joints, ``[joint]``.
    """
    supply = s[0].supply_resistance
    for _ in range(SETTLING):
        drawn, slope = 0.0, 0.0
        for j in range(len(s)):
            resistance = p[j].terminal_resistance * s[j].resistance_factor
            back_emf = p[j].motor_constant * s[j].torque_constant_factor * s[j].velocity
            target, bus = s[j].target_current, s[j].bus_voltage
            current = clip(target, (-bus - back_emf) / resistance, (bus - back_emf) / resistance)
            drawn += abs(current)
            if current != target:  # one that its speed drives back gives the more, the lower the voltage is
                slope += np.sign(current * target) / resistance
        for j in range(len(s)):
            opened, bus = s[j].open_voltage, s[j].bus_voltage
            fallen = bus + (opened - supply * drawn - bus) / (1.0 + supply * max(slope, 0.0))
            s[j].bus_voltage = min(max(fallen, LEAST_VOLTAGE), opened)
