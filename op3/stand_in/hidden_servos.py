"""The servos of a robot: records of their parameters, set by a world and the hidden effects, and of their states."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from op3.robot import ServoMake, load_servo, supply_shares
from op3.stand_in.hidden import Hidden
from op3.stand_in.integration import MEMORY, ROBOT, SERVO, STATE, TICK, encoders, step_slow
from op3.stand_in.world import FORMS, HiddenWorld

Array = NDArray[np.float64]
Records = NDArray[np.void]

OUTPUT_INERTIA = 0.0006
"""Inertia of a servo's last gear wheel and horn about the joint [kg m^2]; the rest turns with the motor."""

GEAR_STIFFNESS = 250.0
"""Stiffness of teeth in contact, of a loose gear [N m/rad]."""

GEAR_DAMPING = 0.06
"""Damping of teeth in contact, and of a soft gear [N m s/rad]."""


class HiddenServos:
    """All servos of one robot.

    Attributes:
        servos: parameters, records `SERVO` [joint].
        states: records `STATE` [joint].
        robot: values shared by all servos, one record `ROBOT` [1].
        velocity: the servos' own estimates [joint] in rad/s.

    Args:
        world: the hidden parameters.
        hidden: further hidden effects.
        joints: names [joint].
        makes: makes of the servos [joint]. A world's values are for an XM430-W350; for another make they are scaled by
            the ratio of the data sheets.
        rest: angles about which the robot moves [joint] in rad; effects at certain angles are placed near these.
        limits: mechanical range of the joints [joint, 2] in rad.
    """

    def __init__(
        self,
        world: HiddenWorld,
        hidden: Sequence[Hidden],
        joints: Sequence[str],
        makes: Sequence[ServoMake],
        rest: Array,
        limits: Array,
    ):
        self.world, count = world, len(joints)
        self.servos = np.zeros(count, SERVO)
        self.states = np.zeros(count, STATE)
        self.robot = np.zeros(1, ROBOT)
        self.velocity = np.zeros(count)
        self._memory = np.zeros((count, MEMORY))
        self._fill(limits)
        self._scale(makes)
        for effect in hidden:
            self._hide(effect, joints, rest)
        rigid = self.servos["gear_stiffness"] == 0
        self.servos["output_inertia"] = np.where(rigid, self.servos["armature"], self.servos["output_inertia"])
        self.states["temperature"] = self.states["air"] = world.ambient_temperature

    def _fill(self, limits: Array) -> None:
        """Parameters from the world only."""
        world, servos, robot = self.world, self.servos, self.robot
        joints = world.per_joint(len(servos))
        servos["constant"] = joints["torque_constant"]
        servos["coulomb"], servos["viscous"] = joints["coulomb_friction"], joints["viscous_friction"]
        servos["excess"], servos["resistance"] = joints["static_friction_excess"], joints["terminal_resistance"]
        for name in ("armature", "current_lag", "stribeck_velocity"):
            servos[name] = getattr(world, name)
        servos["stiffness"], servos["damping"] = world.bristle_stiffness, world.bristle_damping
        servos["driving_loss"], servos["driven_loss"] = 1 - world.forward_efficiency, 1 / world.backward_efficiency - 1
        servos["velocity_time"], servos["output_inertia"] = world.velocity_lag, OUTPUT_INERTIA
        for name in ("loss_form", "fade_form", "viscous_form", "bristle_form", "velocity_form"):
            servos[name] = FORMS[name].index(getattr(world, name))
        servos["low"], servos["high"] = limits.T
        zero = np.random.default_rng([world.spread_seed, 3]).standard_normal(len(servos))
        servos["current_offset"] = world.current_offset * zero
        robot["open_voltage"] = robot["bus_voltage"] = world.bus_voltage
        robot["step"] = world.timestep
        for name in ("bus_resistance", "thermal_resistance", "thermal_time"):
            robot[name] = getattr(world, name)
        robot["drift"], robot["drift_period"] = world.friction_drift, world.friction_drift_period
        memory = np.exp(-2 * np.pi * world.torque_noise_bandwidth * TICK)
        robot["noise_memory"], robot["noise_gain"] = memory, world.torque_noise * np.sqrt(1 - memory**2)
        robot["supply"] = np.nan

    def _scale(self, makes: Sequence[ServoMake]) -> None:
        """Scale the values of an XM430-W350 to the robot's makes by the ratio of the data sheets."""
        servos, like = self.servos, load_servo("xm430-w350")

        def of(read: Callable[[ServoMake], float]) -> Array:
            return np.array([read(make) for make in makes]) / read(like)

        torque, speed = of(_stall), of(lambda make: make.supply.si / make.output_constant)
        servos["constant"] *= like.motor.gear_ratio.si * of(lambda make: make.output_constant)
        servos["resistance"] *= of(lambda make: make.motor.terminal_resistance.si)
        servos["armature"] *= of(lambda make: make.motor.armature.si)
        servos["output_inertia"] *= of(lambda make: make.motor.armature.si)
        for name in ("coulomb", "excess", "stiffness"):
            servos[name] *= torque
        for name in ("viscous", "damping"):
            servos[name] *= torque / speed
        for name in ("open_voltage", "bus_voltage"):
            self.robot[name] *= makes[0].supply.si / like.supply.si
        servos["supply_share"] = supply_shares(makes)
        servos["position_unit"] = [make.position_unit for make in makes]
        for servo, make in zip(servos, makes, strict=True):
            law = make.position_law
            if make.loop != "current" and law is not None:
                servo["position_gain"], servo["max_duty"] = law.gain.si * law.error_gain.si, law.max_duty.si
                servo["goal_speed"] = law.goal_speed.si

    def _hide(self, effect: Hidden, joints: Sequence[str], rest: Array) -> None:
        """Write an effect into the records; effects of links, bus and world are handled elsewhere."""
        where = np.array([not effect.joints or joint in effect.joints for joint in joints])
        unknown = set(effect.joints) - set(joints)
        if unknown:
            raise ValueError(f"{effect.name} cannot sit in {sorted(unknown)[0]!r}; the joints are {', '.join(joints)}")
        if effect.size == 0:
            return
        if effect.name == "voltage_sag":
            self.robot["hidden_resistance"] = effect.size
        for name, value in _written(self.servos, effect, rest + 0.24 * (effect.shape[0] - 0.5)).items():
            self.servos[name][where] = np.broadcast_to(value, len(joints))[where]

    @property
    def records(self) -> tuple[Records, Records, np.void]:
        """Arguments of the kernel: parameters, states, and shared values."""
        return self.servos, self.states, self.robot[0]

    @property
    def output_inertia(self) -> Array:
        """Inertia that always turns with each joint [joint] in kg m^2."""
        return self.servos["output_inertia"]

    @property
    def reading(self) -> Array:
        """Readings of the current sensors, without noise [joint] in A."""
        return self.states["current"] + self.servos["current_offset"]

    @property
    def voltage(self) -> Array:
        """Voltage at the servos [joint] in V."""
        return self.robot["bus_voltage"] * self.servos["supply_share"]

    @property
    def encoders(self) -> Array:
        """Readings of the encoders before rounding [joint] in rad."""
        return encoders(self.servos, self.states["position"])

    def angles(self, reading: Array) -> Array:
        """Angles of joints whose encoders read `reading` [joint] in rad."""
        position = reading
        for _ in range(6):
            position = position + reading - encoders(self.servos, position)
        return position

    def reset(self, position: Array, rng: np.random.Generator, day_time: float = 0.0) -> None:
        """Switch the servos on at rest at `position` [joint] in rad; windings keep their temperature."""
        kept = self.states["temperature"].copy(), self.states["air"].copy()
        self.states[:] = np.zeros(1, STATE)
        states = self.states
        states["temperature"], states["air"] = kept
        for name in ("position", "gear_position", "slack", "yielded"):
            states[name] = position
        own = self.servos["position_gain"] > 0
        states["by_voltage"], states["goal"] = own, np.where(own, position, 0.0)
        states["followed"] = position
        states["enabled"] = 1.0
        states["noise"] = self.world.torque_noise * rng.standard_normal(len(states))
        states["drift_phase"] = rng.uniform(0, 2 * np.pi, len(states))
        self.robot["time"], self.robot["day_time"], self.robot["ticks"] = 0.0, day_time, 0.0
        self.robot["bus_voltage"] = self.robot["open_voltage"]
        self._memory[:] = self.encoders[:, None]
        self.velocity[:] = 0
        self.tick(rng)
        self.robot["time"] = 0.0

    def tick(self, rng: np.random.Generator) -> None:
        """Advance slow states by `TICK`."""
        count = len(self.states)
        normal, uniform = rng.standard_normal(count), rng.random(count)
        step_slow(*self.records, self._memory, self.velocity, normal, uniform)


