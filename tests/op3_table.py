"""The OP3's joints as its file gives them, for tests that are about the OP3."""

import itertools

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


def posed(joint_position) -> mujoco.MjData:
    """The robot at these angles, its base upright and fixed."""
    data = mujoco.MjData(OP3.bare_model)
    data.qpos[:] = joint_position
    mujoco.mj_kinematics(OP3.bare_model, data)
    mujoco.mj_comPos(OP3.bare_model, data)
    return data


def center_of_mass(joint_position) -> np.ndarray:
    """Centre of mass of the whole robot relative to its base [m]."""
    data = posed(joint_position)
    return data.subtree_com[0] - data.body(OP3.file.base).xpos


def sole_corners(joint_position) -> np.ndarray:
    """Corners of the boxes of the soles relative to the base [m], [sole box, corner, xyz]."""
    data, signs = posed(joint_position), np.array(list(itertools.product((-1, 1), repeat=3)))
    boxes = [(data.geom(name), OP3.bare_model.geom(name).size) for name in OP3.file.soles]
    corners = [box.xpos + (signs * half) @ box.xmat.reshape(3, 3).T for box, half in boxes]
    return np.array(corners) - data.body(OP3.file.base).xpos
