"""The OP3 as a dm_control composer entity: what its soles and its IMU add to any robot."""

from typing import Any

import numpy as np
from dm_control import composer, mjcf
from dm_control.composer.observation import observable

from op3.robot.entity import RobotEntity, RobotObservables
from op3.robot.kinematics import KEY_POINTS, SOLE_GEOMS
from op3.robot.robot import Robot, load_robot


class OP3(RobotEntity):
    """Twenty frictionless, unactuated hinges on a trunk, with soles. The origin of the entity is that of the trunk."""

    def _build(self, robot: Robot | None = None, **parameters: float):
        super()._build(robot or load_robot("op3"), **parameters)

    def _build_observables(self) -> "OP3Observables":
        return OP3Observables(self)

    @property
    def key_points(self) -> list[mjcf.Element]:
        """The six sites on the soles, in the order of `KEY_POINTS`."""
        return [self._find("site", name) for name in KEY_POINTS]

    @property
    def soles(self) -> list[mjcf.Element]:
        """The four boxes of the soles, in the order of `SOLE_GEOMS`."""
        return [self._find("geom", name) for name in SOLE_GEOMS]


class OP3Observables(RobotObservables):
    """What can be observed of an OP3. Every observable is off until a task enables it."""

    _entity: Any

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
