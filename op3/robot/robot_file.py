"""The content of a robot file, ``assets/robots/<name>.yaml`` or a user's own; see ``docs/your_robot.md``."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from math import pi, radians
from pathlib import Path
from typing import Annotated, Any, Literal

import mujoco
from pydantic import Field, model_validator

from op3.common.assets import model_names
from op3.robot.data_file import DataFile, Real, Record, among
from op3.robot.servo_make import Loop, ServoMake, load_servo, servo_files

FORMAT = "op3-robot/1"
"""Version of the format of robot files."""

ANGLES: Mapping[str, float | None] = {"rad": 1.0, "deg": pi / 180, "turn": 2 * pi, "count": None}
"""Units of a log's angles [rad]; a count is the encoder's count."""

ADJUSTABLE = ("mass", "center_of_mass_x", "center_of_mass_y", "center_of_mass_z")
"""Properties of a body that a robot's parameters may set."""

BOARD_ID = 200
"""Bus id of an OpenCR."""


class LogChannel(Record):
    """Convention of a joint in external logs: position = sign * (reading - zero) in `unit`; the sign applies to all.

    Attributes:
        name: name of the joint in the log; None: the same name.
        sign: 1 or -1.
        zero: reading at joint angle zero, in `unit`.
        unit: unit of angles and, per second, of velocities: one of `ANGLES`.
        velocity_factor: further factor of velocities: 0.5 if the log has twice the rate.
    """

    name: str | None = None
    sign: Literal[1, -1] = 1
    zero: Real = 0.0
    unit: Annotated[str, among("unit", ANGLES)] = "rad"
    velocity_factor: Real = 1.0


class JointEntry(Record):
    """One joint of a robot file.

    Attributes:
        servo: make of its servo; None: the file's `servo`.
        bus_id: id of its servo on the bus.
        limits: lowest and highest angle that software may command [rad]; None: the model's range, else half a turn
            either way.
        home: angle in the robot's home pose [rad].
        peak_current: largest current that software may command [A]; None: the largest of its make.
        mirror: joint on the other side; None if there is none.
        travel: travel of the model's slide per angle of its servo [m/rad]; the joint position is then that angle. None:
            a hinge.
        log: convention in external logs.
    """

    servo: str | None = None
    bus_id: int | None = Field(default=None, strict=True, ge=0, le=252)
    limits: tuple[Real, Real] | None = None
    home: Real = 0.0
    peak_current: Real | None = Field(default=None, gt=0)
    mirror: str | None = None
    travel: Real | None = None
    log: LogChannel = LogChannel()


class Coupling(Record):
    """Coupling of a joint to another: its position is `offset` plus `ratio` times that of `joint` [rad; m for a slide].

    Attributes:
        joint: joint that it follows.
        ratio: ratio of the positions.
        offset: position when that joint is at zero.
    """

    joint: str
    ratio: Real = 1.0
    offset: Real = 0.0


class Unpowered(Record):
    """A joint without a servo; exactly one attribute is set.

    Attributes:
        passive: moves freely, with the spring, damping and friction of the model.
        coupled: follows another joint.
        held: fixed at this position [rad, m].
    """

    passive: Literal[True] | None = None
    coupled: Coupling | None = None
    held: Real | None = None

    @model_validator(mode="after")
    def _one(self) -> Unpowered:
        if sum(value is not None for value in (self.passive, self.coupled, self.held)) != 1:
            raise ValueError("must have one of passive: true, coupled and held")
        return self


class AdjustableNumber(Record):
    """A parameter of the model that differs between robots, such as the mass of a pendulum.

    Attributes:
        default: default value in `unit`.
        unit: unit of the parameter.
        body: body that it changes.
        sets: one of `ADJUSTABLE`.
        factor: factor from the parameter to the body's property.
    """

    default: Real
    unit: str
    body: str
    sets: Annotated[str, among("number", ADJUSTABLE)]
    factor: Real = 1.0


