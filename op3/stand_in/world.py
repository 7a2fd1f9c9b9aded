"""A world: the hidden parameters of a stand-in robot, which its logs do not contain."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import yaml
from numpy.typing import NDArray

from op3.common.settings import Listed, NotNegative, Number, Positive, Share, Whole, nearest, read_yaml, settings
from op3.robot import asset_path
from op3.stand_in.hidden import Hidden

_SPREAD = (
    "torque_constant",
    "coulomb_friction",
    "viscous_friction",
    "static_friction_excess",
    "terminal_resistance",
)

LossForm = Literal["power", "near_rest", "light_load", "mesh", "concave"]
FadeForm = Literal["gaussian", "exponential", "lorentz", "stretched", "ramp"]
ViscousForm = Literal["constant", "thinning"]
BristleForm = Literal["prandtl", "lugre"]
VelocityForm = Literal["lag", "two_lags", "difference"]

FORMS: dict[str, tuple[str, ...]] = {
    "loss_form": get_args(LossForm),
    "fade_form": get_args(FadeForm),
    "viscous_form": get_args(ViscousForm),
    "bristle_form": get_args(BristleForm),
    "velocity_form": get_args(VelocityForm),
}
"""Laws by kind; a world has one of each."""

Ranges = Mapping[str, Sequence[Any]]
"""Ranges of numbers, low and high, or names of laws."""


def read_ranges(path: str | Path | None = None) -> Ranges:
    """Ranges for the robots of the hidden-effect bench.

    Args:
        path: path of a YAML file with ranges that replace the project's, by name; None: no file.

    Raises:
        ValueError: if one is not a range of a quantity that a world has.
    """
    content = read_yaml(Path(__file__).with_name("ranges.yaml"))
    ranges = {**content["random"], **content["bench"]}
    known = [field.name for field in dataclasses.fields(HiddenWorld)]
    for name, of in (read_yaml(path) if path is not None else {}).items():
        if name not in known:
            raise ValueError(f"{path}: a world has no {name!r}{nearest(name, known)}")
        if not isinstance(of, list) or (name not in FORMS and len(of) != 2) or not of:
            raise ValueError(f"{path}: the range of {name} is {of!r}: write [low, high], or a list of laws")
        ranges[name] = of
    return ranges


def check_seed(what: str, seed: Any) -> None:
    """Raise an error for a seed that is not an integer of at least 0."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"{what} must be an integer of at least 0, got {seed!r}")


