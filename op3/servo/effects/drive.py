"""Who closes the position loop, and how late its commands arrive."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import ceil, exp
from typing import ClassVar, Literal

import torch
from torch import Tensor

from op3.servo import law
from op3.servo.effect import Clock, Effect, Parameter, Prepared, Scope, Signals, Stage, register


@register
@dataclass(frozen=True)
class CurrentPD(Effect):
    """Variable-gain PD on the robot's computer, commanding current, held between control ticks.

    Attributes:
        current_limit: the servo clips target currents at this value [A].
        resolution: step of the register that takes the target current [A]; 0 for none.
    """

    name: ClassVar[str] = "current_pd"
    stage: ClassVar[Stage] = Stage.COMMAND
    equation: ClassVar[str] = "I* = clip(Kp (q* - q) - Kd w, -I_max, I_max)"
    source: ClassVar[str] = "paper, section 'Variable Gain PD'; stall current 2.3 A at 12 V, ROBOTIS e-Manual"
    commands: ClassVar[tuple[str, ...]] = ("p_gain", "d_gain")

    current_limit: float = 2.3
    resolution: float = 0.0

    def tick(self, signals: Signals, prepared: Prepared) -> None:
        """Compute the current command from the sensors of this tick."""
        current = law.pd_current(
            signals.position_target,
            signals.measured_position,
            signals.measured_velocity,
            signals.p_gain,
            signals.d_gain,
        )
        if self.resolution > 0.0:
            current = torch.round(current / self.resolution) * self.resolution
        signals.target_current = current.clamp(-self.current_limit, self.current_limit) * signals.torque_enable


@register
@dataclass(frozen=True)
class Latency(Effect):
    """Commands act late by a constant time, which need not be a whole number of steps.

    Attributes:
        longest: largest latency the memory is made for [s].
        signal: what is late: the current of a current-driven servo, or the goal of a position servo.
    """

    name: ClassVar[str] = "latency"
    stage: ClassVar[Stage] = Stage.TRANSPORT
    equation: ClassVar[str] = "u(t) -> u(t - d)"
    source: ClassVar[str] = "sensor to torque on a 2 Mbit/s bus: about 6 ms sequential, 10 ms pipelined"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("command_latency", "s", 0.0, 0.016, 0.006, 0.0, "time from reading sensors to torque", least=0.0),
    )
    size: ClassVar[str] = "command_latency"
    smallest: ClassVar[float] = 0.0005
    secants: ClassVar[tuple[Mapping[str, float], ...]] = (
        {"command_latency": 0.001},
        {"command_latency": -0.001},
        {"command_latency": 0.004},
    )
    fingerprint: ClassVar[str] = (
        "in proportion to the rate of the command; a shift of the same length at every frequency"
    )
    confounders: ClassVar[tuple[str, ...]] = ("current_lag", "velocity_filter", "packet_drop")
    separating_experiment: ClassVar[str] = (
        "chirp of the command above 20 Hz: a shift has linear phase, a lag rolls off; low and high gain"
    )
    alias_class: ClassVar[str] = "timing"
    scopes: ClassVar[tuple[Scope, ...]] = ("shared", "joint")

    longest: float = 0.024
    signal: Literal["target_current", "goal"] = "target_current"

    def __post_init__(self):
        # so that no fit asks for more than the memory holds
        known = tuple(replace(known, most=self.longest) for known in type(self).parameters)
        object.__setattr__(self, "parameters", known)

    def prepare(self, values: Mapping[str, Tensor], clock: Clock) -> Prepared:
        """Weights of past commands for each step of the period.

        Raises:
            ValueError: if a latency is negative or longer than the memory.
        """
        latency = values["command_latency"]
        if latency.min() < 0 or latency.max() > self.longest:
            raise ValueError(
                f"command_latency must lie in [0, {self.longest}] s, got {latency.min():g} to {latency.max():g};"
                " raise the option `longest` of the effect `latency` for slower buses"
            )
        depth = ceil(self.longest / clock.period - 1e-9) + 1
        weights = law.delay_weights(latency, clock.timestep, clock.period, depth)
        last = law.last_arrivals(weights)
        return {"weights": weights, "last": last, "since": (weights * last).sum(1)}

    def reset(self, signals: Signals, prepared: Prepared) -> None:
        """Before the start, the first command was already held."""
        first = getattr(signals, self.signal)
        signals.state[self.name] = law.stacked(*[first] * prepared["weights"].shape[1])
        if self.signal == "target_current":
            signals.state[law.ARRIVED] = law.stacked(torch.zeros_like(first), torch.ones_like(first))

    def tick(self, signals: Signals, prepared: Prepared) -> None:
        """Put the new command in front of the older ones."""
        older = signals.state[self.name][:-1].unbind()
        signals.state[self.name] = law.stacked(getattr(signals, self.signal), *older)

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Let through the mean over the step of what has arrived."""
        held = signals.state[self.name]
        arrived = (law.at_phase(prepared["weights"], signals.phase) * held).sum(0)
        setattr(signals, self.signal, arrived)
        if self.signal == "target_current":
            last = (law.at_phase(prepared["last"], signals.phase) * held).sum(0)
            since = law.at_phase(prepared["since"], signals.phase)
            signals.state[law.ARRIVED] = law.stacked(last - arrived, since.expand_as(arrived))