class RobotFile(Record):
    """The content of a robot file.

    Attributes:
        format: version of the file format.
        name: name of the robot.
        model: MJCF or URDF, relative to the file.
        source: source of the numbers.
        base: base body; None: the parent of the joints.
        fixed: whether the base is bolted down.
        imu: site of the IMU, if it has one.
        feet: bodies that touch the ground, the left one first.
        soles: geoms under the feet that touch the floor, all boxes.
        key_points: sites of the soles whose positions a policy observes, equally many per foot, in the order of `feet`;
            the first of each foot is its inner tip. Without key points, a policy observes the origins of the feet.
        tip: site at the end of an arm, for reaching tasks.
        servo: make of the servos of all joints without an entry `servo`.
        loop: `current` or `firmware`, the position loop of all servos; None: the loop of their makes.
        law: default model, a name in assets/models; None: a model built from its servo makes.
        board: board that switches the servos' supply and has the IMU; None: servos always have power, and there is no
            IMU.
        joints: joints with a servo, by name, in the order of the model; entries with `passive`, `coupled` or `held`
            become `unpowered`.
        unpowered: the model's joints without a servo. Joints that mimic others, by a URDF's `mimic` or an MJCF's
            equality, are coupled without an entry.
        controlled: joints that policies command and over which errors are averaged; None: all. Others are held at home.
        poses: angles by joint [rad] of named poses; other joints mirror their partner or are at home.
        parameters: parameters of the model that differ between robots, by name.
    """

    split_from = {"unpowered": "joints"}
    format: Literal["op3-robot/1"]
    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$")
    model: str
    joints: dict[str, JointEntry] = Field(min_length=1)
    unpowered: dict[str, Unpowered] = {}
    source: str | None = None
    base: str | None = None
    fixed: bool = Field(default=False, strict=True)
    imu: str | None = None
    feet: tuple[str, ...] = ()
    soles: tuple[str, ...] = ()
    key_points: tuple[str, ...] = ()
    tip: str | None = None
    servo: str | None = None
    loop: Loop | None = None
    law: Annotated[str, among("law", model_names())] | None = None
    board: Literal["opencr"] | None = None
    controlled: tuple[str, ...] | None = Field(default=None, min_length=1)
    poses: dict[str, dict[str, Real]] = {}
    parameters: dict[str, AdjustableNumber] = {}

    @model_validator(mode="before")
    @classmethod
    def _empty_joints(cls, values: Any) -> Any:
        """A joint without properties may have no value in the file."""
        joints = values.get("joints") if isinstance(values, dict) else None
        if isinstance(joints, dict):
            joints = {name: {} if entry is None else entry for name, entry in joints.items()}
            free = {n: e for n, e in joints.items() if isinstance(e, dict) and Unpowered.model_fields.keys() & e.keys()}
            driven = {name: entry for name, entry in joints.items() if name not in free}
            values = {**values, "joints": driven, "unpowered": free}
        return values


def check_names(file: DataFile, content: RobotFile, model: mujoco.MjModel, coupled: Collection[str] = ()) -> None:
    """Raise an error for unknown names and contradictory entries.

    Args:
        file: the file.
        content: content of the file.
        model: compiled model.
        coupled: joints that follow others.

    Raises:
        DataFileError: with file, line and the nearest valid name.
    """
    names = {
        kind: [name for number in range(count) if (name := getattr(model, kind)(number).name) not in ("", "world")]
        for kind, count in (("body", model.nbody), ("site", model.nsite), ("geom", model.ngeom))
    }
    names["joint"] = list(content.joints)
    _check_joints(file, content, model, coupled)
    _check_partners(file, content)
    wanted: list[tuple[tuple[str | int, ...], str, str | None]] = [
        (("base",), "body", content.base),
        (("imu",), "site", content.imu),
        (("tip",), "site", content.tip),
        *((("feet", number), "body", name) for number, name in enumerate(content.feet)),
        *((("soles", number), "geom", name) for number, name in enumerate(content.soles)),
        *((("key_points", number), "site", name) for number, name in enumerate(content.key_points)),
        *((("parameters", name, "body"), "body", one.body) for name, one in content.parameters.items()),
        *((("controlled", number), "joint", name) for number, name in enumerate(content.controlled or ())),
        *((("poses", pose, name), "joint", name) for pose, angles in content.poses.items() for name in angles),
    ]
    for place, kind, name in wanted:
        if name is not None and name not in names[kind]:
            raise file.unknown(place, kind, name, names[kind])
    for name in set(content.poses) & {"home", "stand", "zero"}:
        raise file.fault(("poses", name), "is a pose that every robot has; use another name")
    for name, one in content.parameters.items():
        if one.sets == "mass" and one.factor * one.default <= 0:
            raise file.fault(
                ("parameters", name), f"makes a mass of {one.factor * one.default:g} kg; the mass must be above 0"
            )
    if content.key_points and len(content.key_points) % max(1, len(content.feet)):
        raise file.fault(
            ("key_points",), f"are {len(content.key_points)}, which is not a multiple of the number of feet"
        )


