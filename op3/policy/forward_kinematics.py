"""Positions and velocities of the soles, computed from joint angles and velocities as on a robot."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from functools import lru_cache

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from op3.robot import Robot

PROCESSOR = torch.device("cpu")


class Chains:
    """Forward kinematics of chains of hinges attached to the base, batched, in torch float64, differentiable.

    Joints turn about their axes at angle zero, in order from the foot inwards (product of exponentials; Brockett 1984).
    Use the shared `leg_kinematics`.

    Args:
        chains: joint names of each chain, with equal numbers, from the base outwards.
        points: ``[chain, point, xyz]`` in the world of the robot's bare model at angle zero.
    """

    def __init__(self, robot: Robot, chains: Sequence[Sequence[str]], points: NDArray[np.float64]):
        data, model = _at_zero(robot), robot.bare_model
        self._count, self._length, self._chains = len(robot.joints), len(chains[0]), len(chains)
        base = 0 if robot.file.base is None else model.body(robot.file.base).id
        place, turn = data.xpos[base].copy(), data.xmat[base].reshape(3, 3).copy()
        joints = np.array([[model.joint(name).id for name in chain] for chain in chains])
        # [joint of the chain, chain, ...]
        self._index = torch.as_tensor(np.array([robot.indices(chain) for chain in chains]).T.copy())
        anchor = (data.xanchor[joints.T] - place) @ turn
        self._offset = torch.as_tensor(np.diff(anchor, axis=0, prepend=0.0))
        axis = torch.as_tensor(data.xaxis[joints.T] @ turn)
        self._axis = axis
        self._identity = torch.eye(3, dtype=torch.float64)
        skew = torch.zeros(self._length, self._chains, 3, 3, dtype=torch.float64)
        x, y, z = axis.unbind(-1)
        skew[..., 0, 1], skew[..., 0, 2], skew[..., 1, 2] = -z, y, -x
        self._skew = skew - skew.mT
        self._square = self._skew @ self._skew
        self._points = torch.as_tensor((points - place) @ turn - anchor[-1][:, None])

    def position(self, joint_position: Tensor) -> Tensor:
        """Position of the first chain's first point relative to the base, ``[..., xyz]`` in m; angles as for
        `key_points`."""
        return self.key_points(joint_position, torch.zeros_like(joint_position))[0][..., 0, :]

    def key_points(self, joint_position: Tensor, joint_velocity: Tensor) -> tuple[Tensor, Tensor]:
        """The key points with the base as origin, in the base's frame.

        The velocity of the points relative to the trunk is the Jacobian times the joint velocities.

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
        turns = self._identity + sine * self._skew + versine * self._square  # Rodrigues
        rotation, origin = self._identity, torch.zeros_like(self._identity[0])
        axes, origins = [], []
        for joint in range(self._length):
            origin = origin + (rotation @ self._offset[joint][..., None])[..., 0]
            axes.append((rotation @ self._axis[joint][..., None])[..., 0].expand(*angle.shape[:-2], self._chains, 3))
            origins.append(origin.expand(*angle.shape[:-2], self._chains, 3))
            rotation = rotation @ turns[..., joint, :, :, :]
        points = origin[..., None, :] + self._points @ rotation.mT  # [..., leg, point, xyz]
        # sum_j w_j x (p - o_j) = (sum_j w_j) x p - sum_j w_j x o_j
        spin = torch.stack(axes, -3) * joint_velocity[..., self._index][..., None]
        moment = torch.linalg.cross(spin, torch.stack(origins, -3)).sum(-3)
        velocity = torch.linalg.cross(spin.sum(-3)[..., None, :], points) - moment[..., None, :]
        return points.flatten(-3, -2), velocity.flatten(-3, -2)


def _at_zero(robot: Robot) -> mujoco.MjData:
    """The bare robot with all angles at zero."""
    data = mujoco.MjData(robot.bare_model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(robot.bare_model, data)
    return data


@lru_cache(maxsize=4)
def leg_kinematics(robot: Robot, device: torch.device = PROCESSOR) -> Chains:
    """A robot's legs and the key points of their soles, or the origins of its feet.

    Args:
        device: device of the angles.

    Raises:
        ValueError: if it has no feet, or legs of different numbers of joints.
    """
    if not robot.legs or len({len(leg) for leg in robot.legs}) != 1:
        raise ValueError(f"key points need legs with equal numbers of joints; {robot.name} has {len(robot.legs)} feet")
    data, file = _at_zero(robot), robot.file
    points = [data.site(n).xpos for n in file.key_points] or [data.body(n).xpos for n in file.feet]
    with device:
        return Chains(robot, robot.legs, np.array(points).reshape(len(robot.legs), -1, 3))


@lru_cache(maxsize=4)
def tip_kinematics(robot: Robot, device: torch.device = PROCESSOR) -> Chains:
    """The joints that move an arm's tip, and the tip.

    Args:
        device: device of the angles.

    Raises:
        ValueError: if the robot file names no tip.
    """
    if robot.file.tip is None:
        raise ValueError(f"the file of the robot {robot.name} has no tip; add tip: <site>")
    with device:
        return Chains(robot, [robot.arm], _at_zero(robot).site(robot.file.tip).xpos[None, None])
