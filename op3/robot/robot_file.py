"""The content of a robot file, ``assets/robots/<name>.yaml`` or a user's own; see ``docs/your_robot.md``."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Mapping
from math import pi
from typing import Annotated, Any, Literal

import mujoco
from pydantic import Field, model_validator

from op3.robot.assets import named_configs
from op3.robot.data_file import DataFile, Record, among
from op3.robot.servo_make import servo_files

ANGLES: Mapping[str, float | None] = {"rad": 1.0, "deg": pi / 180, "turn": 2 * pi, "count": None}
"""Units of a log's angles [rad]; that of a count is the encoder's."""

ADJUSTABLE = ("mass", "center_of_mass_x", "center_of_mass_y", "center_of_mass_z")
"""What a robot's parameters may set of a body."""

BOARD_ID = 200
"""Bus id of an OpenCR."""


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
    unit: Annotated[str, among("unit", ANGLES)] = "rad"
    velocity_factor: float = 1.0


class JointEntry(Record):
    """One joint of a robot file.

    Attributes:
        servo: make of its servo; None: that of the file.
        bus_id: id of its servo on the bus.
        limits: lowest and highest angle that software may command [rad]; None: the model's range, else half a turn
            either way.
        home: angle in the robot's home pose [rad].
        peak_current: largest current that software may command [A]; None: the largest of its make.
        mirror: joint on the other side; None where there is none.
        log: what a foreign log of it holds.
    """

    servo: str | None = None
    bus_id: int | None = Field(default=None, ge=0, le=252)
    limits: tuple[float, float] | None = None
    home: float = 0.0
    peak_current: float | None = Field(default=None, gt=0)
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
    sets: Annotated[str, among("number", ADJUSTABLE)]
    factor: float = 1.0


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
        feet: bodies that it stands on, if it does, the left one first.
        soles: geoms under the feet that touch the floor, all boxes.
        key_points: sites of the soles whose place a policy sees, as many per foot, in the order of `feet`; the first of
            each foot is its inner tip.
        servo: make of the servos of all joints that name none.
        law: servo model that is taken where none is asked for, a name in conf/servo; None: one made of its servos.
        board: what switches the servos' supply and holds the IMU on the bus; None: the servos have power, and no IMU.
        joints: by name, in the order of the model.
        controlled: joints that policies and identification focus on; None: all. The others are held at home.
        poses: angles by joint [rad] of named poses; a joint not named is as its mirror partner, else at home.
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
    soles: tuple[str, ...] = ()
    key_points: tuple[str, ...] = ()
    servo: str | None = None
    law: Annotated[str, among("law", named_configs("servo"))] | None = None
    board: Literal["opencr"] | None = None
    controlled: tuple[str, ...] | None = None
    poses: dict[str, dict[str, float]] = {}
    parameters: dict[str, AdjustableNumber] = {}

    @model_validator(mode="before")
    @classmethod
    def _empty_joints(cls, values: Any) -> Any:
        """A joint about which nothing is to be said is written without a value."""
        joints = values.get("joints") if isinstance(values, dict) else None
        if isinstance(joints, dict):
            values = {**values, "joints": {name: {} if entry is None else entry for name, entry in joints.items()}}
        return values


def check_names(file: DataFile, content: RobotFile, model: mujoco.MjModel) -> None:
    """Refuse names that neither the model nor the project has, and what contradicts itself.

    Raises:
        DataFileError: with file, line and the nearest valid name.
    """
    names = {
        kind: [name for number in range(count) if (name := getattr(model, kind)(number).name)]
        for kind, count in (("body", model.nbody), ("site", model.nsite), ("geom", model.ngeom))
    }
    names["joint"] = list(content.joints)
    _check_joints(file, content, model)
    wanted: list[tuple[tuple[str | int, ...], str, str | None]] = [
        (("base",), "body", content.base),
        (("imu",), "site", content.imu),
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
    if content.key_points and len(content.key_points) % max(1, len(content.feet)):
        raise file.fault(("key_points",), f"are {len(content.key_points)}, not as many for each of the feet")


def _check_joints(file: DataFile, content: RobotFile, model: mujoco.MjModel) -> None:
    hinges = [model.joint(number).name for number in range(model.njnt)]
    ids = {} if content.board is None else {BOARD_ID: f"the {content.board}"}
    for name, entry in content.joints.items():
        place = ("joints", name)
        if name not in hinges:
            raise file.unknown(place, "joint", name, hinges)
        if model.jnt_type[model.joint(name).id] != mujoco.mjtJoint.mjJNT_HINGE:
            raise file.fault(place, "is no hinge in the model; a servo drives hinges only")
        make = entry.servo or content.servo
        if make is None:
            raise file.fault(place, "has no servo: name its make here or under `servo:` for all joints")
        if make.lower() not in servo_files() and not make.endswith(".yaml"):
            raise file.unknown((*place, "servo") if entry.servo else ("servo",), "servo", make, servo_files())
        if entry.mirror is not None and entry.mirror not in content.joints:
            raise file.unknown((*place, "mirror"), "joint", entry.mirror, content.joints)
        if entry.limits is not None and not entry.limits[0] < entry.limits[1]:
            raise file.fault((*place, "limits"), f"go from {entry.limits[0]:g} to {entry.limits[1]:g}: the lower first")
        if entry.bus_id is not None:
            if entry.bus_id in ids:
                other = ids[entry.bus_id]
                raise file.fault((*place, "bus_id"), f"is {entry.bus_id}, as that of {other}; give each its own")
            ids[entry.bus_id] = name
    given = [entry.bus_id is not None for entry in content.joints.values()]
    if any(given) and not all(given):
        name = list(content.joints)[given.index(False)]
        raise file.fault(("joints", name), "has no bus_id, where other joints have one; give it its own")
    for name in hinges:
        if name not in content.joints:
            raise file.fault(("joints",), f"leave out the model's joint {name!r}; list it, or take it out of the model")
    if hinges != list(content.joints):
        raise file.fault(("joints",), f"stand in another order than in the model; write {', '.join(hinges)}")