@register
@dataclass(frozen=True)
class PositionServo(Effect):
    """A servo's own position loop, which sets the duty cycle of its driver once per simulation step.

    Attributes:
        error_gain: duty per radian of error and unit of the firmware's kp.
        max_duty: largest duty cycle.
        goal_speed: the goal is followed at no more than this speed [rad/s].
        goal_filter: time constant of the filter on the goal's derivative [s].
    """

    name: ClassVar[str] = "position_servo"
    stage: ClassVar[Stage] = Stage.CONTROLLER
    equation: ClassVar[str] = "V = V_bus clip(c kp g (goal - q) + kd (d goal/dt - w), -d_max, d_max)"
    source: ClassVar[str] = "Feetech STS3032 and Dynamixel XL330 as recorded on Rhoban's servo bench"
    commands: ClassVar[tuple[str, ...]] = ("firmware_gain",)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("controller_gain", "-", 0.6, 1.4, 1.0, 1.0, "factor c on the firmware's nominal gain"),
        Parameter("derivative_gain", "s/rad", 0.0, 0.06, 0.0, 0.0, "duty per rad/s of the error's rate, kd"),
    )
    size: ClassVar[str] = "controller_gain"
    smallest: ClassVar[float] = 0.02
    secants: ClassVar[tuple[Mapping[str, float], ...]] = ({"controller_gain": 0.1}, {"derivative_gain": 0.005})
    fingerprint: ClassVar[str] = "in proportion to the position error, in the duty as well as in the torque"
    confounders: ClassVar[tuple[str, ...]] = ("encoder_offset", "torque_constant", "minimum_duty")
    separating_experiment: ClassVar[str] = "read the duty register: two gains, a hold against a known weight"
    alias_class: ClassVar[str] = "controller"
    scopes: ClassVar[tuple[Scope, ...]] = ("shared", "joint")

    error_gain: float = 0.166
    max_duty: float = 0.97
    goal_speed: float = 34.0
    goal_filter: float = 0.006

    def prepare(self, values: Mapping[str, Tensor], clock: Clock) -> Prepared:
        """Gains, and how far the followed goal moves and its filter forgets in a step."""
        gain = values["controller_gain"] * self.error_gain
        return {
            "gain": gain,
            "derivative_gain": values["derivative_gain"],
            "stride": torch.tensor(self.goal_speed * clock.timestep, dtype=gain.dtype),
            "forget": torch.tensor(1.0 - exp(-clock.timestep / self.goal_filter), dtype=gain.dtype),
            "timestep": torch.tensor(clock.timestep, dtype=gain.dtype),
        }

    def reset(self, signals: Signals, prepared: Prepared) -> None:
        """The goal followed so far is the first one commanded, and it rests."""
        signals.state["followed_goal"] = signals.position_target.clone()
        signals.state["goal_rate"] = torch.zeros_like(signals.position_target)

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Follow the goal and set the voltage."""
        move = torch.clamp(signals.goal - signals.state["followed_goal"], -prepared["stride"], prepared["stride"])
        followed = signals.state["followed_goal"] + move
        rate = signals.state["goal_rate"]
        rate = rate + prepared["forget"] * (move / prepared["timestep"] - rate)
        signals.state["followed_goal"], signals.state["goal_rate"] = followed, rate
        duty = law.position_duty(
            followed - signals.measured_position,
            rate - signals.measured_velocity,
            signals.firmware_gain * prepared["gain"],
            prepared["derivative_gain"],
            self.max_duty,
        )
        signals.duty = duty
        signals.voltage = duty * signals.bus_voltage


@register
@dataclass(frozen=True)
class MinimumDuty(Effect):
    """Firmware or driver that raises small duties, so that the motor starts in spite of its friction.

    It acts behind the PWM register: the duty that the servo reports is the one before. It has no meaning for a servo
    that regulates current.
    """

    name: ClassVar[str] = "minimum_duty"
    stage: ClassVar[Stage] = Stage.DRIVER
    equation: ClassVar[str] = "V += V_bus d0 sign(V) (1 - exp(-|V| / (V_bus d1))), |V| <= V_bus"
    source: ClassVar[str] = (
        "start-up duty of the Feetech STS3032 (its registers have one); seen on Rhoban's servo bench"
    )
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("minimum_duty", "-", 0.0, 0.15, 0.03, 0.0, "duty added, d0", least=0.0),
        Parameter("minimum_duty_fade", "-", 0.01, 0.3, 0.08, None, "duty over which the lift sets in, d1", least=1e-4),
    )
    size: ClassVar[str] = "minimum_duty"
    smallest: ClassVar[float] = 0.005
    secants: ClassVar[tuple[Mapping[str, float], ...]] = (
        {"minimum_duty": 0.02, "minimum_duty_fade": 0.03},
        {"minimum_duty": 0.02, "minimum_duty_fade": 0.15},
    )
    fingerprint: ClassVar[str] = "in proportion to the sign of the duty near zero duty, none at large duties"
    confounders: ClassVar[tuple[str, ...]] = ("coulomb", "stribeck", "terminal_resistance")
    separating_experiment: ClassVar[str] = "small steps of the goal around rest at two bus voltages"
    alias_class: ClassVar[str] = "supply"
    scopes: ClassVar[tuple[Scope, ...]] = ("shared", "joint")

    def apply(self, signals: Signals, prepared: Prepared) -> None:
        """Raise the voltage."""
        signals.voltage = law.lifted_voltage(
            signals.voltage, signals.bus_voltage, prepared["minimum_duty"], prepared["minimum_duty_fade"]
        )
