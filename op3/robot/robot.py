"""Robots, each read from one file: ``assets/robots/<name>.yaml`` or a user's own. See ``docs/your_robot.md``."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Iterable, Mapping
from functools import cached_property, lru_cache
from math import pi
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.common.assets import robot_file, robot_files
from op3.common.settings import nearest
from op3.robot.data_file import DataFile, DataFileError
from op3.robot.model_source import ModelSource, read_model
from op3.robot.robot_file import ANGLES, LogChannel, RobotFile, check_names, in_degrees, servo_path
from op3.robot.servo_make import ServoMake, load_servo, supply_shares

Array = NDArray[np.float64]

_log = logging.getLogger("op3.robot")

DEFAULT = "op3"
"""Default robot of commands and of logs in the first format."""


class Robot:
    """A robot: the content of its file, and quantities derived from its model; [joint] axes are in its order.

    Raises:
        DataFileError: in one sentence, with file, line and the nearest valid name, if an entry is invalid.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path).resolve()
        file = DataFile(self.path)
        self.file = file.read(RobotFile)
        self.name = self.file.name
        self.joints: tuple[str, ...] = tuple(self.file.joints)
        self.model_path = (self.path.parent / self.file.model).resolve()
        self._index = {name: number for number, name in enumerate(self.joints)}
        source = _source(file, self.model_path, self.file)
        self.bare_model, self.followed, self.model_parts = source[0], source[1].followed, source[1].parts
        check_names(file, self.file, self.bare_model, self.followed)
        for part in (part for part in self.model_parts if part.ignored):
            _log.warning("%s: %s", self.model_path.name, part)
        self.limits: Array = np.array([self._limits(name) for name in self.joints])
        self.home: Array = np.array([entry.home for entry in self.file.joints.values()])
        angles = [(("joints", name, "home"), name, entry.home) for name, entry in self.file.joints.items()]
        angles += [(("poses", pose, name), name, a) for pose, own in self.file.poses.items() for name, a in own.items()]
        for place, name, angle in angles:
            low, high = self.limits[self._index[name]]
            if not low <= angle <= high:
                problem = f"is {angle:g} rad, outside its limits {low:g} to {high:g}"
                raise file.fault(place, problem + in_degrees(angle))

    @property
    def reference(self) -> str:
        """Reference in logs and configs: the name of a robot of the project, otherwise the path of the file."""
        return self.name if robot_files().get(self.name) == self.path else str(self.path)

    @cached_property
    def content_hash(self) -> str:
        """Twelve hex digits of the content of its file, its servos and its compiled model."""
        digest = hashlib.sha256(repr((self.file, self.servos)).encode())
        arrays = ((name, getattr(self.bare_model, name)) for name in sorted(dir(self.bare_model)))
        for name, values in arrays:
            if isinstance(values, np.ndarray):
                digest.update(name.encode() + values.tobytes())
        return digest.hexdigest()[:12]

    @property
    def firmware_gain(self) -> Array:
        """Factory gain of each servo's position law, ``[joint]`` in firmware units; 0 without a position law."""
        return np.array([0.0 if make.position_law is None else make.position_law.gain.si for make in self.servos])

    @property
    def controlled(self) -> tuple[str, ...]:
        """The joints that policies command and over which errors are averaged."""
        return self.joints if self.file.controlled is None else self.file.controlled

    @property
    def bus_ids(self) -> dict[str, int]:
        """Bus id of each joint's servo; from 1 in the joints' order if the file gives none."""
        entries = self.file.joints.items()
        return {name: n if e.bus_id is None else e.bus_id for n, (name, e) in enumerate(entries, start=1)}

    def indices(self, names: Iterable[str]) -> NDArray[np.int64]:
        """Indices of joints, ``[joint]`` in the order of `names`.

        Raises:
            ValueError: if the robot has no such joint.
        """
        wanted = [names] if isinstance(names, str) else list(names)
        unknown = [name for name in wanted if name not in self._index]
        if unknown:
            raise ValueError(f"unknown joint {unknown[0]!r} of {self.name}{nearest(unknown[0], self.joints)}")
        return np.array([self._index[name] for name in wanted], dtype=np.int64)

    def servo(self, joint: str) -> ServoMake:
        """The make of a joint's servo, with the loop set in the file."""
        make = load_servo(servo_path(self.path, self.file.joints[joint].servo or self.file.servo or ""))
        return make.model_copy(update={"loop": self.file.loop or make.loop})

    @cached_property
    def servos(self) -> tuple[ServoMake, ...]:
        """The makes of all servos [joint]."""
        return tuple(self.servo(name) for name in self.joints)

    @cached_property
    def supply_shares(self) -> Array:
        """See `op3.robot.servo_make.supply_shares`."""
        return supply_shares(self.servos)

    @property
    def supply(self) -> float | None:
        """Nominal voltage of the servos' supply [V]; None if they have several."""
        return self.servos[0].supply.si if (self.supply_shares == 1).all() else None

    @cached_property
    def peak_currents(self) -> Array:
        """Largest current that software may command [joint] in A."""
        entries = zip(self.file.joints.values(), self.servos, strict=True)
        return np.array([entry.peak_current or make.peak_current for entry, make in entries])

    @cached_property
    def speed_limits(self) -> Array:
        """Fastest commanded speed [joint] in rad/s: nine tenths of the servos' no-load speed at their supply."""
        free = [(make.limits.no_load_speed, make.supply.si) for make in self.servos]
        return np.array([0.9 * speed.si * min(1.0, supply / (speed.at or supply)) for speed, supply in free])

    @cached_property
    def limbs(self) -> tuple[tuple[str, ...], ...]:
        """Joints of each limb, connected without the base, in the model's order."""
        groups: dict[str, list[str]] = {}
        for name in self.joints:
            groups.setdefault(self._above(int(self.bare_model.joint(name).bodyid[0]))[0], []).append(name)
        return tuple(tuple(names) for names in groups.values())

    @cached_property
    def legs(self) -> tuple[tuple[str, ...], ...]:
        """Joints between the base and each foot, from the base outwards."""
        return tuple(self._above(self.bare_model.body(foot).id) for foot in self.file.feet)

    @property
    def arm(self) -> tuple[str, ...]:
        """Joints between the base and the tip, from the base outwards; none without a tip."""
        tip = self.file.tip
        return () if tip is None else self._above(int(self.bare_model.site_bodyid[self.bare_model.site(tip).id]))

    @cached_property
    def sole_geoms(self) -> tuple[int, ...]:
        """Ids of the geoms on which the robot stands, in the bare model: soles, or colliding geoms of the feet."""
        model = self.bare_model
        if self.file.soles:
            return tuple(int(model.geom(name).id) for name in self.file.soles)
        feet = {int(model.body(name).id) for name in self.file.feet}
        touches = (model.geom_contype | model.geom_conaffinity) != 0
        return tuple(int(g) for g in range(model.ngeom) if int(model.geom_bodyid[g]) in feet and touches[g])

    @property
    def inner_tips(self) -> list[int]:
        """Indices of the key points at the inner tips of the feet."""
        count = len(self.file.key_points)
        return list(range(0, count, max(1, count // max(1, len(self.file.feet)))))

    def _above(self, body: int) -> tuple[str, ...]:
        """Joints that move a body, from the base outwards."""
        found: list[str] = []
        while body:
            found += [name for name in self.joints[::-1] if self.bare_model.joint(name).bodyid[0] == body]
            body = int(self.bare_model.body_parentid[body])
        return tuple(found[::-1])

    def whole_limbs(self, joints: Iterable[str]) -> tuple[str, ...]:
        """All joints of the limbs that contain these joints, in the robot's order."""
        wanted = set(joints)
        chosen = {joint for limb in self.limbs if wanted & set(limb) for joint in limb}
        return tuple(name for name in self.joints if name in chosen)

    @property
    def partners(self) -> dict[str, str]:
        """Joints and their partners on the other side, in both directions; empty if the file names none."""
        pairs = {name: entry.mirror for name, entry in self.file.joints.items() if entry.mirror}
        return {**pairs, **{partner: name for name, partner in pairs.items()}}

    @cached_property
    def mirror(self) -> dict[str, tuple[str, int]]:
        """For each joint, its mirror partner (itself on the middle line) and the sign of the mirrored angle.

        An axis of rotation is an axial vector, so the reflection in the plane y = 0 takes (x, y, z) to (-x, y, -z).

        Raises:
            ValueError: if the file names no partners.
        """
        pairs = self.partners
        if not pairs:
            raise ValueError(f"{self.name} has no mirrored joints: add `mirror` to the joints in its file")
        data, found = mujoco.MjData(self.bare_model), {}
        mujoco.mj_kinematics(self.bare_model, data)
        for name in self.joints:
            partner = pairs.get(name, name)
            x, y, z = data.joint(name).xaxis
            found[name] = partner, int(np.sign(np.dot((-x, y, -z), data.joint(partner).xaxis)))
        return found

    def mirrored(self, joint_position: ArrayLike) -> Array:
        """Joint angles (or velocities, or torques) ``[..., joint]`` of its mirror image."""
        partners = self.indices(self.mirror[name][0] for name in self.joints)
        signs = np.array([self.mirror[name][1] for name in self.joints], dtype=float)
        # the sign is the same in both directions, so the receiving joint's sign is used
        return np.asarray(joint_position, dtype=float)[..., partners] * signs

    def completed(self, angles: Mapping[str, ArrayLike]) -> Array:
        """Whole-body angles ``[..., joint]`` in rad from the angles of some joints; the others mirror their partner or
        are at home.
        """
        shape = np.broadcast_shapes(*(np.shape(value) for value in angles.values()))
        position = np.tile(self.home, (*shape, 1))
        for index, value in zip(self.indices(angles), angles.values(), strict=True):
            position[..., index] = value
        if self.partners:
            image = self.mirrored(position)
            partner_only = [name not in angles and self.mirror[name][0] in angles for name in self.joints]
            position = np.where(partner_only, image, position)
        return position

    def pose(self, name: str) -> Array:
        """Joint angles [joint] in rad of a named pose: "home" (also called "stand"), "zero", or one of its file.

        Raises:
            ValueError: if the robot has no such pose.
        """
        if name in ("home", "stand"):
            return self.home.copy()
        if name == "zero":
            return np.zeros(len(self.joints))
        if name not in self.file.poses:
            known = ("home", "stand", "zero", *self.file.poses)
            raise ValueError(f"{self.name} has no pose {name!r}; it has {', '.join(known)}")
        return self.completed(self.file.poses[name])

    def position(self, joint_position: ArrayLike) -> Array:
        """Joint angles as a finite float array [joint], checked."""
        return checked_angles(joint_position, len(self.joints))

    @property
    def unpowered(self) -> bool:
        """Whether its model has joints without a servo."""
        return self.bare_model.njnt > len(self.joints)

    def configuration(self, joint_position: ArrayLike) -> Array:
        """Positions of all joints of the bare model [joint of the model] in rad and m.

        Joints without a servo follow the others or are at rest.
        """
        position = self.position(joint_position)
        if not self.unpowered:
            return position
        places, whole = self.bare_model.jnt_qposadr, self.bare_model.qpos0.copy()
        whole[[places[self.bare_model.joint(name).id] for name in self.joints]] = position
        for name, (driver, ratio, offset) in self.followed.items():
            angle = 0.0 if driver is None else position[self._index[driver]]
            whole[places[self.bare_model.joint(name).id]] = offset + ratio * angle
        return whole

    def gravity(self, joint_position: ArrayLike) -> Array:
        """Torques that hold its joints [joint] against gravity with the base upright [N m]."""
        model, data = self.bare_model, mujoco.MjData(self.bare_model)
        data.qpos[:] = self.configuration(joint_position)
        mujoco.mj_forward(model, data)
        by_name = {model.joint(number).name: data.qfrc_bias[model.jnt_dofadr[number]] for number in range(model.njnt)}
        torque = np.array([by_name[name] for name in self.joints])
        for name, (driver, ratio, _) in self.followed.items():
            if driver is not None:
                torque[self._index[driver]] += ratio * by_name[name]
        return torque

    def log_channel(self, joint: str) -> tuple[LogChannel, float]:
        """Convention of a joint in external logs, and its unit of angle [rad]."""
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


def load_robot(name: str | Path | Robot) -> Robot:
    """A robot by its name in ``assets/robots`` or by the path of its file; raises `DataFileError` if missing or
    invalid."""
    if isinstance(name, Robot):
        return name
    try:
        path = robot_file(name)
    except ValueError as error:
        raise DataFileError(str(error)) from None
    return _loaded(path.resolve(), path.stat().st_mtime_ns)


@lru_cache(maxsize=32)
def _loaded(path: Path, changed: int) -> Robot:
    return Robot(path)


def checked_angles(joint_position: ArrayLike, count: int) -> Array:
    """Joint angles as a finite float array [count], checked."""
    position = np.asarray(joint_position, dtype=float)
    if position.shape != (count,):
        raise ValueError(f"joint_position must have shape ({count},), got {position.shape}")
    if not np.isfinite(position).all():
        raise ValueError(f"joint_position must be finite, got {position}")
    return position


def pose(name: str, robot: str | Robot) -> Array:
    """Joint angles [joint] in rad of a robot's pose; see `Robot.pose`."""
    return load_robot(robot).pose(name)


def exclude_neighbours(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Exclude collisions between a fixed body and its children, as MuJoCo does for moving bodies."""
    for body in spec.bodies:
        above = body.parent
        while body.joints and body.name and above and not above.joints and above.name not in ("", "world"):
            spec.add_exclude(bodyname1=above.name, bodyname2=body.name)
            above = above.parent
    return spec


def _source(file: DataFile, path: Path, content: RobotFile) -> tuple[mujoco.MjModel, ModelSource]:
    """The compiled model with its base fixed, and its source."""
    if not os.path.isfile(path):  # False also for a name that is too long
        raise file.fault(("model",), f"names {path}, which does not exist; correct the path")
    try:
        source = read_model(path, content)
        model = source.spec.compile()
        model.names.decode()  # detects non-text bytes
        return model, source
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        raise file.fault(("model",), f"names {path.name}, which cannot be read: {reason}") from None
