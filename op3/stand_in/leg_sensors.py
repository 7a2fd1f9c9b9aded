"""The sensors of a leg's servos, or of all of a robot's, for all runs of a case at once."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from op3.robot.units import CURRENT_UNIT, POSITION_UNIT, TEMPERATURE_UNIT, VELOCITY_UNIT, VOLTAGE_UNIT
from op3.stand_in.leg_effects import places
from op3.stand_in.leg_servos import LegServos, LegTruth
from op3.stand_in.sensors import quantise
from op3.stand_in.servos import SLOW_PERIOD

Array = NDArray[np.float64]


class LegSensors:
    """Readings [run, joint] in SI units on the registers' grids.

    Args:
        truth: of the leg.
        runs: number of runs.
    """

    def __init__(self, truth: LegTruth, runs: int):
        self.truth = truth
        shape = (runs, len(truth.joints))
        self._blend = 1 - np.exp(-SLOW_PERIOD / truth.world.velocity_lag)
        self._velocity = np.zeros(shape)
        self._slower = np.zeros(shape)
        self._second = truth.find("velocity_filter")
        self._past: deque[Array] = deque()
        self._offset = truth.find("encoder_offset")
        self._bent = truth.find("encoder_nonlinearity")

    def reset(self) -> None:
        """At rest."""
        for array in (self._velocity, self._slower):
            array[:] = 0
        self._past.clear()
        if self._second is not None and self._second.form == "mean":
            # a mean over 2 T has the delay of a first-order lag of T
            self._past.extend(np.zeros_like(self._slower) for _ in range(max(1, round(2 * self._second.size * 1000))))

    def step(self, position: Array, velocity: Array) -> None:
        """Take the true position [run, joint] in rad and velocity in rad/s after `SLOW_PERIOD`."""
        self._velocity += self._blend * (self._speed(position, velocity) - self._velocity)
        if self._second is None:
            return
        if self._second.form == "mean":
            self._slower += (self._velocity - self._past.popleft()) / (len(self._past) + 1)
            self._past.append(self._velocity.copy())
        else:
            self._slower += (1 - np.exp(-SLOW_PERIOD / self._second.size)) * (self._velocity - self._slower)

    def encoder(self, position: Array) -> Array:
        """What the encoders say before rounding [run, joint] in rad."""
        reading = position
        if self._offset is not None:
            reading = reading + self._offset.size * places(self._offset, self.truth.joints)
        if self._bent is not None:
            phase = 2 * np.pi * self._bent.shape[0]
            wave = np.sin(position + phase) + 0.3 * np.sin(2 * position + 2 * phase)
            reading = reading + self._bent.size * places(self._bent, self.truth.joints) * wave
        return reading

    def _speed(self, position: Array, velocity: Array) -> Array:
        """What the velocity is taken from: the true one, or the slope of what the encoder says."""
        if self._bent is None or self._bent.form == "position":
            return velocity
        phase = 2 * np.pi * self._bent.shape[0]
        slope = np.cos(position + phase) + 0.6 * np.cos(2 * position + 2 * phase)
        return velocity * (1 + self._bent.size * places(self._bent, self.truth.joints) * slope)

    def true_position(self, reading: Array) -> Array:
        """Where joints are that read `reading` [run, joint] in rad."""
        position = reading
        for _ in range(6):
            position = position + reading - self.encoder(position)
        return position

    def read(self, servos: LegServos, position: Array, rng: np.random.Generator) -> dict[str, Array]:
        """Every register once, by channel name."""
        world, noise = self.truth.world, rng.standard_normal((2, *position.shape))
        velocity = self._velocity if self._second is None else self._slower
        voltage = np.broadcast_to(servos.bus_voltage, position.shape) + 0.2 * VOLTAGE_UNIT * noise[1]
        return {
            "position": quantise(self.encoder(position), POSITION_UNIT),
            "velocity": quantise(velocity, VELOCITY_UNIT),
            "current": quantise(servos.reading + world.current_noise * noise[0], CURRENT_UNIT),
            "voltage": quantise(voltage, VOLTAGE_UNIT),
            "temperature": quantise(servos.temperature, TEMPERATURE_UNIT),
        }