def slide_of(joint: str) -> str:
    """Name, in the compiled model, of the slide that a joint of this name drives."""
    return f"{joint}_slide"


def _check_joints(file: DataFile, content: RobotFile, model: mujoco.MjModel, coupled: Collection[str]) -> None:
    hinges = [model.joint(number).name for number in range(model.njnt)]
    makes: list[ServoMake] = []
    if "" in hinges:
        raise file.fault(("model",), f"has no name for its joint number {hinges.index('') + 1}: give it one")
    ids = {} if content.board is None else {BOARD_ID: f"the {content.board}"}
    for name, entry in content.joints.items():
        place = ("joints", name)
        if name not in hinges:
            raise file.unknown(place, "joint", name, hinges)
        if model.jnt_type[model.joint(name).id] != mujoco.mjtJoint.mjJNT_HINGE:
            problem = (
                "is not a hinge in the model: write `travel: <m/rad>` if a servo moves it as a slide, `held: 0.0` "
            )
            problem += "if it stays in place, or `coupled: {joint: <hinge>, ratio: <m/rad>}` if a hinge drives it"
            raise file.fault(place, problem)
        if entry.travel is not None and slide_of(name) not in hinges:
            raise file.fault((*place, "travel"), "applies to a slide joint, but the model has a hinge here; remove it")
        if entry.travel is not None and not 1e-4 <= abs(entry.travel) <= 1:
            raise file.fault(
                (*place, "travel"), f"is {entry.travel:g} m/rad, which is implausible for a servo; write m/rad"
            )
        makes.append(_make(file, content, name))
        if (loop := content.loop or makes[-1].loop) != (content.loop or makes[0].loop):
            first = f"{next(iter(content.joints))} has {makes[0].loop!r} ({makes[0].name})"
            whose = f"has a servo with the loop {loop!r} ({makes[-1].name}), but {first}"
            raise file.fault(place, f"{whose}: set one `loop:` for all servos")
        if entry.limits is not None:
            _check_limits(file, (*place, "limits"), entry.limits, model.joint(name), makes[-1].position_unit)
        if entry.bus_id is not None:
            if entry.bus_id in ids:
                other = ids[entry.bus_id]
                raise file.fault((*place, "bus_id"), f"is {entry.bus_id}, which {other} also has; use another id")
            ids[entry.bus_id] = name
    given = [entry.bus_id is not None for entry in content.joints.values()]
    if any(given) and not all(given):
        name = list(content.joints)[given.index(False)]
        raise file.fault(("joints", name), "has no bus_id although other joints have one; add a unique bus_id")
    for name, entry in content.unpowered.items():
        place = ("joints", name)
        if name not in hinges:
            raise file.unknown(place, "joint", name, hinges)
        if model.jnt_type[model.joint(name).id] == mujoco.mjtJoint.mjJNT_BALL:
            raise file.fault(place, "is a ball joint in the model: remove it from the model, which fixes the part")
        low, high = model.joint(name).range
        if entry.held is not None and model.joint(name).limited and not low <= entry.held <= high:
            raise file.fault((*place, "held"), f"is {entry.held:g}, beyond the model's {low:.4g} to {high:.4g}")
        if entry.coupled and entry.coupled.joint not in content.joints:
            raise file.unknown((*place, "coupled"), "joint with a servo", entry.coupled.joint, content.joints)
    known = {*content.joints, *content.unpowered, *coupled}
    for name in hinges:
        if name not in known and model.jnt_type[model.joint(name).id] == mujoco.mjtJoint.mjJNT_BALL:
            problem = f"omit the ball joint {name!r}, which no servo can drive; remove it from the model"
            raise file.fault(("joints",), problem)
        if name not in known:
            problem = f"omit the model's joint {name!r}: list it with its servo, or as `{name}: {{passive: true}}`, "
            raise file.fault(("joints",), f"{problem}`{{coupled: {{joint: ..., ratio: ...}}}}` or `{{held: 0.0}}`")
    if (order := [name for name in hinges if name in content.joints]) != list(content.joints):
        raise file.fault(
            ("joints",), f"are in a different order than in the model; write them in the order {', '.join(order)}"
        )


