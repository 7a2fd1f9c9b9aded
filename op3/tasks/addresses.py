"""Where the arrays of a simulation hold what tasks look at."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from op3.robot import Scene

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Addresses:
    """Of a robot whose trunk is free.

    Attributes:
        trunk: number of the body.
        qpos: first of the trunk's seven numbers in qpos.
        dof: first of its six in qvel.
        accelerometer: first of three in sensordata.
        self_contact: first of two in sensordata: number of contacts, and smallest distance [m].
        foot_force: first of three in sensordata, between ankle and foot, left and right ``[2]``.
        foot_points: numbers of the sites of the key points, left and right ``[2, point]``.
    """

    trunk: int
    qpos: int
    dof: int
    accelerometer: int
    self_contact: int
    foot_force: Index
    foot_points: Index

    @classmethod
    def find(cls, model: mujoco.MjModel, scene: Scene) -> Addresses:
        """In a compiled scene.

        Raises:
            ValueError: if it has no robot.
        """
        robot = scene.robot
        if robot is None:
            raise ValueError(f"scene {scene.name!r} has no robot to look at")
        trunk = int(model.body(robot.trunk.full_identifier).id)
        root = model.jnt(int(model.body_jntadr[model.body_rootid[trunk]]))
        points = [model.site(site.full_identifier).id for site in robot.key_points]
        return cls(
            trunk,
            int(root.qposadr[0]),
            int(root.dofadr[0]),
            int(model.sensor(robot.imu_accelerometer.full_identifier).adr[0]),
            int(model.sensor(robot.self_contact.full_identifier).adr[0]),
            np.array([int(model.sensor(f"{ankle.full_identifier}_force").adr[0]) for ankle in robot.ankles]),
            np.array(points).reshape(2, -1),
        )
