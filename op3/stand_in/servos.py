"""The servos of a stand-in robot: current loop, DC motor, gear and friction, in one numpy step.

The forms differ from those that identification fits. The gear's loss follows the sign of the motor's power
instead of comparing torques. Friction is an elastic element that slides at a bound (Prandtl's element, the
elasto-plastic limit of the LuGre bristle; Dupont et al. 2002, Hayward and Armstrong 2000), with the Gaussian
Stribeck curve of Canudas de Wit et al. 1995, instead of a constraint of the physics engine.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from op3.robot import GEAR_RATIO
from op3.stand_in.world import World

SLOW_PERIOD = 0.001
"""Period of what changes slowly: noise, drift, voltage, temperature, and the servos' own filters [s]."""

Array = NDArray[np.float64]


class ServoBank:
    """`count` servos that turn goal currents into joint torques.

    Call `step` once per physics step and `step_slow` once per millisecond. The gear's loss is a budget of
    friction: with motor torque tau at the joint it is (1 - eta_fw) |tau| where the motor drives and
    (1/eta_bw - 1) |tau| where the load drives it back, so that the joint gets eta_fw tau or tau / eta_bw. At
    rest the direction is that of the strained teeth; it is continuous there, so nothing chatters.

    Args:
        world: the truth.
        count: number of servos.
        timestep: of the physics [s].
    """

    def __init__(self, world: World, count: int, timestep: float):
        self._world = world
        self._timestep = timestep
        joints = world.per_joint(count)
        self._constant = GEAR_RATIO * joints["torque_constant"]
        self._viscous = joints["viscous_friction"]
        self._dry = np.stack([joints["coulomb_friction"], joints["static_friction_excess"]])
        self._speed_gain = self._constant / world.terminal_resistance
        self._reading_offset = world.current_offset * np.random.default_rng([world.spread_seed, 3]).standard_normal(
            count
        )
        self._blend = 1 - np.exp(-timestep / world.current_lag)
        self._driving_loss = 1 - world.forward_efficiency
        self._driven_loss = 1 / world.backward_efficiency - 1
        self._noise_memory = np.exp(-2 * np.pi * world.torque_noise_bandwidth * SLOW_PERIOD)
        self._noise_gain = world.torque_noise * np.sqrt(1 - self._noise_memory**2)
        self.temperature = np.full(count, world.ambient_temperature)
        self.current = np.zeros(count)
        self._bristle = np.zeros(count)
        self._noise = np.zeros(count)
        self._phase = np.zeros(count)
        self._coulomb, self._excess = self._dry.copy()
        self._velocity = np.zeros(count)
        self._work = np.zeros((4, count))
        self._driving = np.zeros(count, dtype=bool)
        self.torque = np.zeros(count)
        self.bus_voltage = world.bus_voltage
        self._reach = world.bus_voltage / world.terminal_resistance

    @property
    def reading(self) -> Array:
        """What the current sensors read, without noise [joint] [A]."""
        return self.current + self._reading_offset

    def reset(self, rng: np.random.Generator) -> None:
        """Switched on at rest: no current, no strain; windings keep their temperature."""
        count = len(self.current)
        self.current[:] = 0
        self.bus_voltage = self._world.bus_voltage
        self._bristle[:] = 0
        self._noise[:] = self._world.torque_noise * rng.standard_normal(count)
        self._phase[:] = rng.uniform(0, 2 * np.pi, count)
        self.step_slow(0.0, rng)

    def step_slow(self, time: float, rng: np.random.Generator) -> None:
        """Advance noise, drift, voltage and temperature by `SLOW_PERIOD`; `time` is since the reset [s]."""
        world = self._world
        self._noise *= self._noise_memory
        self._noise += self._noise_gain * rng.standard_normal(len(self._noise))
        drift = 1 + world.friction_drift * np.sin(2 * np.pi * time / world.friction_drift_period + self._phase)
        self._coulomb, self._excess = self._dry * drift
        # drivers chop the voltage, so the battery gives their power and not their currents; none takes power back
        power = self.current * (world.terminal_resistance * self.current + self._constant * self._velocity)
        drawn = float(np.maximum(power, 0.0).sum()) / self.bus_voltage
        self.bus_voltage = world.bus_voltage - world.bus_resistance * drawn
        self._reach = self.bus_voltage / world.terminal_resistance
        heating = world.thermal_resistance * world.terminal_resistance * self.current**2
        warming = world.ambient_temperature + heating - self.temperature
        self.temperature += SLOW_PERIOD / world.thermal_time * warming

    def step(self, goal_current: Array, velocity: Array) -> Array:
        """Torques on the joints for the next physics step.

        Args:
            goal_current: [joint] in A, as the servos hold it.
            velocity: [joint] in rad/s, true.

        Returns:
            [joint] in N m; the array is reused.
        """
        self._velocity = velocity
        a, b, c, torque = self._work[0], self._work[1], self._work[2], self.torque
        self._drive(goal_current, velocity, a, b)
        np.multiply(self._constant, self.current, out=torque)
        # bound b: gear loss by the sign of the power, then Coulomb and static friction
        np.multiply(torque, self._bristle, out=a)
        np.greater(a, 0, out=self._driving)
        c.fill(self._driven_loss)
        np.copyto(c, self._driving_loss, where=self._driving)
        np.abs(torque, out=b)
        b *= c
        np.multiply(velocity, 1 / self._world.stribeck_velocity, out=a)
        a *= a
        np.negative(a, out=a)
        np.exp(a, out=a)
        a *= self._excess
        a += self._coulomb
        b += a
        self._slide(velocity, b, a, c)
        torque -= a
        np.multiply(self._viscous, velocity, out=a)
        torque -= a
        torque += self._noise
        return torque

    def _drive(self, goal_current: Array, velocity: Array, a: Array, b: Array) -> None:
        """Advance the current: first-order towards the goal as the sensor reads it, within what voltage allows."""
        current = self.current
        np.subtract(goal_current, current, out=a)
        a -= self._reading_offset
        a *= self._blend
        current += a
        np.multiply(velocity, self._speed_gain, out=a)
        np.subtract(self._reach, a, out=b)
        np.minimum(current, b, out=current)
        np.add(self._reach, a, out=b)
        np.negative(b, out=b)
        np.maximum(current, b, out=current)

    def _slide(self, velocity: Array, bound: Array, force: Array, work: Array) -> None:
        """Strain the elastic elements, let them slide at the bound, and write their force to `force`."""
        stiffness = self._world.bristle_stiffness
        strain = self._bristle
        np.multiply(velocity, self._timestep, out=work)
        strain += work
        np.multiply(strain, stiffness, out=force)
        np.multiply(velocity, self._world.bristle_damping, out=work)
        force += work
        np.minimum(force, bound, out=force)
        np.negative(bound, out=work)
        np.maximum(force, work, out=force)
        work *= 1 / stiffness
        np.maximum(strain, work, out=strain)
        np.negative(work, out=work)
        np.minimum(strain, work, out=strain)
