"""The OP3 as a dm_control composer entity."""

from typing import Any

import numpy as np
from dm_control import composer, mjcf
from dm_control.composer.observation import observable

from op3.robot.assets import asset_path
from op3.robot.joints import JOINTS
from op3.robot.kinematics import KEY_POINTS, SOLE_GEOMS


class OP3(composer.Entity):
    """The robot of `assets/op3/op3.xml`: twenty frictionless, unactuated hinges on a trunk.

    Servos are attached to `joints` by the caller. The origin of the entity is the origin of the trunk: the
    offset of 0.3 m in the file only lifts the robot when the file is viewed alone. So with a free base,
    qpos[:3] is the place of the trunk, qpos[7:27] are the joint angles and qvel[6:26] their velocities, in
    `JOINTS` order.
    """

    def _build(self, name: str = "op3"):
        self._mjcf_root = mjcf.from_path(str(asset_path("op3/op3.xml")))
        self._mjcf_root.model = name
        trunk: Any = self.trunk
        trunk.pos = [0.0, 0.0, 0.0]

    def _build_observables(self) -> "OP3Observables":
        return OP3Observables(self)

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The robot's own MJCF tree."""
        return self._mjcf_root

    @property
    def trunk(self) -> mjcf.Element:
        """The body that carries battery, computer and IMU."""
        return self._find("body", "body_link")

    @property
    def joints(self) -> list[mjcf.Element]:
        """The hinge elements [joint] in `JOINTS` order."""
        return [self._find("joint", name) for name in JOINTS]

    @property
    def key_points(self) -> list[mjcf.Element]:
        """The six sites on the soles, in the order of `KEY_POINTS`."""
        return [self._find("site", name) for name in KEY_POINTS]

    @property
    def soles(self) -> list[mjcf.Element]:
        """The four boxes of the soles, in the order of `SOLE_GEOMS`."""
        return [self._find("geom", name) for name in SOLE_GEOMS]

    @property
    def imu(self) -> mjcf.Element:
        """The site of the IMU."""
        return self._find("site", "imu")

    @property
    def imu_orientation(self) -> mjcf.Element:
        """Sensor of the IMU's orientation in the world, quaternion (w, x, y, z)."""
        return self._find("sensor", "imu_orientation")

    @property
    def imu_gyro(self) -> mjcf.Element:
        """Sensor of the angular velocity in the IMU's frame [rad/s]."""
        return self._find("sensor", "imu_gyro")

    @property
    def imu_accelerometer(self) -> mjcf.Element:
        """Sensor of the specific force in the IMU's frame [m/s^2]: +g upwards at rest.

        On a fixed base MuJoCo makes it read zero; see `Scene.mounted_specific_force`.
        """
        return self._find("sensor", "imu_accelerometer")

    def _find(self, kind: str, name: str) -> mjcf.Element:
        element = self._mjcf_root.find(kind, name)
        if element is None:
            raise LookupError(f"assets/op3/op3.xml has no {kind} named {name!r}")
        return element


class OP3Observables(composer.Observables):
    """What can be observed of an OP3. Every observable is off until a task enables it."""

    _entity: OP3

    @composer.observable
    def joint_positions(self) -> observable.MJCFFeature:
        """Joint angles [joint] in rad."""
        return observable.MJCFFeature("qpos", self._entity.joints)

    @composer.observable
    def joint_velocities(self) -> observable.MJCFFeature:
        """Joint velocities [joint] in rad/s."""
        return observable.MJCFFeature("qvel", self._entity.joints)

    @composer.observable
    def imu_orientation(self) -> observable.MJCFFeature:
        """Orientation of the trunk, quaternion (w, x, y, z)."""
        return observable.MJCFFeature("sensordata", self._entity.imu_orientation)

    @composer.observable
    def imu_gyro(self) -> observable.MJCFFeature:
        """Angular velocity [xyz] in rad/s, in the trunk's frame."""
        return observable.MJCFFeature("sensordata", self._entity.imu_gyro)

    @composer.observable
    def imu_accelerometer(self) -> observable.Generic:
        """Specific force [xyz] in m/s^2, in the trunk's frame; +g upwards at rest, also in the stand."""
        return observable.Generic(self._specific_force)

    @composer.observable
    def key_points(self) -> observable.Generic:
        """Key points relative to the trunk, in the trunk's frame, [key point, xyz] in m."""
        return observable.Generic(self._key_points)

    def _specific_force(self, physics: mjcf.Physics) -> np.ndarray:
        trunk = physics.bind(self._entity.trunk)
        # MuJoCo's accelerometer reads zero on a body that cannot move, where a real one reads gravity.
        if physics.model.body_weldid[trunk.element_id] == 0:
            return -np.asarray(trunk.xmat).reshape(3, 3).T @ physics.model.opt.gravity
        return np.array(physics.bind(self._entity.imu_accelerometer).sensordata)

    def _key_points(self, physics: mjcf.Physics) -> np.ndarray:
        trunk = physics.bind(self._entity.trunk)
        points = physics.bind(self._entity.key_points).xpos - trunk.xpos
        return points @ np.asarray(trunk.xmat).reshape(3, 3)
