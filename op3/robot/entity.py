"""Any robot of a robot file as a dm_control composer entity: frictionless, unactuated hinges, ready for servos."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from dm_control import composer, mjcf

from op3.robot.model_source import read_model
from op3.robot.robot import Robot

IMU_SENSORS = {"imu_orientation": "framequat", "imu_gyro": "gyro", "imu_accelerometer": "accelerometer"}
"""Sensors at the site of an IMU, by name."""


class RobotEntity(composer.Entity):
    """The model of a robot file, with its base still fixed.

    Motors, sensors and keyframes of the model are omitted, and so are friction, damping and armature of the robot's
    joints, which the servo model attached to `joints` replaces. With a free base, qpos[:3] is the position of the base,
    qpos[7:] are the joint angles and qvel[6:] their velocities, in the robot's order.
    """

    def _build(self, robot: Robot, **parameters: float):
        self.robot = robot
        self._mjcf_root = root = _read(robot)
        root.model = robot.name
        for name in robot.joints:
            self._bare(self._find("joint", name), robot.bare_model)
        if robot.file.base is not None:
            base: Any = self._find("body", robot.file.base)
            if base.parent is root.worldbody:
                base.pos = [0.0, 0.0, 0.0]
            # the deepest contact between two parts of the robot
            root.sensor.add(
                "contact", name="self_contact", subtree1=base, subtree2=base, num=1, reduce="mindist", data="found dist"
            )
        if not robot.file.key_points:
            for name in robot.file.feet:
                foot: Any = self._find("body", name)
                foot.add("site", name=f"{name}_origin")
        self._adjust(parameters)
        if robot.file.imu is not None:
            for name, kind in IMU_SENSORS.items():
                reference = {"objtype": "site", "objname": self.imu} if kind == "framequat" else {"site": self.imu}
                root.sensor.add(kind, name=name, **reference)

    @staticmethod
    def _bare(joint: Any, model: mujoco.MjModel) -> None:
        """A hinge with explicit axis and position, without friction, damping and armature."""
        number = model.joint(joint.name).id
        joint.type, joint.axis, joint.pos = "hinge", model.jnt_axis[number].copy(), model.jnt_pos[number].copy()
        joint.damping = joint.frictionloss = joint.armature = 0.0
        joint.actuatorfrclimited = "false"

    def _adjust(self, parameters: dict[str, float]) -> None:
        known = self.robot.file.parameters
        for name in parameters:
            if name not in known:
                raise ValueError(f"{self.robot.name} has no parameter {name!r}; it has {', '.join(known) or 'none'}")
        for name, one in known.items():
            value, inertial = one.factor * parameters.get(name, one.default), self._with_inertia(one.body)
            if one.sets == "mass":
                inertial.inertial.mass = value
            else:
                place = np.array(inertial.inertial.pos, dtype=float)
                place["xyz".index(one.sets[-1])] = value
                inertial.inertial.pos = place

    def _with_inertia(self, name: str) -> Any:
        """A body with explicit inertia, which MuJoCo otherwise computes from geoms."""
        body: Any = self._find("body", name)
        if body.inertial is None:
            known = self.robot.bare_model.body(name)
            numbers = {"pos": known.ipos, "quat": known.iquat, "mass": known.mass[0], "diaginertia": known.inertia}
            body.add("inertial", **numbers)
        return body

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The robot's MJCF tree."""
        return self._mjcf_root

    @property
    def trunk(self) -> mjcf.Element:
        """The base body; the world if the file names none."""
        root: Any = self._mjcf_root
        return root.worldbody if self.robot.file.base is None else self._find("body", self.robot.file.base)

    @property
    def joints(self) -> list[mjcf.Element]:
        """The hinge elements [joint] in the robot's order."""
        return [self._find("joint", name) for name in self.robot.joints]

    @property
    def key_points(self) -> list[mjcf.Element]:
        """The sites on the soles, in the order of the file, or the origins of the feet."""
        file = self.robot.file
        return [self._find("site", name) for name in file.key_points or [f"{foot}_origin" for foot in file.feet]]

    @property
    def soles(self) -> list[mjcf.Element]:
        """The boxes of the soles, in the order of the file."""
        return [self._find("geom", name) for name in self.robot.file.soles]

    @property
    def ankles(self) -> list[mjcf.Element]:
        """The last joint above each foot."""
        return [self._find("joint", leg[-1]) for leg in self.robot.legs]

    @property
    def self_contact(self) -> mjcf.Element:
        """Self-contact sensor: number of contacts, and smallest distance [m], negative for penetration."""
        return self._find("sensor", "self_contact")

    @property
    def tip(self) -> mjcf.Element | None:
        """The site at the end of an arm; None if the file names none."""
        name = self.robot.file.tip
        return None if name is None else self._find("site", name)

    @property
    def imu(self) -> mjcf.Element:
        """The site of the IMU; a LookupError if the robot has none."""
        return self._find("site", self.robot.file.imu or "IMU")

    @property
    def imu_sensors(self) -> list[mjcf.Element]:
        """Sensors of the IMU: orientation in the world, as a quaternion (w, x, y, z), and angular velocity [rad/s] and
        specific force [m/s^2], +g upwards at rest, in the IMU's frame.

        On a fixed base MuJoCo's specific force is zero; see `Scene.mounted_specific_force`.
        """
        return [self._find("sensor", name) for name in IMU_SENSORS]

    def _find(self, kind: str, name: str) -> mjcf.Element:
        element = self._mjcf_root.find(kind, name)
        if element is None:
            raise LookupError(f"{self.robot.model_path} has no {kind} named {name!r}")
        return element


def _read(robot: Robot) -> Any:
    """The robot's model without actuators, sensors, free base and world."""
    spec = read_model(robot.model_path, robot.file).spec
    changed = robot.followed or any(part.ignored for part in robot.model_parts)
    # MuJoCo converts these to fit into op3's scenes
    if changed or robot.model_path.suffix == ".urdf" or spec.compiler.degree:
        spec.compile()
        root: Any = mjcf.from_xml_string(spec.to_xml(), model_dir=str(robot.model_path.parent))
    else:
        root = mjcf.from_path(str(robot.model_path))
    for kind in ("actuator", "sensor", "keyframe"):
        for element in getattr(root, kind).all_children():
            element.remove()
    for joint in root.find_all("joint"):
        if joint.tag == "freejoint" or joint.type == "free":
            joint.remove()
    for kind in ("option", "statistic", "visual"):
        getattr(root, kind).remove()
    for geom in root.worldbody.geom if robot.file.base else ():
        geom.remove()
    return root
