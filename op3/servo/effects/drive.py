"""Position loops, and the latency of their commands."""

from collections.abc import Mapping
from dataclasses import replace
from math import ceil, exp
from typing import Literal

import numpy as np
from torch import Tensor

from op3.servo.effect import Effect, Parameter, Stage, Usual, register
from op3.servo.law import CURRENT, acted, clip, lifted_voltage
from op3.servo.signals import Periods


@register
class CurrentPD(Effect):
    """Variable-gain PD on the robot's computer, which commands a current that is held between control ticks.

    Attributes:
        current_limit: the servo clips target currents at this value [A].
        resolution: unit of the register for the target current [A]; 0: not quantised.
    """

    name = "current_pd"
    stage = Stage.COMMAND
    equation = "I* = clip(Kp (q* - q) - Kd w, -I_max, I_max)"
    source = "paper, section 'Variable Gain PD'; stall current 2.3 A at 12 V, ROBOTIS e-Manual"
    commands = ("p_gain", "d_gain")

    current_limit: float = 2.3
    resolution: float = 0.0

    @staticmethod
    def tick(s, p):
        """Compute the current command from the sensors of this tick."""
        current = s.p_gain * (s.position_target - s.measured_position) - s.d_gain * s.measured_velocity
        if p.current_pd_resolution > 0.0:
            current = np.rint(current / p.current_pd_resolution) * p.current_pd_resolution
        s.target_current = clip(current, -p.current_pd_current_limit, p.current_pd_current_limit) * s.torque_enable


@register
class Latency(Effect):
    """Commands act with a constant delay, which need not be a whole number of steps.

    Attributes:
        longest: largest latency that fits into the memory [s].
        signal: the delayed signal: the current of a current-driven servo, or the goal of a position servo.
    """

    name = "latency"
    stage = Stage.TRANSPORT
    equation = "u(t) -> u(t - d)"
    source = "reading and writing twenty servos at 2 Mbit/s takes 3 ms; range of two control periods chosen by us"
    parameters = (
        Parameter("command_latency", "s", 0.0, 0.016, 0.006, 0.0, "time from reading sensors to torque", least=0.0),
    )
    # for twenty servos, a sync write of 2 bytes and a sync read of 10 bytes take 530 bytes in protocol 2.0: 5.3 ms at
    # 1 Mbit/s and 1.3 ms at 4 Mbit/s plus the pauses before answers; a shorter latency is negligible
    usual = {"command_latency": Usual(0.004, 0.0015, 0.004, 0.03, none=0.0013)}
    constants = ("steps", "steps_per_tick")
    secants = ({"command_latency": 0.001}, {"command_latency": -0.001}, {"command_latency": 0.004})
    fingerprint = "proportional to the rate of change of the command; the same time shift at every frequency"
    confounders = ("current_lag", "velocity_filter", "packet_drop")
    separating_experiment = "chirp above 20 Hz at two gains: a delay has linear phase, a lag reduces the amplitude"
    scopes = ("joint", "shared")

    longest: float = 0.024
    signal: Literal["target_current", "goal"] = "target_current"

    def __post_init__(self):
        """See `Effect`; limits the searched range to the memory."""
        super().__post_init__()
        known = tuple(replace(known, most=self.longest) for known in type(self).parameters)
        object.__setattr__(self, "parameters", known)

    def adjust(self, values: Mapping[str, Tensor], sides: Tensor) -> Mapping[str, Tensor]:
        """Check that latencies fit into the memory, without changing parameters.

        Raises:
            ValueError: if a latency is negative or longer than the memory.
        """
        latency = values["command_latency"]
        if latency.min() < 0 or latency.max() > self.longest:
            raise ValueError(
                f"command_latency must lie in [0, {self.longest}] s, got {latency.min():g} to {latency.max():g};"
                " raise the option `longest` of the effect `latency` for slower buses"
            )
        return values

    def depth(self, clock: Periods) -> int:
        """Number of delayed commands, and the current command."""
        return ceil(self.longest / clock.period - 1e-9) + 1

    @staticmethod
    def prepare(p):
        """Latency and control period in simulation steps."""
        p.latency_steps, p.latency_steps_per_tick = p.command_latency / p.timestep, p.period / p.timestep

    @staticmethod
    def reset(s, p, past):
        """Before the start, the first command was already held."""
        past[:] = s.target_current if p.latency_signal == CURRENT else s.goal

    @staticmethod
    def tick(s, p, past):
        """Store the new command before the older ones."""
        for age in range(len(past) - 1, 0, -1):
            past[age] = past[age - 1]
        past[0] = s.target_current if p.latency_signal == CURRENT else s.goal

    @staticmethod
    def apply(s, p, past):
        """Output the mean over the step of the commands that have arrived."""
        arrived, before, last, since = 0.0, 0.0, 0.0, 0.0
        for age in range(len(past)):
            share = acted(age, s.phase, p.latency_steps, p.latency_steps_per_tick)
            arrived += (share - before) * past[age]
            if before == 0.0 and share > 0.0:  # the newest that acts
                last, since = past[age], share
            before = share
            if share == 1.0:
                break
        if p.latency_signal == CURRENT:
            s.target_current, s.ahead, s.since = arrived, last - arrived, since
        else:
            s.goal = arrived


