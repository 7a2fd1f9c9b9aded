"""Forward kinematics of a robot's soles and key points, computed by MuJoCo.

All results are in the frame of the base (of the OP3: origin between the hip yaw axes, x forward, y left, z up).
"""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.robot.robot import Robot, load_robot

Array = NDArray[np.float64]

_CORNER_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)


def _forward(joint_position: ArrayLike, robot: str | Robot) -> tuple[Robot, mujoco.MjData, Array]:
    """The robot, its MuJoCo data with the base fixed upright, and the base's position [3]."""
    known = load_robot(robot)
    data = mujoco.MjData(known.bare_model)
    data.qpos[:] = known.configuration(joint_position)
    mujoco.mj_kinematics(known.bare_model, data)
    base = known.file.base
    return known, data, np.zeros(3) if base is None else data.body(base).xpos.copy()


def key_points(joint_position: ArrayLike, robot: str | Robot) -> Array:
    """The key points relative to the base [m], [key point, xyz] in the order of the robot's file."""
    known, data, base = _forward(joint_position, robot)
    return np.array([data.site(name).xpos for name in known.file.key_points]) - base


def standing_height(joint_position: ArrayLike, robot: str | Robot, roll: float = 0.0, pitch: float = 0.0) -> float:
    """Height [m] of the base's origin above a floor that the soles touch.

    Args:
        joint_position: angles [joint] in rad.
        roll: roll of the base in rad.
        pitch: pitch of the base in rad, positive forward.
    """
    known, data, base = _forward(joint_position, robot)
    model, up = known.bare_model, rotation_matrix(roll, pitch)[2]
    lowest = []
    for geom in known.sole_geoms:
        place, turn = data.geom_xpos[geom] - base, data.geom_xmat[geom].reshape(3, 3)
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
            lowest.append(up @ place - model.geom_size[geom, 0])
        else:
            middle, half = np.split(model.geom_aabb[geom], 2)
            lowest.append(((place + (middle + _CORNER_SIGNS * half) @ turn.T) @ up).min())
    return -float(min(lowest))


@lru_cache(maxsize=8)
def home_height(robot: Robot) -> float:
    """Height [m] of the base's origin above level ground in the home pose."""
    return standing_height(robot.home, robot, *level_soles(robot.home, robot))


def sole_normals(joint_position: ArrayLike, robot: str | Robot) -> Array:
    """Unit vectors that point up from the feet, in the base's frame, [foot, xyz]."""
    known, data, _ = _forward(joint_position, robot)
    return np.array([data.body(foot).xmat.reshape(3, 3)[:, 2] for foot in known.file.feet])


def level_soles(joint_position: ArrayLike, robot: str | Robot) -> tuple[float, float]:
    """Roll and pitch [rad] of the base for which the soles are level on average; zero for feet without soles."""
    if not load_robot(robot).file.soles:
        return 0.0, 0.0
    up = sole_normals(joint_position, robot).mean(0)
    return float(np.arctan2(up[1], up[2])), float(np.arctan2(-up[0], np.hypot(up[1], up[2])))


def quaternion(roll: float, pitch: float, yaw: float = 0.0) -> Array:
    """Unit quaternion (w, x, y, z) of R = Rz(yaw) Ry(pitch) Rx(roll), angles in rad."""
    result = np.empty(4)
    mujoco.mju_euler2Quat(result, np.array([yaw, pitch, roll], dtype=float), "zyx")
    return result


def rotation_matrix(roll: float, pitch: float, yaw: float = 0.0) -> Array:
    """The matrix R = Rz(yaw) Ry(pitch) Rx(roll) [3, 3], angles in rad."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion(roll, pitch, yaw))
    return matrix.reshape(3, 3)


def roll_pitch_yaw(quaternion: Array) -> Array:
    """Roll, pitch and yaw [rad] of R = Rz(yaw) Ry(pitch) Rx(roll) from unit quaternions (w, x, y, z), ``[..., 4]``."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - x * z), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack([roll, pitch, yaw], -1)


def minimum_jerk(share: ArrayLike) -> NDArray[np.float64]:
    """Completed share of a motion at a share of its time, both 0 to 1, with zero speed and acceleration at the ends."""
    s = np.clip(share, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)