def _check_limits(
    file: DataFile, place: tuple[str, ...], limits: tuple[float, float], joint: Any, count: float
) -> None:
    """Raise an error for invalid ranges, and for limits beyond the model's range by more than an encoder count.

    Without a range, the limit is a turn either way: angles in degrees must be noticed.
    """
    (low, high), (first, last) = limits, joint.range if joint.limited else (-2 * pi, 2 * pi)
    if not low < high:
        raise file.fault(place, f"go from {low:g} to {high:g}: give the lower one first")
    if low < first - count or high > last + count:
        most = (
            f"the model's {first:.4g} to {last:.4g}" if joint.limited else "a turn either way (the model has no range)"
        )
        raise file.fault(place, f"go from {low:g} to {high:g} rad, beyond {most}{in_degrees(low, high)}")


def in_degrees(*angles: float) -> str:
    """Hint after angles [rad] that are probably degrees; empty if they are not."""
    largest = max(angles, key=abs)
    return f"; write radians: {largest:g} deg is {radians(largest):.4g}" if abs(largest) > 2 * pi else ""


def _check_partners(file: DataFile, content: RobotFile) -> None:
    """Raise an error for a joint that mirrors itself or has two partners."""
    partners: dict[str, str] = {}
    for name, entry in content.joints.items():
        if entry.mirror is None:
            continue
        place, pair = ("joints", name, "mirror"), {name: entry.mirror, entry.mirror: name}
        if entry.mirror not in content.joints:
            raise file.unknown(place, "joint", entry.mirror, content.joints)
        if entry.mirror == name:
            raise file.fault(place, "names the joint itself; omit `mirror`")
        if taken := [one for one, other in pair.items() if partners.setdefault(one, other) != other]:
            raise file.fault(place, f"is {entry.mirror}, but {taken[0]} already has the partner {partners[taken[0]]}")


def servo_path(file: Path, named: str) -> str | Path:
    """Path of the servo that a robot file names: a name in assets/servos, or a file relative to the robot's."""
    return file.parent / named if named.endswith((".yaml", ".yml")) else named


def _make(file: DataFile, content: RobotFile, joint: str) -> ServoMake:
    """The make of a joint's servo, with the loop set in the file."""
    own = content.joints[joint].servo
    named, place = own or content.servo, ("joints", joint, "servo") if own else ("servo",)
    if named is None:
        raise file.fault(("joints", joint), "has no servo: name its make here or under `servo:` for all joints")
    path = servo_path(file.path, named)
    if isinstance(path, str) and named.lower() not in servo_files():
        raise file.unknown(place, "servo", named, servo_files())
    if isinstance(path, Path) and not os.path.isfile(path):
        raise file.fault(place, f"names {path}, which does not exist; correct the path")
    make = load_servo(path)
    if content.loop == "firmware" and make.position_law is None:
        raise file.fault(
            ("loop",),
            f"is 'firmware', but the {make.name} of {joint} has no position_law; add one to its file, or change `loop`",
        )
    return make
