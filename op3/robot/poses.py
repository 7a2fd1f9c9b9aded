"""Named poses of the whole body, and the height at which a pose stands."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.robot.joints import JOINTS, indices, mirror
from op3.robot.kinematics import rotation_matrix, sole_corners, sole_normals

_STAND_LEFT = {
    "l_sho_pitch": -0.534072,
    "l_sho_roll": 0.879648,
    "l_el": -0.62832,
    "l_hip_pitch": -0.596904,
    "l_knee": 1.13098,
    "l_ank_pitch": 0.534072,
}
"""Left half of the pose "stand_bent_knees" of MuJoCo Playground's OP3 tasks [rad]; its trunk is upright."""

SQUAT_KNEE_LOW = 1.47
"""Knee angle at the bottom of the paper's squat [rad]."""

SQUAT_KNEE_HIGH = 0.6
"""Knee angle at the top of the paper's squat [rad]."""

SQUAT_LEAN = 0.3
"""Forward lean of the trunk during the squat [rad]; the paper gives no number.

It keeps the centre of mass over the middle of the soles from the lowest to the highest point.
"""

_THIGH = 0.11015
"""Hip pitch axis to knee axis [m]."""

_SHIN = 0.11
"""Knee axis to ankle pitch axis [m]."""

POSES: tuple[str, ...] = ("zero", "stand", "squat_low", "squat_high")
"""Names that `pose` knows."""


def symmetric(left: Mapping[str, ArrayLike]) -> NDArray[np.float64]:
    """Whole-body angles from those of the left half; joints that are not named are zero.

    Args:
        left: angle [rad] of left joints, scalars or arrays [...] of one shape.

    Returns:
        [..., joint] in rad.
    """
    shape = np.broadcast_shapes(*(np.shape(value) for value in left.values()))
    position = np.zeros((*shape, len(JOINTS)))
    for index, value in zip(indices(left), left.values(), strict=True):
        position[..., index] = value
    return position + mirror(position)


def leg_pitches(knee: ArrayLike, lean: float) -> dict[str, NDArray[np.float64]]:
    """Left pitch angles that put the hip axis above the ankle axis with the sole level.

    With t and s the angles of thigh and shin from the vertical about +y, hip above ankle means
    thigh sin(t) + shin sin(s) = 0, and the knee angle is s - t. The trunk leans forward by `lean`, so the hip
    pitch is t - lean and, the sole being level, the ankle pitch is s.

    Args:
        knee: knee angle [...] in rad.
        lean: pitch of the trunk in rad, positive forward.

    Returns:
        Angles [...] in rad of l_hip_pitch, l_knee and l_ank_pitch.
    """
    knee = np.asarray(knee, dtype=float)
    thigh_tilt = -np.arctan2(_SHIN * np.sin(knee), _THIGH + _SHIN * np.cos(knee))
    return {"l_hip_pitch": thigh_tilt - lean, "l_knee": knee, "l_ank_pitch": thigh_tilt + knee}


def squat_position(knee: ArrayLike, lean: float = SQUAT_LEAN) -> NDArray[np.float64]:
    """Whole-body angles [..., joint] in rad of a squat at a knee angle [...], arms and head as in "stand"."""
    arms = {name: _STAND_LEFT[name] for name in ("l_sho_pitch", "l_sho_roll", "l_el")}
    return symmetric({**arms, **leg_pitches(knee, lean)})


def pose(name: str) -> NDArray[np.float64]:
    """Joint angles [joint] in rad of a named pose.

    Args:
        name: "zero" (legs straight, arms sideways), "stand" (knees bent), "squat_low" or "squat_high" (the
            two ends of the default squat, whose trunk leans forward by `SQUAT_LEAN`).
    """
    if name == "zero":
        return np.zeros(len(JOINTS))
    if name == "stand":
        return symmetric(_STAND_LEFT)
    if name == "squat_low":
        return squat_position(SQUAT_KNEE_LOW)
    if name == "squat_high":
        return squat_position(SQUAT_KNEE_HIGH)
    raise ValueError(f"unknown pose {name!r}; the poses are {', '.join(POSES)}")


def standing_height(joint_position: ArrayLike, roll: float = 0.0, pitch: float = 0.0) -> float:
    """Height [m] of the trunk's origin above a floor that the lowest corner of the soles just touches.

    Args:
        joint_position: angles [joint] in rad.
        roll: roll of the trunk in rad.
        pitch: pitch of the trunk in rad, positive forward.
    """
    corners = sole_corners(joint_position) @ rotation_matrix(roll, pitch).T
    return float(-corners[..., 2].min())


def level_soles(joint_position: ArrayLike) -> tuple[float, float]:
    """Roll and pitch [rad] of a trunk whose soles, on average over both feet, are level.

    Args:
        joint_position: angles [joint] in rad.
    """
    up = sole_normals(joint_position).mean(0)
    return float(np.arctan2(up[1], up[2])), float(np.arctan2(-up[0], np.hypot(up[1], up[2])))
