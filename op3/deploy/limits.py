"""From targets to currents that a servo may carry: PD, soft joint limits, peak and continuous current.

A servo in current mode enforces no position limit, so all of this is the software's job. The peak limits are
written into the servos' own current limit as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.state import State
from op3.robot import JOINTS, SOFT_LIMITS
from op3.robot.units import CONTINUOUS_CURRENT_COUNTS, CURRENT_UNIT
from op3.settings import Count, NotNegative, Positive, Whole, settings

Array = NDArray[np.float64]

LOW, HIGH = np.array([SOFT_LIMITS[name] for name in JOINTS]).T
"""Soft limits of all joints [joint] in rad."""

_LEG_PARTS = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ank_pitch", "ank_roll")
IS_LEG = np.array([name[2:] in _LEG_PARTS for name in JOINTS])
"""[joint] True for the twelve joints of the legs."""


PeakCounts = Annotated[Count, Field(le=1193)]
"""A goal current that the servo's register takes [2.69 mA]."""


@settings("limits")
class Limits:
    """What the robot may do.

    Attributes:
        leg_current_counts: largest goal current of a leg joint [2.69 mA]; 855 is the stall current 2.3 A at 12 V.
        arm_current_counts: of an arm or head joint [2.69 mA].
        continuous_current_counts: what a servo carries for ever [2.69 mA]; 171 is a fifth of the stall current.
        thermal_time: time constant with which the mean square of the current is formed [s].
        temperature: a servo at or above this ends the run [C].
        voltage: a supply at or below this ends the run [V].
        start_voltage: a supply below this is not switched on [V].
        fall_angle_deg: roll or pitch beyond this [deg] ...
        fall_time: ... for this long ends the run [s].
        coast_ticks: how many ticks a servo or the IMU may stay silent before the joints are damped.
        loss_time: how long one may stay silent before torque goes off [s].
        imu_repeats: how many identical IMU blocks in a row mean that it is dead.
        homing_offset: largest homing offset that a servo may have [counts], for a robot that was calibrated with it.
        damp_gain: D gain of a damped joint [A s/rad].
        damp_time: how long joints are damped before torque goes off [s].
    """

    leg_current_counts: PeakCounts = 855
    arm_current_counts: PeakCounts = 430
    continuous_current_counts: Count = CONTINUOUS_CURRENT_COUNTS
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

    def __post_init__(self):
        for name in ("leg_current_counts", "arm_current_counts"):
            if getattr(self, name) < self.continuous_current_counts:
                low = self.continuous_current_counts
                raise ValueError(
                    f"limits: {name} must be at least continuous_current_counts ({low}), got {getattr(self, name)}"
                )
        if self.start_voltage < self.voltage:
            raise ValueError(f"limits: start_voltage {self.start_voltage} V lies below voltage {self.voltage} V")

    @property
    def peak(self) -> Array:
        """Peak goal current [joint] in counts."""
        return np.where(IS_LEG, float(self.leg_current_counts), float(self.arm_current_counts))


@dataclass(frozen=True, eq=False)
class Command:
    """What the PD is asked for.

    Attributes:
        position: target [joint] in rad.
        p_gain: [joint] in A/rad.
        d_gain: [joint] in A s/rad.
    """

    position: Array
    p_gain: Array
    d_gain: Array

    @classmethod
    def of(cls, position: ArrayLike, p_gain: ArrayLike, d_gain: ArrayLike) -> Command:
        """Broadcast numbers or arrays to all joints."""
        count = len(JOINTS)
        values = (
            np.broadcast_to(np.asarray(value, dtype=float), (count,)).copy() for value in (position, p_gain, d_gain)
        )
        return cls(*values)

    def limited(self) -> Command:
        """The same with targets inside the soft limits.

        Raises:
            Stop: if a number is not finite or a gain is negative; nothing of it may reach a servo.
        """
        for name in ("position", "p_gain", "d_gain"):
            values = getattr(self, name)
            bad = ~np.isfinite(values) | ((values < 0) if name != "position" else False)
            if bad.any():
                joint = int(np.flatnonzero(bad)[0])
                raise Stop(ExitCode.NON_FINITE, f"{name} of {JOINTS[joint]} is {values[joint]}; refused", damp=True)
        return Command(self.position.clip(LOW, HIGH), self.p_gain, self.d_gain)

    def damped(self, d_gain: float) -> Command:
        """The same without stiffness: only damping."""
        return Command(self.position, np.zeros_like(self.p_gain), np.full_like(self.d_gain, d_gain))


class CurrentLimiter:
    """Turns commands into goal currents and keeps account of what the servos have carried.

    The mean square of each current is followed with `Limits.thermal_time`. As it approaches the square of the
    continuous current, the limit sinks from peak to continuous, so that a joint that is overloaded gets weaker
    instead of hotter.
    """

    def __init__(self, limits: Limits, period: float, scale: float = 1.0):
        self._peak = np.maximum(scale * limits.peak, limits.continuous_current_counts)
        self._continuous = float(limits.continuous_current_counts)
        self._blend = 1 - np.exp(-period / limits.thermal_time)
        self._mean_square = np.zeros(len(JOINTS))

    @property
    def load(self) -> Array:
        """[joint] mean square current over the continuous one's square; 1 is all that is allowed for ever."""
        return self._mean_square / self._continuous**2

    @property
    def limit(self) -> Array:
        """[joint] largest goal current now, in counts. It sinks linearly while the load goes from 0.9 to 1."""
        share = ((1 - self.load) / 0.1).clip(0, 1)
        return self._continuous + share * (self._peak - self._continuous)

    def counts(self, state: State, command: Command) -> NDArray[np.int64]:
        """Goal currents [joint] in counts: I* = Kp (q* - q) - Kd dq, within every limit.

        Raises:
            Stop: if a current is not finite.
        """
        current = command.p_gain * (command.position - state.position) - command.d_gain * state.velocity
        if not np.isfinite(current).all():
            joint = int(np.flatnonzero(~np.isfinite(current))[0])
            raise Stop(ExitCode.NON_FINITE, f"the current of {JOINTS[joint]} is {current[joint]}; refused", damp=True)
        limit = np.floor(self.limit)
        counts = np.round(current / CURRENT_UNIT).clip(-limit, limit)
        # Beyond a soft limit only the way back is allowed.
        counts = np.where(state.position > HIGH, np.minimum(counts, 0), counts)
        counts = np.where(state.position < LOW, np.maximum(counts, 0), counts)
        return counts.astype(np.int64)

    def account(self, written: NDArray[np.int64], state: State) -> None:
        """Add one period with these goal currents [joint]; the larger of goal and measured current counts."""
        carried = np.maximum(np.abs(written), np.abs(state.counts.current)).astype(float)
        self._mean_square += self._blend * (carried**2 - self._mean_square)
