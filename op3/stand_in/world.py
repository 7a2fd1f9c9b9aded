"""A world: every number that makes a stand-in robot what it is, and that its logs never tell."""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from op3.robot import named_configs

_POSITIVE = (
    "torque_constant",
    "terminal_resistance",
    "armature",
    "forward_efficiency",
    "backward_efficiency",
    "stribeck_velocity",
    "bristle_stiffness",
    "friction_drift_period",
    "torque_noise_bandwidth",
    "current_lag",
    "velocity_lag",
    "imu_bandwidth",
    "bus_voltage",
    "foot_friction",
    "contact_time",
    "thermal_time",
)
_SIGNED = ("base_com_offset_x", "base_com_offset_z", "ambient_temperature")
_SPREAD = ("torque_constant", "coulomb_friction", "viscous_friction", "static_friction_excess")

RANDOM_RANGES: dict[str, tuple[float, float]] = {
    "torque_constant": (0.0046, 0.0084),
    "terminal_resistance": (4.5, 8.5),
    "armature": (0.004, 0.01015),
    "backward_efficiency": (0.6, 0.8),
    "coulomb_friction": (0.034, 0.226),
    "viscous_friction": (0.01725, 0.13525),
    "static_friction_excess": (0.025, 0.14),
    "base_mass_offset": (0.05, 0.45),
    "base_com_offset_x": (-0.016, 0.016),
    "base_com_offset_z": (-0.016, 0.016),
    "stribeck_velocity": (0.05, 0.15),
    "bristle_stiffness": (300.0, 600.0),
    "bus_voltage": (11.1, 12.3),
    "bus_resistance": (0.1, 0.4),
    "foot_friction": (0.6, 1.0),
    "contact_time": (0.004, 0.006),
    "command_latency": (0.0055, 0.0065),
    "velocity_lag": (0.0015, 0.0025),
}
"""What a random world is drawn from, uniformly. Table I of the paper without the outer tenth of each range at
either end; the forward efficiency stays at 1 as there, the backward efficiency lies in [0.6, 0.8]."""


