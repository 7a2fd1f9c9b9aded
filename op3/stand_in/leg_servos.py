"""The servos of a leg or of the whole robot, for all runs of a case at once, with whatever is hidden in them.

The same forms as `servos.ServoBank` (loss by the sign of power, friction as an elastic element that slides), over
[run, joint], and what a hidden effect changes: parameters, terms of friction and torque, or a motor side of its own
behind a loose or soft gear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from op3.robot import GEAR_RATIO, LEG_JOINTS
from op3.stand_in.hidden import Hidden
from op3.stand_in.leg_effects import (
    FRICTION,
    LINK_SIDE,
    MOTOR_SIDE,
    REFERENCE_TEMPERATURE,
    WARM_UP_TIME,
    LegState,
    Term,
    places,
)
from op3.stand_in.servos import SLOW_PERIOD
from op3.stand_in.world import World

Array = NDArray[np.float64]

OUTPUT_INERTIA = 0.0006
"""Inertia of a servo's last gear wheel and horn about the joint [kg m^2]; the rest turns with the motor."""

GEAR_STIFFNESS = 250.0
"""Stiffness of teeth in contact, of a loose gear [N m/rad]."""

GEAR_DAMPING = 0.06
"""Damping of teeth in contact, and of a soft gear [N m s/rad]."""


@dataclass(frozen=True)
class LegTruth:
    """Everything that is true of one leg, or of all servos of a robot on the stand.

    Attributes:
        world: numbers of its servos and sensors.
        hidden: what is hidden in it.
        gear_form: "power", loss in proportion to torque where the load drives; "m6", more of it near rest.
        fade_form: "gaussian" or "exponential" fade of static friction.
        joints: names of the servos.
    """

    world: World
    hidden: tuple[Hidden, ...] = ()
    gear_form: str = "power"
    fade_form: str = "gaussian"
    joints: tuple[str, ...] = LEG_JOINTS

    def find(self, name: str) -> Hidden | None:
        """The hidden effect of this name, if its size is not 0."""
        return next((effect for effect in self.hidden if effect.name == name and effect.size != 0), None)


@dataclass(eq=False)
class _Gear:
    """A motor side with its own angle, behind a gap or a spring, in some joints."""

    columns: list[int]
    inertia: Array
    stiffness: float
    damping: float
    half_gap: float
    form: str
    position: Array = field(default_factory=lambda: np.zeros(0))
    velocity: Array = field(default_factory=lambda: np.zeros(0))

    def torque(self, link_position: Array, link_velocity: Array) -> Array:
        """What the teeth pass on [run, column] in N m: nothing in the gap, no pull, an elastic push beside it."""
        twist = self.position - link_position
        pressed = np.maximum(np.abs(twist) - self.half_gap, 0.0)
        if self.form == "tooth":
            # two curved flanks: soft at first touch (Hertz), as stiff as the plain form at 1 mrad
            push = self.stiffness * pressed**1.5 / np.sqrt(0.001)
        else:
            push = self.stiffness * pressed
        contact = np.sign(twist) * push
        damped = contact + self.damping * (self.velocity - link_velocity) * (pressed > 0)
        return np.where(damped * contact > 0, damped, 0.0) if self.half_gap else damped


