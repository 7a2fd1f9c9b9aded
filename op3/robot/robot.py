"""What a robot is, read from one file: ``assets/robots/<name>.yaml`` or a user's own. See ``docs/your_robot.md``."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, lru_cache
from math import pi
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, field_validator, model_validator

from op3.robot.assets import asset_folder
from op3.robot.data_file import DataFile, DataFileError, Record
from op3.robot.servo_make import ServoMake, load_servo, servo_files
from op3.settings import nearest

Array = NDArray[np.float64]

ANGLES: Mapping[str, float | None] = {"rad": 1.0, "deg": pi / 180, "turn": 2 * pi, "count": None}
"""Units of a log's angles [rad]; that of a count is the encoder's."""

ADJUSTABLE = ("mass", "center_of_mass_x", "center_of_mass_y", "center_of_mass_z")
"""What a robot's parameters may set of a body."""


class LogChannel(Record):
    """What a foreign log of a joint holds: position = sign * (reading - zero) in `unit`; the rest takes the sign.

    Attributes:
        name: of the joint in the log; None: as here.
        sign: 1 or -1.
        zero: reading at joint angle zero, in `unit`.
        unit: of angles and, per second, of velocities: one of `ANGLES`.
        velocity_factor: by which velocities are multiplied beside that.
    """

    name: str | None = None
    sign: Literal[1, -1] = 1
    zero: float = 0.0
    unit: str = "rad"
    velocity_factor: float = 1.0

    @field_validator("unit")
    @classmethod
    def _known_unit(cls, unit: str) -> str:
        if unit not in ANGLES:
            raise ValueError(f"names the unit {unit!r}, which there is not{nearest(unit, ANGLES)}")
        return unit


class JointEntry(Record):
    """One joint of a robot file.

    Attributes:
        servo: make of its servo; None: that of the file.
        bus_id: id of its servo on the bus.
        limits: lowest and highest angle that software may command [rad]; None: the model's range, else half a turn
            either way.
        home: angle in the robot's home pose [rad].
        mirror: joint on the other side; None where there is none.
        log: what a foreign log of it holds.
    """

    servo: str | None = None
    bus_id: int | None = Field(default=None, ge=0, le=252)
    limits: tuple[float, float] | None = None
    home: float = 0.0
    mirror: str | None = None
    log: LogChannel = LogChannel()


class AdjustableNumber(Record):
    """A number of the model that differs from robot to robot, such as the mass of a pendulum.

    Attributes:
        default: in `unit`.
        unit: of it.
        body: that it changes.
        sets: one of `ADJUSTABLE`.
        factor: by which it is multiplied there.
    """

    default: float
    unit: str
    body: str
    sets: str
    factor: float = 1.0

    @field_validator("sets")
    @classmethod
    def _known_field(cls, name: str) -> str:
        if name not in ADJUSTABLE:
            raise ValueError(f"names {name!r}, which cannot be set{nearest(name, ADJUSTABLE)}")
        return name


class RobotFile(Record):
    """The content of a robot file.

    Attributes:
        format: version of the file's form.
        name: what the robot is called.
        model: its MJCF or URDF, relative to the file.
        source: where its numbers come from.
        base: body that carries the rest; None: whatever the joints hang on.
        fixed: whether the base is bolted to something, and never free.
        imu: site of the IMU, if it has one.
        feet: bodies that it stands on, if it does.
        servo: make of the servos of all joints that name none.
        law: servo model that is taken where none is asked for, a name in conf/servo; None: one made of its servos.
        joints: by name, in the order of the model.
        controlled: joints that policies and identification focus on; None: all. The others are held at home.
        parameters: numbers of the model that differ, by name.
    """

    format: Literal["op3-robot/1"]
    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$")
    model: str
    joints: dict[str, JointEntry] = Field(min_length=1)
    source: str | None = None
    base: str | None = None
    fixed: bool = False
    imu: str | None = None
    feet: tuple[str, ...] = ()
    servo: str | None = None
    law: str | None = None
    controlled: tuple[str, ...] | None = None
    parameters: dict[str, AdjustableNumber] = {}

    @model_validator(mode="before")
    @classmethod
    def _empty_joints(cls, values: Any) -> Any:
        """A joint about which nothing is to be said is written without a value."""
        joints = values.get("joints") if isinstance(values, dict) else None
        if isinstance(joints, dict):
            values = {**values, "joints": {name: {} if entry is None else entry for name, entry in joints.items()}}
        return values