@settings("world")
class HiddenWorld:
    """The hidden parameters of one robot and its ground.

    The first eleven are the parameters of the paper's Table I; identification does not know the others.

    Attributes:
        torque_constant: Kt at the motor shaft [N m/A].
        terminal_resistance: resistance of motor and driver [ohm].
        armature: rotor inertia at the joint [kg m^2].
        forward_efficiency: share of the motor's torque that reaches the joint when the motor drives.
        backward_efficiency: share of the load that reaches the motor when the load drives.
        coulomb_friction: Coulomb friction [N m].
        viscous_friction: viscous friction [N m s/rad].
        static_friction_excess: break-away friction above Coulomb friction [N m].
        base_mass_offset: added to the trunk [kg].
        base_com_offset_x: shift of the trunk's centre of mass forwards [m].
        base_com_offset_z: shift of the trunk's centre of mass upwards [m].
        stribeck_velocity: speed scale of the decay of the excess [rad/s].
        bristle_stiffness: stiffness of the gear teeth and bearings before they slide [N m/rad].
        bristle_damping: damping of the gear teeth and bearings before they slide [N m s/rad].
        joint_spread: half width of the servo-to-servo spread of Kt, friction and resistance, as a ratio.
        spread_seed: seed of the differences between servos.
        friction_drift: half width of the slow change of friction, as a ratio.
        friction_drift_period: period of this change [s].
        torque_noise: standard deviation at the joint [N m].
        torque_noise_bandwidth: corner frequency of that noise [Hz].
        current_lag: time constant of the servo's current loop [s].
        current_offset: standard deviation of each current sensor's zero [A]; the loop regulates what it reads.
        current_noise: standard deviation of a current reading [A].
        command_latency: time from reading the sensors to a new current in the servo [s].
        latency_jitter: standard deviation of the latency [s].
        sampling_jitter: standard deviation of the instants at which the computer reads [s].
        velocity_lag: time constant of the servo's velocity estimate [s].
        bus_voltage: voltage of the battery without load [V].
        bus_resistance: resistance of battery and harness [ohm].
        foot_friction: Coulomb coefficient of sole on floor.
        contact_time: time constant of the contact [s].
        gyro_noise: standard deviation of a raw gyro sample at 1 kHz [rad/s].
        gyro_bias: standard deviation of each gyro axis' zero [rad/s].
        accelerometer_noise: standard deviation of a raw accelerometer sample at 1 kHz [m/s^2].
        imu_bandwidth: corner frequency of the IMU's low-pass [Hz].
        ambient_temperature: air temperature [C].
        thermal_resistance: winding to air [K/W].
        thermal_time: time constant of warming up [s].
        placement: standard deviation of each joint angle when the robot is put down [rad].
        mount_frequency: natural frequency of the stand, with the robot in it [Hz]; 0: stiff.
        mount_damping: damping ratio of the stand.
        timestep: physics step [s], rounded so that a millisecond is an integer number of steps.
        loss_form: how the gear loses torque.
        fade_form: form of the decay of static friction with speed.
        viscous_form: whether viscous friction is in proportion to speed.
        bristle_form: elastic element of friction.
        velocity_form: how servos estimate their velocity.
        hidden: effects beyond all this, from the kinds that the hidden-effect bench knows.
    """

    torque_constant: Positive = 0.0065
    terminal_resistance: Positive = 5.6
    armature: Positive = 0.005
    forward_efficiency: Share = 1.0
    backward_efficiency: Share = 0.72
    coulomb_friction: NotNegative = 0.09
    viscous_friction: NotNegative = 0.03
    static_friction_excess: NotNegative = 0.06
    base_mass_offset: NotNegative = 0.3
    base_com_offset_x: Number = 0.004
    base_com_offset_z: Number = -0.003
    stribeck_velocity: Positive = 0.08
    bristle_stiffness: Positive = 400.0
    bristle_damping: NotNegative = 1.0
    joint_spread: Share = 0.03
    spread_seed: Whole = 0
    friction_drift: Share = 0.03
    friction_drift_period: Positive = 20.0
    torque_noise: NotNegative = 0.004
    torque_noise_bandwidth: Positive = 40.0
    current_lag: Positive = 0.0005
    current_offset: NotNegative = 0.002
    current_noise: NotNegative = 0.002
    command_latency: NotNegative = 0.006
    latency_jitter: NotNegative = 0.0002
    sampling_jitter: NotNegative = 0.0
    velocity_lag: Positive = 0.002
    bus_voltage: Positive = 11.7
    bus_resistance: NotNegative = 0.2
    foot_friction: Positive = 0.8
    contact_time: Positive = 0.005
    gyro_noise: NotNegative = 0.004
    gyro_bias: NotNegative = 0.002
    accelerometer_noise: NotNegative = 0.05
    imu_bandwidth: Positive = 45.0
    ambient_temperature: Number = 28.0
    thermal_resistance: NotNegative = 10.0
    thermal_time: Positive = 240.0
    placement: NotNegative = 0.002
    mount_frequency: NotNegative = 0.0
    mount_damping: NotNegative = 0.03
    timestep: Positive = 0.00025
    loss_form: LossForm = "power"
    fade_form: FadeForm = "gaussian"
    viscous_form: ViscousForm = "constant"
    bristle_form: BristleForm = "prandtl"
    velocity_form: VelocityForm = "lag"
    hidden: Listed[Hidden] = ()

    def __post_init__(self):
        """Efficiencies divide, and the step meets every millisecond."""
        if not (self.forward_efficiency > 0 and self.backward_efficiency > 0):
            raise ValueError("world: efficiencies must be above 0")
        object.__setattr__(self, "timestep", 0.001 / max(4, round(0.001 / self.timestep)))

    @property
    def identity(self) -> str:
        """Twelve hexadecimal digits that identify a world without revealing anything about it."""
        return hashlib.sha256(repr(dataclasses.astuple(self)).encode()).hexdigest()[:12]

    def replace(self, **changes: Any) -> HiddenWorld:
        """A copy with some parameters changed."""
        return dataclasses.replace(self, **changes)

    def per_joint(self, count: int) -> dict[str, NDArray[np.float64]]:
        """The quantities that differ from servo to servo, each [joint]."""
        rng = np.random.default_rng([self.spread_seed, 1])
        spread = 1 + self.joint_spread * rng.uniform(-1, 1, (len(_SPREAD), count))
        return {name: getattr(self, name) * row for name, row in zip(_SPREAD, spread, strict=True)}

    @classmethod
    def random(cls, seed: int, ranges: Ranges | None = None) -> HiddenWorld:
        """A world drawn from ranges, those of Table I if None; other values are those of `HiddenWorld()`."""
        check_seed("the seed of a random world", seed)
        rng = np.random.default_rng([seed, 2])
        drawn: dict[str, Any] = {
            name: str(rng.choice(of)) if name in FORMS else float(rng.uniform(of[0], of[1]))
            for name, of in (RANDOM_RANGES if ranges is None else ranges).items()
        }
        return cls(**drawn, spread_seed=int(seed))

    @classmethod
    def load(cls, path: str | Path) -> HiddenWorld:
        """Read a YAML file of `name: value` lines; other values are those of `HiddenWorld()`.

        A line `draw: seed` starts from the random world of that seed instead, so that the file does not show the
        parameters. `hidden` lists effects, such as `{name: backlash, size: 0.004, joints: [elbow]}`.
        """
        return cls.of(read_yaml(path), str(path))

    @classmethod
    def of(cls, values: Mapping[str, Any], origin: str) -> HiddenWorld:
        """A world from the content of its file; errors name `origin`."""
        values = dict(values)
        drawn = values.pop("draw", None)
        try:
            if "hidden" in values:
                values["hidden"] = [Hidden(**effect) for effect in values["hidden"]]
            return cls(**values) if drawn is None else cls(**{**vars(cls.random(drawn)), **values})
        except (TypeError, ValueError) as error:
            raise ValueError(f"{origin}: {error}") from None

    @classmethod
    def find(cls, name: str | Path, seed: int = 0) -> HiddenWorld:
        """A world by its name.

        Args:
            name: "random", a name from `world_names`, or the path of a YAML file.
            seed: seed of a random world.
        """
        if name == "random":
            return cls.random(seed)
        if Path(name).is_file():
            return cls.load(name)
        if name in world_names():
            return cls.of(_worlds()[str(name)], str(name))
        known = ", ".join(world_names())
        raise ValueError(f"there is no world {str(name)!r}; choose random, {known}, or the path of a YAML file")

    def save(self, path: str | Path) -> Path:
        """Write all parameters to a YAML file."""
        path = Path(path)
        path.write_text(yaml.safe_dump(dataclasses.asdict(self), sort_keys=False), encoding="utf-8")
        return path


RANDOM_RANGES: Ranges = read_yaml(Path(__file__).with_name("ranges.yaml"))["random"]
"""Ranges of random worlds, uniform: the middle of the paper's Table I."""

BENCH_RANGES: Ranges = read_ranges()
"""Ranges of the robots of the hidden-effect bench."""


def world_names() -> tuple[str, ...]:
    """Names of the worlds that come with the project, in `assets/worlds.yaml`."""
    return tuple(_worlds())


@lru_cache(maxsize=1)
def _worlds() -> dict[str, dict[str, Any]]:
    return read_yaml(asset_path("worlds.yaml"))