@register
class PositionServo(Effect):
    """A servo's own position loop, which sets the duty cycle of its driver once per simulation step.

    Attributes:
        error_gain: duty per radian of error and unit of the firmware's kp.
        max_duty: largest duty cycle.
        goal_speed: largest speed at which the goal is followed [rad/s].
        goal_filter: time constant of the filter on the goal's derivative [s].
    """

    name = "position_servo"
    stage = Stage.CONTROLLER
    equation = "V = V_bus clip(c kp g (goal - q) + kd (d goal/dt - w), -d_max, d_max)"
    source = "Feetech STS3032 and Dynamixel XL330 as recorded on Rhoban's servo bench"
    memory = ("goal", "goal_rate")
    constants = ("stride", "forget")
    commands = ("firmware_gain",)
    parameters = (
        Parameter("controller_gain", "-", 0.2, 1.4, 1.0, 1.0, "factor c on the firmware's nominal gain"),
        Parameter("derivative_gain", "s/rad", 0.0, 0.06, 0.0, 0.0, "duty per rad/s of the error's rate, kd"),
    )
    secants = ({"controller_gain": 0.1}, {"derivative_gain": 0.005})
    fingerprint = "proportional to the position error, in the duty as well as in the torque"
    confounders = ("encoder_offset", "torque_constant", "minimum_duty")
    separating_experiment = "readings of the duty register at two gains, while holding a known weight"
    scopes = ("joint", "shared")

    error_gain: float = 0.166
    max_duty: float = 0.97
    goal_speed: float = 34.0
    goal_filter: float = 0.006

    @staticmethod
    def prepare(p):
        """Change of the followed goal in a step, and decay of its filter."""
        p.position_servo_stride = p.position_servo_goal_speed * p.timestep
        p.position_servo_forget = 1.0 - exp(-p.timestep / p.position_servo_goal_filter)

    @staticmethod
    def reset(s, p):
        """The followed goal starts at rest at the first commanded goal."""
        s.position_servo_goal, s.position_servo_goal_rate = s.position_target, 0.0

    @staticmethod
    def apply(s, p):
        move = clip(s.goal - s.position_servo_goal, -p.position_servo_stride, p.position_servo_stride)
        s.position_servo_goal += move
        s.position_servo_goal_rate += p.position_servo_forget * (move / p.timestep - s.position_servo_goal_rate)
        gain = s.firmware_gain * (p.controller_gain * p.position_servo_error_gain)
        duty = gain * (s.position_servo_goal - s.measured_position)
        duty += p.derivative_gain * (s.position_servo_goal_rate - s.measured_velocity)
        s.duty = clip(duty, -p.position_servo_max_duty, p.position_servo_max_duty)
        s.voltage = s.duty * s.bus_voltage


@register
class MinimumDuty(Effect):
    """Firmware or driver that raises small duties, so that the motor overcomes its friction.

    It acts after the PWM register, so the servo reports the duty before it. It does not apply to servos that regulate
    current.
    """

    name = "minimum_duty"
    stage = Stage.DRIVER
    equation = "V += V_bus d0 sign(V) (1 - exp(-|V| / (V_bus d1))), |V| <= V_bus"
    source = "start-up duty (Feetech's memory table, minimum startup force); shape from Rhoban's servo bench"
    parameters = (
        Parameter("minimum_duty", "-", 0.0, 0.15, 0.03, 0.0, "duty added, d0", least=0.0),
        Parameter("minimum_duty_fade", "-", 0.01, 0.3, 0.08, None, "duty at which 63 % of d0 is added, d1", least=1e-4),
    )
    secants = ({"minimum_duty": 0.02, "minimum_duty_fade": 0.03}, {"minimum_duty": 0.02, "minimum_duty_fade": 0.15})
    fingerprint = "has the sign of the duty; rises from zero duty to a constant value, and vanishes at full duty"
    confounders = ("coulomb", "stribeck", "terminal_resistance")
    separating_experiment = "small steps of the goal from rest at two bus voltages"
    scopes = ("joint", "shared")

    @staticmethod
    def apply(s, p):
        s.voltage = lifted_voltage(s.voltage, s.bus_voltage, p.minimum_duty, p.minimum_duty_fade)