def _stall(make: ServoMake) -> float:
    """Torque of the stalled motor at its usual supply, without losses [N m]."""
    return make.ideal_stall_torque()


def _softer(servos: Records, effect: Hidden) -> dict[str, Array | float]:
    """A bristle in series with a softer one, with the same damping ratio."""
    stiffness = 1 / (1 / servos["stiffness"] + effect.size)
    damping = servos["damping"] * np.sqrt(stiffness / servos["stiffness"])
    return {"stiffness": stiffness, "damping": damping, "bristle_form": effect.variant}


def _stop(effect: Hidden, near: Array) -> dict[str, Array | float]:
    """Away from the pose in which the robot rests, to either side."""
    side = 1.0 if effect.shape[1] < 0.5 else -1.0
    edge = near - 0.24 * (effect.shape[0] - 0.5) + side * (0.12 + 0.12 * effect.shape[0])
    return {"stop": effect.size, "stop_side": side, "stop_edge": edge}


def _written(servos: Records, effect: Hidden, near: Array) -> dict[str, Array | float]:
    """Values that an effect writes into its servos' records; empty for effects of links, bus and world.

    Args:
        servos: parameters before it, records [joint].
        near: an angle within 0.12 rad of the one about which each joint moves [joint] in rad.
    """
    size, form, shape = effect.size, effect.variant, effect.shape
    match effect.name:
        case "coulomb" | "viscous" | "current_offset":
            return {effect.name: servos[effect.name] + size}
        case "torque_constant":
            return {"constant": servos["constant"] * (1 + size)}
        case "terminal_resistance":
            return {"resistance": servos["resistance"] * (1 + size)}
        case "torque_constant_temperature":
            return {"magnet_fading": size}
        case "quadratic_drag":
            return {"drag": size}
        case "load_friction":
            return {"load_friction": size, "load_friction_form": form}
        case "lugre":
            return _softer(servos, effect)
        case "backlash":
            gear = {"gear_stiffness": GEAR_STIFFNESS, "gear_damping": GEAR_DAMPING, "tooth_form": form}
            return {**gear, "half_gap": size}
        case "compliance":  # with a gap beside it, both in one pair of teeth
            return {"gear_stiffness": 1 / size, "gear_damping": GEAR_DAMPING}
        case "cogging":  # 12 to 40 periods a turn
            periods, phase = round(12 + 28 * shape[0]), 2 * np.pi * shape[1]
            return {"cogging": size, "cogging_periods": periods, "cogging_phase": phase, "cogging_form": form}
        case "cable_spring":
            return {"spring": size, "spring_rest": near, "spring_form": form}
        case "position_friction":
            return {"oval": size, "oval_centre": near, "oval_form": form}
        case "asymmetric_friction":
            return {"asymmetry": size}
        case "friction_drift":
            return {"warm_loss": size, "warm_form": form}
        case "current_lag":
            return {"late_time": size, "late_stages": form + 1}
        case "velocity_filter":
            return {"slower_time": size, "slower_form": form}
        case "encoder_nonlinearity":
            return {"encoder_bend": size, "encoder_form": form, "encoder_phase": 2 * np.pi * shape[0]}
        case "vibration":  # 7 to 15 Hz, whatever the joint does
            frequency, phase = 7 + 8 * shape[0], 2 * np.pi * shape[1]
            return {"vibration": size, "vibration_frequency": frequency, "vibration_phase": phase}
        case "hard_stop":
            return _stop(effect, near)
        case "sticky_patch":
            return {"patch": size, "patch_centre": near}
        case "creep":
            return {"creep": size, "creep_rate": 1 / (0.8 + 1.5 * shape[0])}
        case "chipped_tooth":
            return {"chip": size, "chip_phase": shape[0]}
        case "encoder_offset" | "ageing" | "dropout":
            return {effect.name: size}
    return {}
