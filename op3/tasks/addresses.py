"""Indices of the values that tasks read from the arrays of a simulation."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from op3.scenes import Scene

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Addresses:
    """Indices of a robot in a compiled scene.

    Attributes:
        base: index of its base body.
        qpos: index of the first of the base's seven numbers in qpos; None for a fixed base.
        dof: index of the first of its six numbers in qvel; None for a fixed base.
        accelerometer: index of the first of three numbers in sensordata; None without an IMU.
        self_contact: index of the first of two numbers in sensordata: number of contacts, and smallest distance [m].
        foot_force: index of the first of three numbers in sensordata for each foot ``[foot]``.
        foot_points: numbers of the sites of the key points ``[foot, point]``.
        inner_tips: numbers of the sites of the feet's inner tips.
        tip: number of the site of an arm's tip; None without one.
    """

    base: int
    qpos: int | None
    dof: int | None
    accelerometer: int | None
    self_contact: int
    foot_force: Index
    foot_points: Index
    inner_tips: Index
    tip: int | None

    @classmethod
    def find(cls, model: mujoco.MjModel, scene: Scene) -> Addresses:
        """Look up the indices in a compiled scene.

        Raises:
            ValueError: if the scene has no robot.
        """
        entity = scene.robot
        if entity is None:
            raise ValueError(f"scene {scene.name!r} contains no robot")
        base = int(model.body(entity.trunk.full_identifier).id)
        root = int(model.body_rootid[base])
        free = model.jnt(int(model.body_jntadr[root])) if scene.floating and model.body_dofnum[root] == 6 else None
        feet = len(entity.robot.file.feet)
        points = np.array([model.site(site.full_identifier).id for site in entity.key_points], dtype=np.int64)
        ankles = [f"{ankle.full_identifier}_force" for ankle in entity.ankles]
        imu, tip = entity.robot.file.imu, entity.tip
        return cls(
            base,
            None if free is None else int(free.qposadr[0]),
            None if free is None else int(free.dofadr[0]),
            None if imu is None else int(model.sensor(entity.imu_sensors[2].full_identifier).adr[0]),
            int(model.sensor(entity.self_contact.full_identifier).adr[0]),
            np.array([int(model.sensor(name).adr[0]) for name in ankles], dtype=np.int64),
            points.reshape(feet, -1) if feet else points.reshape(0, 0),
            points[entity.robot.inner_tips] if len(points) == len(entity.robot.file.key_points) else points,
            None if tip is None else int(model.site(tip.full_identifier).id),
        )