class Robot:
    """A robot: what its file says, and what follows from it and its model. Every [joint] axis is in its order.

    Args:
        path: of the file.

    Raises:
        DataFileError: in one sentence, with file, line and the nearest valid name, if something in it cannot be.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path).resolve()
        file = DataFile(self.path)
        self.file = file.read(RobotFile)
        self.name = self.file.name
        self.joints: tuple[str, ...] = tuple(self.file.joints)
        self.model_path = (self.path.parent / self.file.model).resolve()
        self._index = {name: number for number, name in enumerate(self.joints)}
        self.bare_model = _bare(file, self.model_path)
        check(file, self)
        self.limits: Array = np.array([self._limits(name) for name in self.joints])
        self.home: Array = np.array([entry.home for entry in self.file.joints.values()])
        for name, home, (low, high) in zip(self.joints, self.home, self.limits, strict=True):
            if not low <= home <= high:
                raise file.fault(("joints", name, "home"), f"is {home:g} rad, outside its limits {low:g} to {high:g}")

    @property
    def reference(self) -> str:
        """What a log or a config calls it: its name if it comes with the project, else the path of its file."""
        return self.name if robot_files().get(self.name) == self.path else str(self.path)

    @property
    def controlled(self) -> tuple[str, ...]:
        """The joints that policies and identification focus on."""
        return self.joints if self.file.controlled is None else self.file.controlled

    @property
    def held(self) -> tuple[str, ...]:
        """The other joints."""
        return tuple(name for name in self.joints if name not in self.controlled)

    @property
    def bus_ids(self) -> dict[str, int]:
        """Bus id of each joint's servo; in the joints' order from 1 where the file gives none."""
        given = {name: entry.bus_id for name, entry in self.file.joints.items()}
        if all(bus_id is None for bus_id in given.values()):
            return {name: number for number, name in enumerate(self.joints, start=1)}
        return {name: bus_id for name, bus_id in given.items() if bus_id is not None}

    def indices(self, names: Iterable[str]) -> NDArray[np.int64]:
        """Places of joints, ``[joint]`` in the order of `names`.

        Raises:
            ValueError: if it has no such joint.
        """
        wanted = [names] if isinstance(names, str) else list(names)
        unknown = [name for name in wanted if name not in self._index]
        if unknown:
            raise ValueError(f"unknown joint {unknown[0]!r} of {self.name}{nearest(unknown[0], self.joints)}")
        return np.array([self._index[name] for name in wanted], dtype=np.int64)

    def servo(self, joint: str) -> ServoMake:
        """The make of a joint's servo."""
        return load_servo(self.file.joints[joint].servo or self.file.servo or "")

    @cached_property
    def servos(self) -> tuple[ServoMake, ...]:
        """The makes of all servos [joint]."""
        return tuple(self.servo(name) for name in self.joints)

    @cached_property
    def speed_limits(self) -> Array:
        """Fastest commanded speed [joint] in rad/s: nine tenths of the servos' speed without load at their supply."""
        speeds = [
            (s.limits.no_load_speed.si, s.limits.no_load_speed.at or s.supply.si, s.supply.si) for s in self.servos
        ]
        return np.array([0.9 * speed * min(1.0, supply / at) for speed, at, supply in speeds])

    @cached_property
    def limbs(self) -> tuple[tuple[str, ...], ...]:
        """Joints that hang together without the base, each limb in the model's order."""
        model, groups = self.bare_model, {}
        bodies = {int(model.joint(name).bodyid[0]): name for name in self.joints}
        for body, name in bodies.items():
            first, above = body, body
            while above:
                first = above if above in bodies else first
                above = int(model.body_parentid[above])
            groups.setdefault(first, []).append(name)
        return tuple(tuple(sorted(names, key=self._index.__getitem__)) for names in groups.values())

    def whole_limbs(self, joints: Iterable[str]) -> tuple[str, ...]:
        """All joints of the limbs in which these are, in the robot's order."""
        wanted = set(joints)
        chosen = {joint for limb in self.limbs if wanted & set(limb) for joint in limb}
        return tuple(name for name in self.joints if name in chosen)

    @cached_property
    def mirror(self) -> dict[str, tuple[str, int]]:
        """For each joint, its partner in the mirror (itself on the middle line) and the sign its angle takes there.

        An axis of rotation is an axial vector, so the reflection in the plane y = 0 takes (x, y, z) to (-x, y, -z).

        Raises:
            ValueError: if the file names no partners.
        """
        pairs = {name: entry.mirror for name, entry in self.file.joints.items() if entry.mirror}
        if not pairs:
            raise ValueError(f"{self.name} has no left and right: its file names no mirror partners")
        pairs.update({partner: name for name, partner in pairs.items()})
        axes, found = self._axes, {}
        for name in self.joints:
            partner = pairs.get(name, name)
            x, y, z = axes[self._index[name]]
            found[name] = partner, int(np.sign(np.dot((-x, y, -z), axes[self._index[partner]])))
        return found

    def mirrored(self, joint_position: ArrayLike) -> Array:
        """Joint angles (or velocities, or torques) ``[..., joint]`` of its mirror image."""
        partners = np.array([self._index[self.mirror[name][0]] for name in self.joints])
        signs = np.array([self.mirror[name][1] for name in self.joints], dtype=float)
        # the sign of a pair is the same both ways, so the receiving joint's sign serves
        return np.asarray(joint_position, dtype=float)[..., partners] * signs

    @cached_property
    def _axes(self) -> Array:
        """Axes of the joints in the base's frame at angle zero, [joint, xyz]."""
        data = mujoco.MjData(self.bare_model)
        mujoco.mj_kinematics(self.bare_model, data)
        return np.array([data.joint(name).xaxis for name in self.joints])

    def symmetric(self, half: Mapping[str, ArrayLike]) -> Array:
        """Whole-body angles ``[..., joint]`` from those of one side; joints that are not named are zero.

        Args:
            half: angle [rad] by joint, scalars or arrays [...] of one shape.
        """
        shape = np.broadcast_shapes(*(np.shape(value) for value in half.values()))
        position = np.zeros((*shape, len(self.joints)))
        for index, value in zip(self.indices(half), half.values(), strict=True):
            position[..., index] = value
        return position + self.mirrored(position)

    def position(self, joint_position: ArrayLike) -> Array:
        """Joint angles as a finite float array [joint] of the right length, or a clear error."""
        position = np.asarray(joint_position, dtype=float)
        if position.shape != (len(self.joints),):
            raise ValueError(f"joint_position must have shape ({len(self.joints)},), got {position.shape}")
        if not np.isfinite(position).all():
            raise ValueError(f"joint_position must be finite, got {position}")
        return position

    def log_channel(self, joint: str) -> tuple[LogChannel, float]:
        """What a foreign log of a joint holds, and its unit of angle [rad]."""
        channel = self.file.joints[joint].log
        return channel, ANGLES[channel.unit] or self.servo(joint).position_unit

    def _limits(self, name: str) -> tuple[float, float]:
        given = self.file.joints[name].limits
        if given is not None:
            return given
        joint = self.bare_model.joint(name)
        low, high = joint.range if self.bare_model.jnt_limited[joint.id] else (-pi, pi)
        return float(low), float(high)

    def __repr__(self) -> str:
        return f"Robot({self.reference!r})"

    def __reduce__(self):
        return load_robot, (str(self.path),)


