"""Readings of a stand-in robot's sensors: filtered, noisy and quantised to register units.

Units: XM430-W350 control table and OpenCR's IMU registers (ROBOTIS e-Manual).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from op3.robot.kinematics import roll_pitch_yaw
from op3.robot.register_units import ACCELERATION_UNIT, ANGLE_UNIT, GYRO_UNIT
from op3.stand_in.integration import TICK
from op3.stand_in.world import HiddenWorld

IMU_EVERY = 5
"""The IMU's registers change every 5 ms, its loop running at 200 Hz [ticks]."""

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sensors:
    """One reading of all registers, in SI units but on the registers' grids.

    Attributes:
        position: [joint] in rad.
        velocity: [joint] in rad/s.
        current: [joint] in A.
        voltage: [joint] in V.
        temperature: [joint] in C.
        orientation: [3] roll, pitch, yaw in rad, R = Rz(yaw) Ry(pitch) Rx(roll); None without an IMU.
        angular_velocity: [3] in rad/s in the trunk's frame; None without an IMU.
        linear_acceleration: [3] specific force in m/s^2 in the trunk's frame; None without an IMU.
    """

    position: Array
    velocity: Array
    current: Array
    voltage: Array
    temperature: Array
    orientation: Array | None = None
    angular_velocity: Array | None = None
    linear_acceleration: Array | None = None


def quantise(value: Array, unit: float | Array) -> Array:
    """A value rounded to an integer number of units."""
    return np.round(value / unit) * unit


class Imu:
    """Gyro and accelerometer with bias, noise and low-pass, attitude from a settled filter."""

    def __init__(self, world: HiddenWorld):
        self._blend = 1 - np.exp(-2 * np.pi * world.imu_bandwidth * TICK)
        self._noise = np.repeat([world.gyro_noise, world.accelerometer_noise], 3)
        bias = world.gyro_bias * np.random.default_rng([world.spread_seed, 4]).standard_normal(3)
        self._bias = np.concatenate([bias, np.zeros(3)])
        self._filtered = np.zeros(6)
        self._age = 0
        self.orientation = np.zeros(3)
        self.rates_and_force = np.zeros(6)

    def reset(self, quaternion: Array, specific_force: Array) -> None:
        """Initialise after a long rest."""
        self._filtered[:] = self._bias
        self._filtered[3:] += specific_force
        self._age = 0
        self._latch(quaternion)

    def step(self, quaternion: Array, rates: Array, specific_force: Array, rng: np.random.Generator) -> None:
        """Take the true motion after `TICK`; the registers follow every `IMU_EVERY` calls."""
        raw = self._noise * rng.standard_normal(6)
        raw += self._bias
        raw[:3] += rates
        raw[3:] += specific_force
        raw -= self._filtered
        raw *= self._blend
        self._filtered += raw
        self._age += 1
        if self._age % IMU_EVERY == 0:
            self._latch(quaternion)

    def _latch(self, quaternion: Array) -> None:
        self.orientation = quantise(roll_pitch_yaw(quaternion), ANGLE_UNIT)
        gyro = quantise(self._filtered[:3], GYRO_UNIT)
        counts = np.clip(np.round(self._filtered[3:] / ACCELERATION_UNIT), -32768, 32767)
        self.rates_and_force = np.concatenate([gyro, counts * ACCELERATION_UNIT])
