"""Readings of the sensors of servos and trunk, and addresses of the trunk's attitude in MuJoCo's state."""

from dataclasses import dataclass

import mujoco
import torch
from torch import Tensor

from op3.robot.kinematics import roll_pitch_yaw
from op3.servo import Servos, Trunk


@dataclass(frozen=True)
class BaseBody:
    """The robot's base body in a compiled model.

    Attributes:
        body: id of the body.
        qpos: address of its free joint in ``qpos``; None where the base is fixed.
        dof: address of its free joint in ``qvel``; None where the base is fixed.
    """

    body: int
    qpos: int | None
    dof: int | None

    @classmethod
    def find(cls, model: mujoco.MjModel, body: int) -> "BaseBody":
        """Look up the base; its free joint may belong to a frame to which it is welded."""
        root = model.body_rootid[body]
        if model.body_dofnum[root] != 6:
            return cls(body, None, None)
        joint = model.body_jntadr[root]
        return cls(body, int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]))

    def trunk(self, qpos: Tensor, qvel: Tensor, xquat: Tensor) -> Trunk:
        """Attitude and rates from MuJoCo's arrays, ``[sim, ...]``."""
        if self.qpos is None or self.dof is None:
            return Trunk(xquat[:, self.body], torch.zeros(len(qpos), 3, dtype=torch.float64))
        return Trunk(qpos[:, self.qpos + 3 : self.qpos + 7], qvel[:, self.dof + 3 : self.dof + 6].clone())


def readings(law: Servos, trunk: Trunk | None = None) -> dict[tuple[str, str], Tensor]:
    """Current readings of the servos' and the trunk's sensors: channels of the log, ``[sim, joint | 3]``."""
    law.report()
    signals = law.signals
    channels = {
        ("joint", "position"): signals.measured_position.clone(),
        ("joint", "velocity"): signals.measured_velocity.clone(),
        ("joint", "current"): signals.measured_current.clone(),
    }
    if trunk is not None:
        seen = law.sense_trunk(trunk)
        channels[("imu", "orientation")] = torch.from_numpy(roll_pitch_yaw(seen.quaternion.numpy()))
        channels[("imu", "angular_velocity")] = seen.angular_velocity
    return channels


def undo_sensing(law: Servos, reading: Tensor) -> Tensor:
    """Joint positions at which the sensors give these readings [rad], ``[sim, joint]``."""
    signals = law.signals
    signals.position, signals.velocity = reading, 0.0
    for _ in range(3):  # one round is exact for an offset; nonlinear readings need more
        law.sense()
        signals.position += reading - signals.measured_position
    return signals.position