@dataclass(frozen=True)
class World:
    """The truth of one robot and the ground it stands on.

    The first eleven are the quantities of the paper's Table I. The rest is what no identification is told of.

    Attributes:
        torque_constant: Kt at the motor shaft [N m/A].
        terminal_resistance: of motor and driver [ohm].
        armature: rotor inertia at the joint [kg m^2].
        forward_efficiency: share of the motor's torque that reaches the joint when the motor drives.
        backward_efficiency: share of the load that reaches the motor when the load drives.
        coulomb_friction: [N m].
        viscous_friction: [N m s/rad].
        static_friction_excess: break-away friction above Coulomb friction [N m].
        base_mass_offset: added to the trunk [kg].
        base_com_offset_x: shift of the trunk's centre of mass forwards [m].
        base_com_offset_z: shift of the trunk's centre of mass upwards [m].
        stribeck_velocity: speed of the Gaussian fade of the excess [rad/s].
        bristle_stiffness: of the gear teeth and bearings before they slide [N m/rad].
        bristle_damping: of the same [N m s/rad].
        joint_spread: half width of the servo-to-servo spread of Kt and friction, as a ratio.
        spread_seed: which servos were picked from the shelf.
        friction_drift: half width of the slow change of friction, as a ratio.
        friction_drift_period: its period [s].
        torque_noise: standard deviation at the joint [N m].
        torque_noise_bandwidth: corner frequency of that noise [Hz].
        current_lag: time constant of the servo's current loop [s].
        current_offset: standard deviation of each current sensor's zero [A]; the loop regulates what it reads.
        current_noise: standard deviation of a current reading [A].
        command_latency: from reading the sensors to a new current in the servo [s].
        latency_jitter: its standard deviation [s].
        velocity_lag: time constant of the servo's velocity filter [s].
        bus_voltage: of the battery without load [V].
        bus_resistance: of battery and harness [ohm].
        foot_friction: Coulomb coefficient of sole on floor.
        contact_time: time constant of the contact [s].
        gyro_noise: standard deviation of a raw gyro sample at 1 kHz [rad/s].
        gyro_bias: standard deviation of each gyro axis' zero [rad/s].
        accelerometer_noise: standard deviation of a raw accelerometer sample at 1 kHz [m/s^2].
        imu_bandwidth: corner frequency of the IMU's low-pass [Hz].
        ambient_temperature: [C].
        thermal_resistance: winding to air [K/W].
        thermal_time: time constant of warming up [s].
        placement: standard deviation of each joint angle when the robot is put down [rad].
    """

    torque_constant: float = 0.0065
    terminal_resistance: float = 5.6
    armature: float = 0.005
    forward_efficiency: float = 1.0
    backward_efficiency: float = 0.72
    coulomb_friction: float = 0.09
    viscous_friction: float = 0.03
    static_friction_excess: float = 0.06
    base_mass_offset: float = 0.3
    base_com_offset_x: float = 0.004
    base_com_offset_z: float = -0.003
    stribeck_velocity: float = 0.08
    bristle_stiffness: float = 400.0
    bristle_damping: float = 1.0
    joint_spread: float = 0.03
    spread_seed: int = 0
    friction_drift: float = 0.03
    friction_drift_period: float = 20.0
    torque_noise: float = 0.004
    torque_noise_bandwidth: float = 40.0
    current_lag: float = 0.0005
    current_offset: float = 0.002
    current_noise: float = 0.002
    command_latency: float = 0.006
    latency_jitter: float = 0.0002
    velocity_lag: float = 0.002
    bus_voltage: float = 11.7
    bus_resistance: float = 0.2
    foot_friction: float = 0.8
    contact_time: float = 0.005
    gyro_noise: float = 0.004
    gyro_bias: float = 0.002
    accelerometer_noise: float = 0.05
    imu_bandwidth: float = 45.0
    ambient_temperature: float = 28.0
    thermal_resistance: float = 10.0
    thermal_time: float = 240.0
    placement: float = 0.002

    def __post_init__(self):
        for field in dataclasses.fields(self):
            name, value = field.name, getattr(self, field.name)
            whole = name == "spread_seed"
            if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
                raise ValueError(f"world: {name} must be a {'whole ' if whole else ''}number, got {value!r}")
            if not math.isfinite(value):
                raise ValueError(f"world: {name} must be finite, got {value}")
            if name in _POSITIVE and value <= 0:
                raise ValueError(f"world: {name} must be positive, got {value}")
            if name not in _SIGNED and value < 0:
                raise ValueError(f"world: {name} must be at least 0, got {value}")
        for name in ("forward_efficiency", "backward_efficiency"):
            if getattr(self, name) > 1:
                raise ValueError(f"world: {name} must be at most 1, got {getattr(self, name)}")
        if self.joint_spread >= 1 or self.friction_drift >= 1:
            raise ValueError("world: joint_spread and friction_drift are ratios below 1")

    @property
    def identity(self) -> str:
        """Twelve hexadecimal digits that tell worlds apart without telling anything about them."""
        values = dataclasses.astuple(self)
        return hashlib.sha256(repr(tuple(float(value) for value in values)).encode()).hexdigest()[:12]

    def replace(self, **changes: Any) -> World:
        """A world that differs in some numbers."""
        return dataclasses.replace(self, **changes)

    def per_joint(self, count: int) -> dict[str, NDArray[np.float64]]:
        """The quantities that differ from servo to servo, each [joint]."""
        rng = np.random.default_rng([self.spread_seed, 1])
        spread = 1 + self.joint_spread * rng.uniform(-1, 1, (len(_SPREAD), count))
        return {name: getattr(self, name) * row for name, row in zip(_SPREAD, spread, strict=True)}

    @classmethod
    def random(cls, seed: int) -> World:
        """A world drawn from `RANDOM_RANGES`; what is not named there is as in `World()`."""
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise ValueError(f"the seed of a random world must be a whole number of at least 0, got {seed!r}")
        rng = np.random.default_rng([seed, 2])
        drawn = {name: float(rng.uniform(low, high)) for name, (low, high) in RANDOM_RANGES.items()}
        return cls(**drawn, spread_seed=int(seed))

    @classmethod
    def load(cls, path: str | Path) -> World:
        """Read a YAML file of `name: value` lines; what it does not name is as in `World()`.

        A line `draw: seed` starts from the random world of that seed instead, so that the file does not tell the truth
        to whoever glances at it.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"there is no world file {path}")
        try:
            values = yaml.safe_load(path.read_text(encoding="utf-8"))
        except yaml.YAMLError as error:
            raise ValueError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from None
        if not isinstance(values, dict):
            raise ValueError(f"{path}: a world is written as lines `name: value`")
        known = [field.name for field in dataclasses.fields(cls)]
        drawn = values.pop("draw", None)
        for name in values:
            if name not in known:
                close = difflib.get_close_matches(str(name), known, n=1)
                hint = f"; did you mean {close[0]}?" if close else f"; it has {', '.join(known)}"
                raise ValueError(f"{path}: a world has no {name!r}{hint}")
        try:
            return cls(**values) if drawn is None else cls.random(drawn).replace(**values)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    @classmethod
    def find(cls, name: str | Path, seed: int = 0) -> World:
        """A world by what a user calls it.

        Args:
            name: "random", a name from `world_names`, or the path of a YAML file.
            seed: of a random world.
        """
        if name == "random":
            return cls.random(seed)
        if Path(name).is_file():
            return cls.load(name)
        if name in world_names():
            return cls.load(named_configs("stand_in")[str(name)])
        known = ", ".join(world_names())
        raise ValueError(f"there is no world {str(name)!r}; choose random, {known}, or the path of a YAML file")

    def save(self, path: str | Path) -> Path:
        """Write every number to a YAML file."""
        path = Path(path)
        path.write_text(yaml.safe_dump(dataclasses.asdict(self), sort_keys=False), encoding="utf-8")
        return path


def world_names() -> tuple[str, ...]:
    """Names of the worlds that come with the project, in `conf/stand_in/`."""
    return tuple(named_configs("stand_in"))
