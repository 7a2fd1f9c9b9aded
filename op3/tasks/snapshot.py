"""Robots at one time: sensor readings, and values that exist only in simulation."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import mujoco
import torch
from torch import Tensor

from op3.scenes import Scene
from op3.tasks import rewards
from op3.tasks.addresses import Addresses
from op3.tasks.whole_step import StepStatistics


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Robots at one time, tensors ``[sim, ...]``.

    Attributes:
        readings: sensor readings before quantisation: joint_position [rad], joint_velocity [rad/s], orientation [rad],
            angular_velocity [rad/s].
        current: current of the motors, ``[sim, joint]`` in A.
        specific_force: specific force of the IMU, ``[sim, 3]`` in m/s^2; zeros without one.
        place: position of the base's origin in the world, ``[sim, 3]`` in m.
        height: height of the base's origin above the ground's, ``[sim]`` in m.
        velocity: velocity of the base in the world, ``[sim, 3]`` in m/s.
        quaternion: quaternion of the base in the world, ``[sim, 4]``, w first.
        tip: forward position of the inner tip of the foremost foot in the world, ``[sim]`` in m; None without a gait.
        tip_position: position of an arm's tip relative to the base, in its frame, ``[sim, 3]`` in m; None without one.
    """

    readings: dict[str, Tensor]
    current: Tensor
    specific_force: Tensor
    place: Tensor
    height: Tensor
    velocity: Tensor
    quaternion: Tensor
    tip: Tensor | None = None
    tip_position: Tensor | None = None

    def at_the_end(self, step: StepStatistics) -> StepStatistics:
        """A policy step with constant currents and body motion, equal to the present values."""
        acceleration = rewards.norm(rewards.body_acceleration(self.specific_force, self.readings["orientation"]))
        rate = rewards.norm(self.readings["angular_velocity"])
        return step.replace(current=rewards.norm(self.current), angular_velocity=rate, acceleration=acceleration)


def to_device(values: Any, device: torch.device) -> Any:
    """A tensor, a mapping of tensors or an object of tensors, moved to a device."""
    if isinstance(values, Mapping):
        return {name: to_device(value, device) for name, value in values.items()}
    if is_dataclass(values):
        return type(values)(**{field.name: to_device(getattr(values, field.name), device) for field in fields(values)})
    return values.to(device) if isinstance(values, Tensor) else values


class Probe:
    """Takes snapshots of robots from the arrays of their simulation.

    Args:
        feet: whether to read the feet, which walking needs.
    """

    def __init__(self, model: mujoco.MjModel, scene: Scene, feet: bool):
        at = Addresses.find(model, scene)
        self._base, self._base_dof, self._body = at.qpos, at.dof, at.base
        self._force = None if at.accelerometer is None else slice(at.accelerometer, at.accelerometer + 3)
        self._tips = at.inner_tips if feet else None
        self._tip, self._ground = at.tip, scene.ground_height

    def read(
        self,
        qpos: Tensor,
        qvel: Tensor,
        sensordata: Tensor,
        bodies: tuple[Tensor, Tensor],
        site_xpos: Tensor,
        channels: Mapping[tuple[str, str], Tensor],
    ) -> Snapshot:
        """A snapshot.

        Args:
            qpos: ``[sim, nq]``.
            qvel: ``[sim, nv]``.
            sensordata: ``[sim, nsensordata]``.
            bodies: positions ``[sim, body, 3]`` and quaternions ``[sim, body, 4]``.
            site_xpos: ``[sim, site, 3]``.
            channels: readings of servos and IMU, from `op3.sim.BatchSimulation.measure`.
        """
        count = len(qpos)
        if self._base is None or self._base_dof is None:  # fixed base
            position, quaternion = bodies[0][:, self._body], bodies[1][:, self._body]
            velocity = torch.zeros(count, 3, dtype=torch.float64)
        else:
            position = qpos[:, self._base : self._base + 3]
            velocity = qvel[:, self._base_dof : self._base_dof + 3].clone()
            quaternion = qpos[:, self._base + 3 : self._base + 7]
        names = {"joint_position": ("joint", "position"), "joint_velocity": ("joint", "velocity")}
        names |= {"orientation": ("imu", "orientation"), "angular_velocity": ("imu", "angular_velocity")}
        tip = None if self._tip is None else site_xpos[:, self._tip] - position
        return Snapshot(
            readings={name: channels[key] for name, key in names.items()},
            current=channels["joint", "current"],
            specific_force=torch.zeros(count, 3, dtype=torch.float64)
            if self._force is None
            else sensordata[:, self._force].clone(),
            place=position.clone(),
            height=position[:, 2] - self._ground,
            velocity=velocity,
            quaternion=quaternion.clone(),
            tip=None if self._tips is None else site_xpos[:, self._tips, 0].amax(1),
            tip_position=None if tip is None else (rotation(quaternion).mT @ tip[..., None])[..., 0],
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
