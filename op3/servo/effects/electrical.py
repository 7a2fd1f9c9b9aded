"""Errors of the motor's circuit: constants, supply and current loop."""

from collections.abc import Mapping
from math import exp, inf
from typing import Literal

from torch import Tensor

from op3.servo.effect import Effect, Parameter, Stage, Usual, register
from op3.servo.law import CURRENT, clip, lags_per_step

REFERENCE_TEMPERATURE = 25.0
"""Temperature at which the motor's parameters hold [C]."""


@register
class TorqueConstant(Effect):
    """Relative error of the torque constant, and with it of the back-EMF.

    On a fixed base without a known weight, it is equivalent to dividing all masses, inertias and frictions by this
    factor.
    """

    name = "torque_constant"
    stage = Stage.MOTOR
    equation = "Kt *= 1 + e"
    source = (
        "XM430-W350: 1.78 N m/A at stall against 2.49 V s/rad from its no-load speed at 12 V (ROBOTIS e-Manual); range"
        " chosen by us, close to the difference of these values"
    )
    parameters = (Parameter("torque_constant_error", "-", -0.25, 0.25, 0.0, 0.0, "e, relative", least=-0.9),)
    secants = ({"torque_constant_error": 0.05},)
    fingerprint = "proportional to current, whether the motor drives or is driven"
    confounders = ("payload", "link_mass", "torque_constant_temperature", "dte")
    separating_experiment = "recordings with a known added mass, or with a force gauge at the foot"

    def adjust(self, values: Mapping[str, Tensor], sides: Tensor) -> Mapping[str, Tensor]:
        return scaled(values, "torque_constant", values["torque_constant_error"])


@register
class TerminalResistance(Effect):
    """Relative error of the terminal resistance, and its growth with temperature."""

    name = "terminal_resistance"
    stage = Stage.DRIVER
    equation = "R *= (1 + e) (1 + a (T - 25 C))"
    source = "copper: 0.00393 per K at 20 C (IEC 60028); range chosen by us: up to 1.5 times this value"
    parameters = (
        Parameter("terminal_resistance_error", "-", -0.3, 0.3, 0.0, 0.0, "e, relative", least=-0.9),
        Parameter("resistance_temperature_coefficient", "1/K", 0.0, 0.006, 0.0, 0.0, "a, per measured K", least=0.0),
    )
    reads = ("temperature",)
    secants = ({"terminal_resistance_error": 0.1}, {"resistance_temperature_coefficient": 0.004})
    fingerprint = "a changed slope of current over speed, only where the bus voltage limits the current"
    confounders = ("voltage_sag", "torque_constant", "minimum_duty")
    separating_experiment = "motion in voltage saturation at two speeds and two bus voltages"

    def adjust(self, values: Mapping[str, Tensor], sides: Tensor) -> Mapping[str, Tensor]:
        return scaled(values, "terminal_resistance", values["terminal_resistance_error"])

    @staticmethod
    def apply(s, p):
        """Set the temperature dependence of the motor's resistance."""
        s.resistance_factor = 1.0 + p.resistance_temperature_coefficient * (s.temperature - REFERENCE_TEMPERATURE)


@register
class TorqueConstantTemperature(Effect):
    """Magnets weaken with the measured temperature of each servo, or at 25 C without a measurement."""

    name = "torque_constant_temperature"
    stage = Stage.DRIVER
    equation = "Kt *= 1 - a (T - 25 C)"
    source = "makers of magnets: remanence of sintered NdFeB falls 0.0009 to 0.0012 per K, of ferrite 0.002 per K"
    parameters = (Parameter("magnet_temperature_coefficient", "1/K", 0.0, 0.004, 0.0, 0.0, "a, per measured K"),)
    reads = ("temperature",)
    secants = ({"magnet_temperature_coefficient": 0.001},)
    fingerprint = "proportional to current times temperature above the reference"
    confounders = ("torque_constant", "payload", "friction_drift")
    separating_experiment = "the same motion cold (25 C) and hot (55 C or more)"
    scopes = ("joint", "shared")

    @staticmethod
    def apply(s, p):
        """Set the temperature dependence of the motor's torque constant."""
        s.torque_constant_factor = 1.0 - p.magnet_temperature_coefficient * (s.temperature - REFERENCE_TEMPERATURE)


@register
class VoltageSag(Effect):
    """The supply's voltage falls with the current of all servos, through battery and harness.

    Capacitors on the bus let it follow with a short time constant, which also keeps a bus stable on which all motors
    saturate. If a log has the measured bus voltage, the replay uses it, and it already includes the sag.

    Attributes:
        time_constant: time constant with which the voltage follows the current [s].
        least_voltage: lowest voltage of the bus [V].
    """

    name = "voltage_sag"
    stage = Stage.TRANSPORT
    equation = "V_bus = V0 - Rb sum |I|"
    source = "Ohm's law of battery and harness; range chosen by us"
    parameters = (Parameter("supply_resistance", "ohm", 0.0, 0.6, 0.0, 0.0, "Rb", per_joint=False, least=0.0),)
    memory = ("drawn",)
    constants = ("keep",)
    secants = ({"supply_resistance": 0.1}, {"supply_resistance": 0.3})
    fingerprint = "only in saturation, and proportional to the currents of the other joints"
    confounders = ("terminal_resistance", "minimum_duty")
    separating_experiment = "saturation of one joint alone and of all joints together, with the measured bus voltage"

    time_constant: float = 0.002
    least_voltage: float = 1.0

    @staticmethod
    def prepare(p):
        """Share of the old current that remains after a step."""
        p.voltage_sag_keep = exp(-p.timestep / p.voltage_sag_time_constant)

    @staticmethod
    def reset(s, p):
        """The bus voltage starts in steady state for the first currents."""
        s.voltage_sag_drawn = s.drawn

    @staticmethod
    def apply(s, p):
        s.voltage_sag_drawn = s.drawn + p.voltage_sag_keep * (s.voltage_sag_drawn - s.drawn)
        fallen = s.bus_voltage - p.supply_resistance * s.voltage_sag_drawn
        s.bus_voltage = clip(fallen, p.voltage_sag_least_voltage, inf)