@lru_cache(maxsize=1)
def robot_files() -> dict[str, Path]:
    """The files of all robots that come with the project, by name."""
    return {path.stem: path.resolve() for path in sorted(asset_folder("robots").glob("*.yaml"))}


DEFAULT = "op3"
"""The robot that is meant where none is named."""


def load_robot(name: str | Path | Robot = DEFAULT) -> Robot:
    """A robot by its name in ``assets/robots`` or by the path of its file.

    Raises:
        DataFileError: if there is none, or its file is wrong.
    """
    if isinstance(name, Robot):
        return name
    known = robot_files()
    path = known.get(str(name)) or Path(name)
    if path.suffix not in (".yaml", ".yml"):
        raise DataFileError(f"there is no robot {str(name)!r}{nearest(str(name), known)}, or give the path of a .yaml")
    if not path.is_file():
        raise DataFileError(f"there is no robot file {path}{nearest(path.stem, known)}, or correct the path")
    return _loaded(path.resolve(), path.stat().st_mtime_ns)


@lru_cache(maxsize=32)
def _loaded(path: Path, changed: int) -> Robot:
    return Robot(path)


def read_spec(path: Path) -> mujoco.MjSpec:
    """The robot's model as MuJoCo reads it, MJCF or URDF, without what drives it and without a free base."""
    spec = mujoco.MjSpec.from_file(str(path))
    for element in (*spec.actuators, *spec.sensors, *spec.keys):
        spec.delete(element)
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
    return spec


