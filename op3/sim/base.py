"""Where the trunk's attitude stands in MuJoCo's state."""

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Base:
    """The robot's base body in a compiled model.

    Attributes:
        body: its id.
        qpos: address of its free joint in ``qpos``; None where the base is fixed.
        dof: address of its free joint in ``qvel``; None where the base is fixed.
    """

    body: int
    qpos: int | None
    dof: int | None

    @classmethod
    def find(cls, model: mujoco.MjModel, body: int) -> "Base":
        """Look the base up; its free joint may belong to a frame that it is welded to."""
        root = model.body_rootid[body]
        if model.body_dofnum[root] != 6:
            return cls(body, None, None)
        joint = model.body_jntadr[root]
        return cls(body, int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]))

    def pose(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Orientation quaternion (w first) and angular velocity in the body frame [rad/s]."""
        if self.qpos is None or self.dof is None:
            return data.xquat[self.body], np.zeros(3)
        return data.qpos[self.qpos + 3 : self.qpos + 7], data.qvel[self.dof + 3 : self.dof + 6]


def roll_pitch_yaw(quaternion: Tensor) -> Tensor:
    """Euler angles [rad] of ``R = Rz(yaw) Ry(pitch) Rx(roll)`` from unit quaternions ``[..., 4]``, w first."""
    w, x, y, z = np.moveaxis(quaternion.detach().numpy(), -1, 0)  # of a few numbers, which numpy does sooner
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return torch.from_numpy(np.stack([roll, pitch, yaw], -1))
