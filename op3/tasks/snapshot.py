"""The state of robots in a scene that tasks judge: what their sensors say, and what only a simulator knows."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor

from op3.policy.leg_kinematics import leg_kinematics
from op3.robot import Scene, load_robot
from op3.sim import ServoPorts
from op3.tasks import rewards
from op3.tasks.addresses import Addresses
from op3.tasks.whole_step import Throughout

_INNER_TIPS = load_robot().inner_tips


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Robots at one time, tensors ``[sim, ...]``.

    Attributes:
        readings: what sensors say before quantisation, by the names of `op3.tasks.rules.UNITS`.
        current: of the motors, ``[sim, joint]`` in A.
        specific_force: of the IMU, ``[sim, 3]`` in m/s^2.
        height: of the trunk's origin above the ground's, ``[sim]`` in m.
        velocity: of the trunk in the world, ``[sim, 3]`` in m/s.
        foot_force: between ankle and foot, left and right, ``[sim, 2]`` in N; None for tasks without a gait.
        foot_speed: mean over a foot's key points in the world, ``[sim, 2]`` in m/s.
        tip: how far ahead the inner tip of the foremost foot is in the world, ``[sim]`` in m.
    """

    readings: dict[str, Tensor]
    current: Tensor
    specific_force: Tensor
    height: Tensor
    velocity: Tensor
    foot_force: Tensor | None = None
    foot_speed: Tensor | None = None
    tip: Tensor | None = None

    def at_the_end(self) -> Throughout:
        """A policy step as if it had been all the time like this."""
        acceleration = rewards.norm(rewards.body_acceleration(self.specific_force, self.readings["orientation"]))
        none = torch.zeros(len(self.height), 2, dtype=torch.float64)
        force = none if self.foot_force is None else self.foot_force
        return Throughout(
            rewards.norm(self.current),
            rewards.norm(self.readings["angular_velocity"]),
            acceleration,
            force,
            none if self.foot_speed is None else self.foot_speed,
            none,
            none[:, 0],
            force.amax(1),
            acceleration,
            none[:, 0],
        )


class Probe:
    """Takes snapshots of robots from the arrays of their simulation.

    Args:
        feet: whether to look at the feet, which walking needs.
    """

    def __init__(self, model: mujoco.MjModel, scene: Scene, feet: bool):
        at = Addresses.find(model, scene)
        ports = ServoPorts.find(model, scene.joint_names)
        self._qpos, self._dof = ports.qpos, ports.dof
        self._base, self._base_dof = at.qpos, at.dof
        self._force = slice(at.accelerometer, at.accelerometer + 3)
        self._feet = at.foot_force[:, None] + np.arange(3) if feet else None
        self._ground = scene.ground_height

    def read(
        self, qpos: Tensor, qvel: Tensor, sensordata: Tensor, channels: Mapping[tuple[str, str], Tensor]
    ) -> Snapshot:
        """A snapshot.

        Args:
            qpos: ``[sim, nq]``.
            qvel: ``[sim, nv]``.
            sensordata: ``[sim, nsensordata]``.
            channels: what the servos and the IMU measure, as `op3.sim.BatchSimulation.measure` gives it.
        """
        base, dof = self._base, self._base_dof
        place, velocity = qpos[:, base : base + 3], qvel[:, dof : dof + 3].clone()
        feet = {}
        if self._feet is not None:
            points, speeds = leg_kinematics().key_points(qpos[:, self._qpos], qvel[:, self._dof])
            turn = rotation(qpos[:, base + 3 : base + 7])
            spin = qvel[:, dof + 3 : dof + 6]
            # of the points in the world: v + R (v_relative + w x p)
            moving = (speeds + torch.linalg.cross(spin[:, None], points)) @ turn.mT + velocity[:, None]
            tips = (points[:, _INNER_TIPS] @ turn.mT)[..., 0] + place[:, None, 0]
            feet = dict(
                foot_force=torch.linalg.vector_norm(sensordata[:, self._feet], dim=-1),
                foot_speed=torch.linalg.vector_norm(moving.unflatten(1, (2, 3)).mean(2), dim=-1),
                tip=tips.amax(1),
            )
        return Snapshot(
            readings={
                "joint_position": channels["joint", "position"],
                "joint_velocity": channels["joint", "velocity"],
                "orientation": channels["imu", "orientation"],
                "angular_velocity": channels["imu", "angular_velocity"],
            },
            current=channels["joint", "current"],
            specific_force=sensordata[:, self._force].clone(),
            height=place[:, 2] - self._ground,
            velocity=velocity,
            **feet,
        )


def rotation(quaternion: Tensor) -> Tensor:
    """Matrices ``[..., 3, 3]`` of unit quaternions ``[..., 4]``, w first."""
    w, x, y, z = quaternion.unbind(-1)
    return torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
