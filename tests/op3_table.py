"""The OP3's joints as its file gives them, for tests that are about the OP3."""

import mujoco
import numpy as np

from op3.robot import load_robot

OP3 = load_robot("op3")
JOINTS = OP3.joints
SERVO_IDS = OP3.bus_ids
CONTROLLED_JOINTS = OP3.controlled
SOFT_LIMITS = {name: (float(low), float(high)) for name, (low, high) in zip(JOINTS, OP3.limits, strict=True)}
LOW, HIGH = OP3.limits.T
MIRROR = OP3.mirror
KEY_POINTS = OP3.file.key_points
LEG_JOINTS = OP3.legs[1]
LIMBS = OP3.limbs
IS_LEG = np.array([any(joint in leg for leg in OP3.legs) for joint in JOINTS])
indices, mirror = OP3.indices, OP3.mirrored


def center_of_mass(joint_position) -> np.ndarray:
    """Centre of mass of the whole robot relative to its base [m]."""
    data = mujoco.MjData(OP3.bare_model)
    data.qpos[:] = joint_position
    mujoco.mj_kinematics(OP3.bare_model, data)
    mujoco.mj_comPos(OP3.bare_model, data)
    return data.subtree_com[0] - data.body(OP3.file.base).xpos