def _bare(file: DataFile, path: Path) -> mujoco.MjModel:
    """The compiled model, its base fixed."""
    if not path.is_file():
        raise file.fault(("model",), f"names {path}, where there is no file")
    try:
        return read_spec(path).compile()
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        raise file.fault(("model",), f"names {path.name}, which MuJoCo cannot read: {reason}") from None


def check(file: DataFile, robot: Robot) -> None:
    """Refuse names that neither the model nor the project has, and what contradicts itself."""
    model, content = robot.bare_model, robot.file
    _check_joints(file, model, robot)
    bodies = [model.body(number).name for number in range(model.nbody)]
    sites = [model.site(number).name for number in range(model.nsite)]
    wanted: list[tuple[tuple[str | int, ...], str, str | None, Sequence[str]]] = [
        (("base",), "body", content.base, bodies),
        (("imu",), "site", content.imu, sites),
        *((("feet", number), "body", foot, bodies) for number, foot in enumerate(content.feet)),
        *((("parameters", name, "body"), "body", one.body, bodies) for name, one in content.parameters.items()),
        *((("controlled", n), "joint", name, robot.joints) for n, name in enumerate(content.controlled or ())),
    ]
    for place, what, name, known in wanted:
        if name is not None and name not in known:
            raise file.unknown(place, what, name, known)


def _check_joints(file: DataFile, model: mujoco.MjModel, robot: Robot) -> None:
    hinges = [model.joint(number).name for number in range(model.njnt)]
    ids: dict[int, str] = {}
    for name, entry in robot.file.joints.items():
        place = ("joints", name)
        if name not in hinges:
            raise file.unknown(place, "joint", name, hinges)
        if model.jnt_type[model.joint(name).id] != mujoco.mjtJoint.mjJNT_HINGE:
            raise file.fault(place, "is no hinge in the model; a servo drives hinges only")
        make = entry.servo or robot.file.servo
        if make is None:
            raise file.fault(place, "has no servo: name its make here or under `servo:` for all joints")
        if make.lower() not in servo_files() and not make.endswith(".yaml"):
            raise file.unknown((*place, "servo") if entry.servo else ("servo",), "servo", make, servo_files())
        if entry.mirror is not None and entry.mirror not in robot.joints:
            raise file.unknown((*place, "mirror"), "joint", entry.mirror, robot.joints)
        if entry.limits is not None and not entry.limits[0] < entry.limits[1]:
            raise file.fault((*place, "limits"), f"go from {entry.limits[0]:g} to {entry.limits[1]:g}: the lower first")
        if entry.bus_id in ids:
            raise file.fault(
                (*place, "bus_id"), f"is {entry.bus_id}, as that of {ids[entry.bus_id]}; give each its own"
            )
        if entry.bus_id is not None:
            ids[entry.bus_id] = name
    for name in hinges:
        if name not in robot.joints:
            raise file.fault(("joints",), f"leave out the model's joint {name!r}; list it, or take it out of the model")
    if hinges != list(robot.joints):
        raise file.fault(("joints",), f"stand in another order than in the model; write {', '.join(hinges)}")
