"""Where the soles are and how fast they move, from joint angles and velocities alone: what a robot can compute."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from op3.robot import load_robot


class LegKinematics:
    """Forward kinematics of both legs, batched, in torch float64, differentiable.

    Link offsets, axes and key points are read from the robot's model; use the shared `leg_kinematics`.
    """

    def __init__(self):
        robot = load_robot()
        model, names = robot.bare_model, robot.legs
        self._count, self._length = len(robot.joints), len(names[0])
        joints = [[model.joint(name) for name in leg] for leg in names]
        # [joint of the leg, leg, ...]
        self._index = torch.from_numpy(np.array([robot.indices(leg) for leg in names]).T.copy())
        offset = np.array([[model.body(int(joint.bodyid[0])).pos for joint in leg] for leg in joints])
        axis = np.array([[joint.axis for joint in leg] for leg in joints])
        if any(model.body(int(j.bodyid[0])).quat[0] != 1.0 or j.pos.any() for leg in joints for j in leg):
            raise ValueError(f"{robot.model_path}: leg links must be parallel to the trunk, joints at their origins")
        self._offset = torch.from_numpy(offset.swapaxes(0, 1).copy())
        self._axis = torch.from_numpy(axis.swapaxes(0, 1).copy())
        skew = torch.zeros(self._length, 2, 3, 3, dtype=torch.float64)
        x, y, z = self._axis.unbind(-1)
        skew[..., 0, 1], skew[..., 0, 2], skew[..., 1, 2] = -z, y, -x
        self._skew = skew - skew.mT
        self._square = self._skew @ self._skew
        points = np.array([model.site(name).pos for name in robot.file.key_points]).reshape(2, -1, 3)
        self._points = torch.from_numpy(points)

    def key_points(self, joint_position: Tensor, joint_velocity: Tensor) -> tuple[Tensor, Tensor]:
        """The six key points with the trunk as origin, in the trunk's frame.

        The velocity is that of the points relative to the trunk: the Jacobian times the joint velocities.

        Args:
            joint_position: ``[..., joint]`` in rad, in the robot's order, float64.
            joint_velocity: ``[..., joint]`` in rad/s.

        Returns:
            Position in m and velocity in m/s, each ``[..., key point, xyz]`` in the order of the robot's file.
        """
        if joint_position.shape[-1] != self._count:
            raise ValueError(f"joint_position must end with {self._count} joints, got {tuple(joint_position.shape)}")
        angle = joint_position[..., self._index]  # [..., joint of the leg, leg]
        sine, versine = torch.sin(angle)[..., None, None], 1.0 - torch.cos(angle)[..., None, None]
        turns = _IDENTITY + sine * self._skew + versine * self._square  # Rodrigues
        rotation: Tensor = _IDENTITY
        origin = torch.zeros(3, dtype=torch.float64)
        axes, origins = [], []
        for joint in range(self._length):
            origin = origin + (rotation @ self._offset[joint][..., None])[..., 0]
            axes.append((rotation @ self._axis[joint][..., None])[..., 0].expand(*angle.shape[:-2], 2, 3))
            origins.append(origin.expand(*angle.shape[:-2], 2, 3))
            rotation = rotation @ turns[..., joint, :, :, :]
        points = origin[..., None, :] + self._points @ rotation.mT  # [..., leg, point, xyz]
        # sum_j w_j x (p - o_j) = (sum_j w_j) x p - sum_j w_j x o_j
        spin = torch.stack(axes, -3) * joint_velocity[..., self._index][..., None]
        moment = torch.linalg.cross(spin, torch.stack(origins, -3)).sum(-3)
        velocity = torch.linalg.cross(spin.sum(-3)[..., None, :], points) - moment[..., None, :]
        return points.flatten(-3, -2), velocity.flatten(-3, -2)


_IDENTITY = torch.eye(3, dtype=torch.float64)


@lru_cache(maxsize=1)
def leg_kinematics() -> LegKinematics:
    """The robot's legs."""
    return LegKinematics()
