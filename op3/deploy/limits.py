"""From targets to allowed servo currents: PD, soft joint limits, peak and continuous current.

A servo in current mode enforces no position limit, so the software must. The peak limits are also written into the
servos' current limit registers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from op3.common.settings import Count, NotNegative, Positive, Whole, settings
from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.registers import DYNAMIXEL_X, Units
from op3.deploy.robot_state import RobotState
from op3.policy.actions import GAIN_HIGH
from op3.robot import Robot
from op3.robot.self_collision import LARGEST_OVERLAP, LARGEST_OVERLAP_AHEAD

Array = NDArray[np.float64]
HIGHEST = DYNAMIXEL_X["goal_current"].high or 0


@settings("limits")
class Limits:
    """Limits of a run.

    Attributes:
        peak_current: largest goal current of any joint [A]; None: each joint's value in the robot file.
        continuous_current: continuous current rating of a servo [A]; None: the value in the servo's file.
        p_gain: largest P gain that a policy may command [A/rad].
        thermal_time: time constant of the mean square current [s].
        temperature: a servo at or above this ends the run [C].
        voltage: a supply at or below this ends the run [V].
        start_voltage: a supply below this is not switched on [V].
        fall_angle_deg: roll or pitch beyond which the robot falls [deg].
        fall_time: time beyond that angle after which the run ends [s].
        coast_ticks: number of ticks without an answer of a servo or the IMU before the joints are damped.
        loss_time: time without an answer before torque is switched off [s].
        imu_repeats: number of identical IMU blocks in a row after which the IMU counts as frozen.
        homing_offset: largest accepted homing offset of a servo [counts], for a robot calibrated with such an offset.
        damp_gain: D gain of a damped joint [A s/rad].
        damp_time: time for which joints are damped before torque is switched off [s].
        overlap: allowed overlap of parts of the robot at the measured angles [m].
        overlap_ahead: allowed overlap predicted 16 ms ahead, or at the commanded angles, see `SelfCollision` [m].
    """

    peak_current: Positive | None = None
    continuous_current: Positive | None = None
    p_gain: Positive = GAIN_HIGH
    thermal_time: Positive = 60.0
    temperature: Positive = 72.0
    voltage: Positive = 10.0
    start_voltage: Positive = 10.5
    fall_angle_deg: Positive = 45.0
    fall_time: Positive = 0.1
    coast_ticks: Whole = 3
    loss_time: Positive = 0.096
    imu_repeats: Annotated[Count, Field(ge=2)] = 25
    homing_offset: Whole = 0
    damp_gain: NotNegative = 0.2
    damp_time: NotNegative = 0.5
    overlap: NotNegative = LARGEST_OVERLAP
    overlap_ahead: NotNegative = LARGEST_OVERLAP_AHEAD

    def __post_init__(self):
        if self.start_voltage < self.voltage:
            raise ValueError(f"limits: start_voltage {self.start_voltage} V is below voltage {self.voltage} V")

    def currents(self, robot: Robot) -> tuple[Array, Array]:
        """Peak and continuous goal current [joint] in counts.

        Raises:
            ValueError: if a peak is below the continuous rating or exceeds the register's range.
        """
        units = Units(robot)
        peak = units.peak if self.peak_current is None else self.peak_current / units.current
        carried = units.continuous if self.continuous_current is None else self.continuous_current / units.current
        peak, continuous = np.floor(peak + 1e-9), np.round(carried)
        wrong = (peak < continuous) | (peak > HIGHEST)
        if wrong.any():
            joint = int(wrong.argmax())
            low, high = units.current[joint] * continuous[joint], units.current[joint] * HIGHEST
            raise ValueError(
                f"limits: the peak current of {robot.joints[joint]} must be at least continuous_current ({low:.3g} A)"
                f" and at most {high:.3g} A, got {peak[joint] * units.current[joint]:.3g} A"
            )
        return peak, continuous


@dataclass(frozen=True, eq=False)
class Command:
    """Inputs of the PD, each [joint]: targets [rad], P gains [A/rad] and D gains [A s/rad]."""

    position: Array
    p_gain: Array
    d_gain: Array

    @classmethod
    def of(cls, position: ArrayLike, p_gain: ArrayLike, d_gain: ArrayLike) -> Command:
        """Expand gains that are single numbers to all joints."""
        position = np.array(position, dtype=float)
        gains = (np.broadcast_to(np.asarray(gain, dtype=float), position.shape).copy() for gain in (p_gain, d_gain))
        return cls(position, *gains)

    def limited(self, robot: Robot) -> Command:
        """This command with targets clipped to the soft limits; raises `Stop` for non-finite numbers or negative
        gains."""
        for name, values in vars(self).items():
            refuse(robot, name, values, ~np.isfinite(values) | ((values < 0) if name != "position" else False))
        return Command(self.position.clip(*robot.limits.T), self.p_gain, self.d_gain)

    def damped(self, d_gain: float) -> Command:
        """This command with zero P gains, so that joints are only damped."""
        return Command.of(self.position, 0.0, d_gain)


def refuse(robot: Robot, name: str, values: Array, bad: NDArray[np.bool_]) -> None:
    """End the run if a value [joint] is invalid, and name it."""
    if bad.any():
        joint = int(np.flatnonzero(bad)[0])
        reason = f"{name} of {robot.joints[joint]} is {values[joint]}; refused"
        raise Stop(ExitCode.NON_FINITE, reason, damp=True)


class CurrentLimiter:
    """Converts commands to goal currents, and tracks the load of the servos.

    The mean square of each current is filtered with the time constant `Limits.thermal_time`. As it approaches the
    square of the continuous current, the limit decreases from peak to continuous, so that an overloaded joint becomes
    weaker instead of hotter.
    """

    def __init__(self, limits: Limits, robot: Robot, period: float, scale: float = 1.0):
        peak, continuous = limits.currents(robot)
        self._robot, self._unit = robot, Units(robot).current
        self._peak = scale * peak
        self._continuous = np.minimum(continuous, self._peak)
        self._blend = 1 - np.exp(-period / limits.thermal_time)
        self._mean_square = np.zeros(len(robot.joints))

    @property
    def load(self) -> Array:
        """[joint] mean square current relative to the squared continuous current; 1 is the continuous rating."""
        return self._mean_square / self._continuous**2

    @property
    def limit(self) -> Array:
        """[joint] present limit of the goal current in counts, decreasing linearly for loads from 0.9 to 1."""
        share = ((1 - self.load) / 0.1).clip(0, 1)
        return self._continuous + share * (self._peak - self._continuous)

    def counts(self, state: RobotState, command: Command) -> NDArray[np.int64]:
        """Goal currents [joint] in counts: I* = Kp (q* - q) - Kd dq, within all limits; raises `Stop` if one is not
        finite."""
        current = command.p_gain * (command.position - state.position) - command.d_gain * state.velocity
        refuse(self._robot, "the current", current, ~np.isfinite(current))
        limit, (low, high) = np.floor(self.limit), self._robot.limits.T
        counts = np.round(current / self._unit).clip(-limit, limit)
        # Beyond a soft limit only motion back is allowed.
        counts = np.where(state.position > high, np.minimum(counts, 0), counts)
        counts = np.where(state.position < low, np.maximum(counts, 0), counts)
        return counts.astype(np.int64)

    def account(self, written: NDArray[np.int64], state: RobotState) -> None:
        """Add one period with these goal currents [joint], using the larger of goal and measured current."""
        carried = np.maximum(np.abs(written), np.abs(state.raw["current"])).astype(float)
        self._mean_square += self._blend * (carried**2 - self._mean_square)
