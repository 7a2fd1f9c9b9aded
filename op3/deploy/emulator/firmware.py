"""The control loops inside the servos, all at once: from goals to what the drivers do in the next millisecond.

Current control asks the driver for a current. The other modes set a duty cycle: position by
``PWM = P/128 e + I/65536 sum(e) + D/16 de`` with the error e in counts, velocity by ``P/128 e + I/65536 sum(e)`` with
e in velocity units (ROBOTIS e-Manual, "Position PID Gain", "Velocity PI Gain"); sums and differences per millisecond
(inferred: the manual gives no rate). Current-based position control limits the position loop by the goal current.
Feedforward gains and the profile's acceleration are stored and do nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from op3.deploy.registers import POSITION_ZERO, PWM_UNIT, OperatingMode, Units

PERIOD = 0.001
"""Period of the servos' own loops [s] (inferred: the register `realtime_tick` counts in it)."""

Array = NDArray[np.float64]


@dataclass(eq=False)
class Drive:
    """What the drivers do until told otherwise, each [joint].

    Attributes:
        enabled: whether the motor is driven at all; otherwise it runs free.
        current: goal current [A], where the driver regulates current.
        duty: duty cycle, -1 to 1, where the driver applies a voltage.
        voltage: whether the driver applies a voltage instead of regulating current.
        limit: current that such a driver does not exceed [A]; infinite for no bound.
    """

    enabled: NDArray[np.bool_]
    current: Array
    duty: Array
    voltage: NDArray[np.bool_]
    limit: Array


class Firmware:
    """The control loops of servos with these units.

    Attributes:
        enabled: [servo], whether torque is on and nothing keeps the servo from using it.
        looping: whether some servo closes a loop of its own, so that `step` must run every `PERIOD`.
        changed: whether the drive has changed since it was last taken.
        loads: how often registers have been taken; tells whether something has been written besides goal currents.
    """

    def __init__(self, units: Units):
        count, self._units = len(units.current), units
        self.enabled = np.zeros(count, dtype=bool)
        self.looping = False
        self.changed = True
        self.loads = 0
        self._mode = np.full(count, OperatingMode.POSITION)
        self._goal_current, self._goal_pwm, self._goal_velocity, self._goal_position = np.zeros((4, count))
        self._current_bound, self._profile_velocity = np.zeros((2, count))
        self._gains = np.zeros((5, count))
        self._followed, self._sum, self._last_error = np.zeros((3, count))
        self._fresh = np.ones(count, dtype=bool)
        none = np.zeros(count)
        self.drive = Drive(self.enabled, none.copy(), none.copy(), np.zeros(count, dtype=bool), np.full(count, np.inf))

    def load(self, index: int, get: Callable[[str], int], *, tripped: bool) -> None:
        """Take a servo's registers; `tripped` frees it whatever they say."""
        enabled = bool(get("torque_enable")) and not tripped
        mode = get("operating_mode")
        if enabled and (not self.enabled[index] or mode != self._mode[index]):
            self._fresh[index] = True
        self.enabled[index] = enabled
        self._mode[index] = mode
        bound = get("current_limit")
        self._goal_current[index] = max(-bound, min(bound, get("goal_current")))
        self._current_bound[index] = bound
        for name in ("goal_pwm", "goal_velocity", "goal_position", "profile_velocity"):
            getattr(self, f"_{name}")[index] = get(name)
        self._gains[:, index] = (
            get("position_p_gain") / 128,
            get("position_i_gain") / 65536,
            get("position_d_gain") / 16,
            get("velocity_p_gain") / 128,
            get("velocity_i_gain") / 65536,
        )
        self._settle()

    def set_goal_current(self, index: int, value: int) -> None:
        """The short way for the one register that changes in every tick."""
        bound = self._current_bound[index]
        self._goal_current[index] = max(-bound, min(bound, value))
        self.drive.current[index] = self._goal_current[index] * self._units.current[index]
        self.changed = True

    def _settle(self) -> None:
        drive, mode = self.drive, self._mode
        self.changed = True
        self.loads += 1
        drive.voltage[:] = mode != OperatingMode.CURRENT
        drive.current[:] = self._goal_current * self._units.current
        by_current = mode == OperatingMode.CURRENT_BASED_POSITION
        drive.limit[:] = np.where(by_current, np.abs(self._goal_current), self._current_bound) * self._units.current
        self.looping = bool((self.enabled & drive.voltage).any())

    def step(self, position: Array, velocity: Array) -> None:
        """One cycle of the loops at positions [servo] in rad and velocities [servo] in rad/s."""
        mode, (p, i, d, vp, vi) = self._mode, self._gains
        counts = np.round(position / self._units.position) + POSITION_ZERO
        units = np.round(velocity / self._units.velocity)
        speed = mode == OperatingMode.VELOCITY
        self._followed[:] = np.where(self._fresh, counts, self._followed)
        stride = self._profile_velocity * self._units.velocity * PERIOD / self._units.position
        step = self._goal_position - self._followed
        self._followed += np.where(self._profile_velocity > 0, np.clip(step, -stride, stride), step)
        error = np.where(speed, self._goal_velocity - units, self._followed - counts)
        self._last_error[:] = np.where(self._fresh, error, self._last_error)
        self._sum[:] = np.where(self._fresh, 0.0, self._sum)
        rate = error - self._last_error
        total = self._sum + error
        wanted = np.where(speed, vp * error + vi * total, p * error + i * total + d * rate)
        wanted = np.where(mode == OperatingMode.PWM, self._goal_pwm, wanted)
        bound = np.abs(self._goal_pwm)
        # no windup: the sum stands still while the output is at its bound
        self._sum[:] = np.where(np.abs(wanted) < bound, total, self._sum)
        self._last_error[:] = error
        self._fresh[:] = False
        self.drive.duty[:] = np.clip(wanted, -bound, bound) * PWM_UNIT
        self.changed = True