class LegServos:
    """Servos that turn goal currents into joint torques, [run, joint].

    Args:
        truth: of the leg.
        temperature: of each run at its start [run] in C.
        day_time: when each run begins [run] in s.
        timestep: of the physics [s].
    """

    def __init__(self, truth: LegTruth, temperature: Array, day_time: Array, timestep: float):
        self.truth, self.timestep = truth, timestep
        world = truth.world
        shape = (len(day_time), len(truth.joints))
        self._set_parameters(world, shape)
        self._friction = _terms(FRICTION, truth)
        self._motor_side = _terms(MOTOR_SIDE, truth)
        self._link_side = _terms(LINK_SIDE, truth)
        self.current = np.zeros(shape)
        self.temperature = np.repeat(temperature[:, None], shape[1], 1)
        self.bus_voltage = np.full((shape[0], 1), world.bus_voltage)
        self._air = self.temperature.copy()
        self._state = LegState(
            timestep,
            *np.zeros((5, *shape)),
            temperature=self.temperature,
            time=0.0,
            day_time=day_time[:, None],
        )
        self._bristle = np.zeros(shape)
        self._noise = np.zeros(shape)
        self._goal = [np.zeros(shape) for _ in range(self._lag_stages)]
        self._applied = np.zeros(shape)
        self._gear = self._find_gear()
        self._slow(0.0)

    def _set_parameters(self, world: World, shape: tuple[int, int]) -> None:
        """The numbers of each servo, [joint], with what is hidden in them."""
        truth, count = self.truth, shape[1]
        joints = world.per_joint(count)
        self._constant = GEAR_RATIO * joints["torque_constant"] * (1 + _more(truth, "torque_constant"))
        self._coulomb = joints["coulomb_friction"] + _more(truth, "coulomb")
        self._excess = joints["static_friction_excess"].copy()
        self._viscous = joints["viscous_friction"] + _more(truth, "viscous")
        self._resistance = world.terminal_resistance * (1 + _more(truth, "terminal_resistance"))
        zero = np.random.default_rng([world.spread_seed, 3]).standard_normal(count)
        self._reading_offset = world.current_offset * zero + _more(truth, "current_offset")
        self._blend = 1 - np.exp(-self.timestep / world.current_lag)
        lag = truth.find("current_lag")
        self._lag_stages = 0 if lag is None else {"first_order": 1, "two_stage": 2}[lag.form]
        self._lag_blend = 0.0 if lag is None else 1 - np.exp(-self.timestep / (lag.size / self._lag_stages))
        self._fading = _size(truth, "torque_constant_temperature")
        self._hidden_resistance = _size(truth, "voltage_sag")
        self._driving_loss = 1 - world.forward_efficiency
        self._driven_loss = 1 / world.backward_efficiency - 1
        lugre = truth.find("lugre")
        self._stiffness = world.bristle_stiffness if lugre is None else 1 / (1 / world.bristle_stiffness + lugre.size)
        # as much damping as before in proportion to the root of the stiffness
        self._damping = world.bristle_damping * np.sqrt(self._stiffness / world.bristle_stiffness)
        self._bent = lugre is not None and lugre.form == "lugre"
        self._noise_memory = np.exp(-2 * np.pi * world.torque_noise_bandwidth * SLOW_PERIOD)
        self._noise_gain = world.torque_noise * np.sqrt(1 - self._noise_memory**2)
        self._phase = np.random.default_rng([world.spread_seed, 5]).uniform(0, 2 * np.pi, shape)

    def _find_gear(self) -> _Gear | None:
        loose, soft = self.truth.find("backlash"), self.truth.find("compliance")
        hidden = loose or soft
        if hidden is None:
            return None
        columns = [i for i, here in enumerate(places(hidden, self.truth.joints)) if here]
        inertia = self.truth.world.armature - OUTPUT_INERTIA
        stiffness = 1 / soft.size if soft else GEAR_STIFFNESS
        return _Gear(
            columns,
            np.full(len(columns), inertia),
            stiffness,
            GEAR_DAMPING,
            loose.size if loose else 0.0,
            hidden.form,
        )

    @property
    def armature(self) -> Array:
        """Inertia that turns with each joint for certain [joint] in kg m^2."""
        armature = np.full(len(self.truth.joints), self.truth.world.armature)
        if self._gear is not None:
            armature[self._gear.columns] = OUTPUT_INERTIA
        return armature

    @property
    def reading(self) -> Array:
        """What the current sensors read, without noise [run, joint] in A."""
        return self.current + self._reading_offset

    def reset(self, position: Array, rng: np.random.Generator) -> None:
        """Switched on at rest at `position` [run, joint]."""
        self._noise[:] = self.truth.world.torque_noise * rng.standard_normal(position.shape)
        if self._gear is not None:
            self._gear.position = position[:, self._gear.columns].copy()
            self._gear.velocity = np.zeros_like(self._gear.position)

    def step_slow(self, time: float, rng: np.random.Generator) -> None:
        """Advance noise, drift, voltage and temperature by `SLOW_PERIOD`; `time` is since the reset [s]."""
        self._noise *= self._noise_memory
        self._noise += self._noise_gain * rng.standard_normal(self._noise.shape)
        self._slow(time)

    def _slow(self, time: float) -> None:
        world = self.truth.world
        self._state.time = time
        drift = 1 + world.friction_drift * np.sin(2 * np.pi * time / world.friction_drift_period + self._phase)
        drift *= self._warm_up(time)
        self._dry, self._extra = self._coulomb * drift, self._excess * drift
        total = np.abs(self.current).sum(1, keepdims=True)
        self.bus_voltage = world.bus_voltage - world.bus_resistance * total
        reach = self.bus_voltage - self._hidden_resistance * total
        self._reach = reach / self._resistance
        heating = world.thermal_resistance * world.terminal_resistance * self.current**2
        self.temperature += SLOW_PERIOD / world.thermal_time * (self._air + heating - self.temperature)
        self._gain = self._constant * (1 - self._fading * (self.temperature - REFERENCE_TEMPERATURE))
        self._speed_gain = self._gain / self._resistance

    def _warm_up(self, time: float) -> Array | float:
        hidden = self.truth.find("friction_drift")
        if hidden is None:
            return 1.0
        if hidden.form == "temperature":
            return 1 - hidden.size * np.clip((self.temperature - REFERENCE_TEMPERATURE) / 35.0, 0.0, 1.1)
        return 1 - hidden.size * (1 - np.exp(-(self._state.day_time + time) / WARM_UP_TIME))

    def step(self, goal_current: Array, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Torques on the joints for the next physics step [run, joint] in N m.

        Args:
            goal_current: as the servos hold it [A].
            position: of the joints, true [rad].
            velocity: of the joints, true [rad/s].
            acceleration: of the joints in the last step [rad/s^2].
        """
        state, gear = self._state, self._gear
        state.position, state.velocity, state.link_position = position, velocity, position
        if gear is not None:
            state.position, state.velocity = position.copy(), velocity.copy()
            state.position[:, gear.columns], state.velocity[:, gear.columns] = gear.position, gear.velocity
        self._drive(goal_current, state.velocity)
        state.torque = self._gain * self.current
        if self._friction:
            state.transmitted += 0.25 * (self._applied - self.armature * acceleration - state.transmitted)
        torque = state.torque - self._slide(state.velocity, self._bound(state)) - self._viscous * state.velocity
        for term in self._motor_side:
            torque += term(state)
        if gear is not None:
            columns = gear.columns
            passed = gear.torque(position[:, columns], velocity[:, columns])
            gear.velocity += self.timestep * (torque[:, columns] - passed) / gear.inertia
            gear.position += self.timestep * gear.velocity
            torque[:, columns] = passed
        torque += self._noise
        for term in self._link_side:
            torque += term(state)
        self._applied = torque
        return torque

    def _drive(self, goal_current: Array, velocity: Array) -> None:
        """Advance the current: first-order towards the goal as the sensor reads it, within what voltage allows."""
        for stage in self._goal:
            stage += self._lag_blend * (goal_current - stage)
            goal_current = stage
        current = self.current
        current += self._blend * (goal_current - self._reading_offset - current)
        induced = self._speed_gain * velocity
        np.minimum(current, self._reach - induced, out=current)
        np.maximum(current, -self._reach - induced, out=current)

    def _bound(self, state: LegState) -> Array:
        """Largest friction [run, joint] in N m: gear loss by the sign of the power, Coulomb, static, hidden."""
        world = self.truth.world
        loss = np.where(state.torque * self._bristle > 0, self._driving_loss, self._driven_loss)
        speed = np.abs(state.velocity)
        if self.truth.gear_form == "m6":
            loss = loss * (0.85 + 0.3 * np.exp(-speed / 0.3))
        scaled = speed / world.stribeck_velocity
        fade = np.exp(-scaled) if self.truth.fade_form == "exponential" else np.exp(-scaled * scaled)
        bound = np.abs(state.torque) * loss + self._dry + self._extra * fade
        for term in self._friction:
            bound += term(state)
        return np.maximum(bound, 1e-6, out=bound) if self._friction else bound

    def _slide(self, velocity: Array, bound: Array) -> Array:
        """Strain the elastic elements, let them slide at the bound, and give their force [run, joint] in N m."""
        strain, stiffness = self._bristle, self._stiffness
        limit = bound / stiffness
        if self._bent:  # LuGre: the strain saturates smoothly
            rate = velocity - np.abs(velocity) * strain / limit
            strain += self.timestep * rate
            np.clip(strain, -limit, limit, out=strain)
            return np.clip(stiffness * strain + self._damping * rate, -bound, bound)
        strain += self.timestep * velocity
        force = np.clip(stiffness * strain + self._damping * velocity, -bound, bound)
        np.clip(strain, -limit, limit, out=strain)
        return force


def _size(truth: LegTruth, name: str) -> float:
    return next((effect.size for effect in truth.hidden if effect.name == name), 0.0)


def _more(truth: LegTruth, name: str) -> Array:
    """What an effect adds to a number of each servo [joint]."""
    none = np.zeros(len(truth.joints))
    return np.sum([none, *(e.size * places(e, truth.joints) for e in truth.hidden if e.name == name)], axis=0)


def _terms(makers: dict, truth: LegTruth) -> Sequence[Term]:
    return [makers[e.name](e, places(e, truth.joints), truth.joints) for e in truth.hidden if e.name in makers]
