"""Forward kinematics of the bare robot, by MuJoCo: where soles, key points and the centre of mass are.

All results are in the frame of the trunk (`body_link`: origin between the hip yaw axes, x forward, y left,
z up).
"""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.robot.assets import asset_path
from op3.robot.joints import JOINTS

KEY_POINTS: tuple[str, ...] = (
    "l_sole_inner_tip",
    "l_sole_outer_tip",
    "l_sole_heel",
    "r_sole_inner_tip",
    "r_sole_outer_tip",
    "r_sole_heel",
)
"""Sites of the six key points: inner and outer corner of each sole's front edge, middle of its heel edge.

The paper places "six key points on the three corners of each leg soles" without a drawing; these corners are
ours.
"""

SOLE_GEOMS: tuple[str, ...] = ("l_sole_long", "l_sole_wide", "r_sole_long", "r_sole_wide")
"""The boxes that make up the soles, two per foot."""

_CORNER_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)


@lru_cache(maxsize=1)
def _bare_model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(asset_path("op3/op3.xml")))


def check_joint_position(joint_position: ArrayLike, count: int = len(JOINTS)) -> NDArray[np.float64]:
    """Joint angles as a finite float array [joint] of the right length, or a clear error."""
    position = np.asarray(joint_position, dtype=float)
    if position.shape != (count,):
        raise ValueError(f"joint_position must have shape ({count},), got {position.shape}")
    if not np.isfinite(position).all():
        raise ValueError(f"joint_position must be finite, got {position}")
    return position


def _forward(joint_position: ArrayLike) -> tuple[mujoco.MjData, NDArray[np.float64]]:
    """MuJoCo data of the robot with its trunk fixed upright, and the trunk's place in it [3]."""
    model = _bare_model()
    data = mujoco.MjData(model)
    data.qpos[:] = check_joint_position(joint_position)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data, data.body("body_link").xpos.copy()


def sole_corners(joint_position: ArrayLike) -> NDArray[np.float64]:
    """Corners of the four sole boxes relative to the trunk [m].

    Args:
        joint_position: angles [joint] in rad.

    Returns:
        [sole box, corner, xyz], shape (4, 8, 3), boxes in the order of `SOLE_GEOMS`.
    """
    data, trunk = _forward(joint_position)
    corners = []
    for name in SOLE_GEOMS:
        box = data.geom(name)
        half = _bare_model().geom(name).size
        corners.append(box.xpos + (_CORNER_SIGNS * half) @ box.xmat.reshape(3, 3).T - trunk)
    return np.array(corners)


def sole_normals(joint_position: ArrayLike) -> NDArray[np.float64]:
    """Unit vectors that point up from the left and the right sole, in the trunk's frame, [foot, xyz]."""
    data, _ = _forward(joint_position)
    return np.array([data.body(f"{side}_ank_roll_link").xmat.reshape(3, 3)[:, 2] for side in "lr"])


def key_points(joint_position: ArrayLike) -> NDArray[np.float64]:
    """The six key points relative to the trunk [m], [key point, xyz] in the order of `KEY_POINTS`."""
    data, trunk = _forward(joint_position)
    return np.array([data.site(name).xpos for name in KEY_POINTS]) - trunk


def center_of_mass(joint_position: ArrayLike) -> NDArray[np.float64]:
    """Centre of mass of the whole robot relative to the trunk [m], [xyz]."""
    data, trunk = _forward(joint_position)
    return data.subtree_com[0] - trunk


def quaternion(roll: float, pitch: float, yaw: float = 0.0) -> NDArray[np.float64]:
    """Unit quaternion (w, x, y, z) of R = Rz(yaw) Ry(pitch) Rx(roll), angles in rad."""
    cr, sr = np.cos(roll / 2), np.sin(roll / 2)
    cp, sp = np.cos(pitch / 2), np.sin(pitch / 2)
    cy, sy = np.cos(yaw / 2), np.sin(yaw / 2)
    return np.array(
        [
            cy * cp * cr + sy * sp * sr,
            cy * cp * sr - sy * sp * cr,
            cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr,
        ]
    )


def rotation_matrix(roll: float, pitch: float, yaw: float = 0.0) -> NDArray[np.float64]:
    """The matrix R = Rz(yaw) Ry(pitch) Rx(roll) [3, 3], angles in rad."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion(roll, pitch, yaw))
    return matrix.reshape(3, 3)