@register
class CurrentLag(Effect):
    """The current follows its command as a first-order lag, integrated exactly.

    A step uses the mean over the step, so that time constants shorter than a step are correct too.

    Attributes:
        signal: the lagging signal: the current of a current-driven servo, or the voltage of a voltage-driven servo,
            whose windings have inductance.
    """

    name = "current_lag"
    stage = Stage.DRIVER
    rank = 1
    equation = "dI/dt = (u - I) / Tc"
    source = "closed current loop; ROBOTIS does not disclose its lag, so the range is chosen by us"
    parameters = (Parameter("current_time_constant", "s", 0.0, 0.01, 0.0, 0.0, "Tc", least=0.0),)
    # op3's choice: ROBOTIS does not disclose it (ROBOTIS-GIT/emanual issue 1331), only that loops run much faster
    # than 1 kHz (DynamixelSDK issue 534)
    usual = {"current_time_constant": Usual(0.001, 0.001, 0.002, 0.01)}
    memory = ("end", "wanted")
    constants = ("rate", "left")
    secants = (
        {"current_time_constant": 0.001, "command_latency": -0.001},
        {"current_time_constant": 0.003, "command_latency": -0.003},
        {"current_time_constant": 0.008, "command_latency": -0.008},
        {"current_time_constant": 0.001},
    )
    fingerprint = "measured current lags its command by a fraction of a sample, with smoothed edges"
    confounders = ("latency", "velocity_filter", "packet_drop")
    separating_experiment = "chirp of the command above 20 Hz: a delay has linear phase, a lag reduces the amplitude"
    scopes = ("joint", "shared")

    signal: Literal["target_current", "voltage"] = "target_current"

    @staticmethod
    def prepare(p):
        """Time constants in a step, and the share of a deviation that it leaves."""
        p.current_lag_rate = lags_per_step(p.current_time_constant, p.timestep)
        p.current_lag_left = exp(-p.current_lag_rate)

    @staticmethod
    def reset(s, p):
        """The current starts settled at the first command; a voltage starts from zero."""
        s.current_lag_end = s.current_lag_wanted = s.target_current if p.current_lag_signal == CURRENT else 0.0

    @staticmethod
    def apply(s, p):
        """Output the lagged command, also if a new one arrives within the step."""
        if p.current_lag_signal == CURRENT:
            before, asked = s.current_lag_end, s.target_current
            now = asked + s.ahead
            left = p.current_lag_left if s.since == 1.0 else exp(-s.since * p.current_lag_rate)
            end = now + (s.current_lag_wanted - now) * left + (before - s.current_lag_wanted) * p.current_lag_left
        else:
            before, asked = s.current_lag_end, s.voltage
            now = asked
            end = now + (before - now) * p.current_lag_left
        # the mean of dI/dt = (u - I) / Tc
        mean = asked - p.current_time_constant / p.timestep * (end - before)
        s.current_lag_end, s.current_lag_wanted = end, now
        if p.current_lag_signal == CURRENT:
            s.target_current, s.ahead = mean, end - mean
        else:
            s.voltage = mean


@register
class CurrentOffset(Effect):
    """The servo's current sensor has a constant offset, which a current loop compensates.

    The motor's current is lower than commanded by the offset, which acts as a constant torque. A voltage-driven servo
    only reports the offset.
    """

    name = "current_offset"
    stage = Stage.DRIVER
    equation = "I_measured = I + o; regulated: I = I* - o"
    source = "zero of a shunt amplifier; range chosen by us: 19 counts of 2.69 mA of the XM430 (ROBOTIS e-Manual)"
    parameters = (Parameter("current_offset", "A", -0.05, 0.05, 0.0, 0.0, "o, reading without current"),)
    # op3's choice: about two counts of 2.69 mA (ROBOTIS e-Manual, XM430); no manufacturer states the zero
    usual = {"current_offset": Usual(0.0, 0.006, 0.01, 0.06, own=True)}
    secants = ({"current_offset": 0.01},)
    fingerprint = "a constant torque in all poses, in both directions and at rest"
    confounders = ("asymmetric_friction", "cable_spring", "link_com", "encoder_offset")
    separating_experiment = "two orientations of the base: gravity turns, the offset does not; current with torque off"

    @staticmethod
    def apply(s, p):
        """Subtract the offset from the current; a servo without torque does not regulate its current."""
        s.target_current -= p.current_offset * s.torque_enable

    @staticmethod
    def report(s, p):
        s.measured_current += p.current_offset


def scaled(values: Mapping[str, Tensor], name: str, error: Tensor) -> Mapping[str, Tensor]:
    """Parameters with one of them multiplied by ``1 + error``, if the model has it."""
    return {**values, name: values[name] * (1.0 + error)} if name in values else values
