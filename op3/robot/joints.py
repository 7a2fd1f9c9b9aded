"""The twenty joints of the OP3: names, servo ids, axes, limits and mirror partners.

Each joint is one XM430-W350 servo whose angle is the joint angle, with zero at 2048 counts. Order, ids and
axes are those of ROBOTIS' robot file and URDF; soft limits are those of ROBOTIS' `op3_kinematics`.

The two kinds of limit differ: `SOFT_LIMITS` are what software must keep to (a servo in current mode enforces
none), while the wider `range` of each joint in `assets/op3/op3.xml` is the mechanical one.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray


class _Joint(NamedTuple):
    name: str
    servo_id: int
    axis: tuple[int, int, int]
    soft_limit: tuple[float, float]


_TABLE = (
    _Joint("head_pan", 19, (0, 0, 1), (-1.5708, 1.5708)),
    _Joint("head_tilt", 20, (0, -1, 0), (-1.5708, 1.5708)),
    _Joint("l_sho_pitch", 2, (0, 1, 0), (-1.5708, 1.5708)),
    _Joint("l_sho_roll", 4, (-1, 0, 0), (-0.9425, 1.5708)),
    _Joint("l_el", 6, (1, 0, 0), (-1.5708, 1.5708)),
    _Joint("r_sho_pitch", 1, (0, -1, 0), (-1.5708, 1.5708)),
    _Joint("r_sho_roll", 3, (-1, 0, 0), (-1.5708, 0.9425)),
    _Joint("r_el", 5, (1, 0, 0), (-1.5708, 1.5708)),
    _Joint("l_hip_yaw", 8, (0, 0, -1), (-1.4137, 1.4137)),
    _Joint("l_hip_roll", 10, (-1, 0, 0), (-0.9425, 0.9425)),
    _Joint("l_hip_pitch", 12, (0, 1, 0), (-1.2566, 1.2566)),
    _Joint("l_knee", 14, (0, 1, 0), (-0.3142, 2.1991)),
    _Joint("l_ank_pitch", 16, (0, -1, 0), (-1.4137, 1.4137)),
    _Joint("l_ank_roll", 18, (1, 0, 0), (-1.4137, 1.4137)),
    _Joint("r_hip_yaw", 7, (0, 0, -1), (-1.4137, 1.4137)),
    _Joint("r_hip_roll", 9, (-1, 0, 0), (-0.9425, 0.9425)),
    _Joint("r_hip_pitch", 11, (0, -1, 0), (-1.2566, 1.2566)),
    _Joint("r_knee", 13, (0, -1, 0), (-2.1991, 0.3142)),
    _Joint("r_ank_pitch", 15, (0, 1, 0), (-1.4137, 1.4137)),
    _Joint("r_ank_roll", 17, (1, 0, 0), (-1.4137, 1.4137)),
)

JOINTS: tuple[str, ...] = tuple(joint.name for joint in _TABLE)
"""The twenty joint names. Every array with a joint axis is in this order."""

SERVO_IDS: dict[str, int] = {joint.name: joint.servo_id for joint in _TABLE}
"""Bus id of each joint's servo: odd on the right, even on the left."""

JOINT_AXES: dict[str, tuple[int, int, int]] = {joint.name: joint.axis for joint in _TABLE}
"""Rotation axis of each joint in its link (x forward, y left, z up)."""

SOFT_LIMITS: dict[str, tuple[float, float]] = {joint.name: joint.soft_limit for joint in _TABLE}
"""Lowest and highest angle [rad] that software may command."""

_CONTROLLED_PARTS = ("hip_roll", "hip_pitch", "knee", "ank_pitch", "ank_roll")

CONTROLLED_JOINTS: tuple[str, ...] = tuple(name for name in JOINTS if name[2:] in _CONTROLLED_PARTS)
"""The ten leg joints without the hip yaws."""

HELD_JOINTS: tuple[str, ...] = tuple(name for name in JOINTS if name not in CONTROLLED_JOINTS)
"""The other ten: head, arms and hip yaws."""

LIMBS: tuple[tuple[str, ...], ...] = (JOINTS[:2], JOINTS[2:5], JOINTS[5:8], JOINTS[8:14], JOINTS[14:])
"""Joints of the head, the arms and the legs, each limb from the trunk outwards."""

GEAR_RATIO = 353.5
"""Reduction of the XM430-W350's gear train, motor turns per output turn."""


def whole_limbs(joints: Iterable[str]) -> tuple[str, ...]:
    """All joints of the limbs in which these are, in `JOINTS` order."""
    wanted = set(joints)
    return tuple(joint for limb in LIMBS if wanted & set(limb) for joint in limb)


def _mirrored(joint: _Joint) -> tuple[str, int]:
    """Partner and sign of one joint under reflection in the plane y = 0.

    An axis of rotation is an axial vector, so the reflection takes (x, y, z) to (-x, y, -z).
    """
    swap = {"l_": "r_", "r_": "l_"}
    partner = swap.get(joint.name[:2], joint.name[:2]) + joint.name[2:]
    x, y, z = joint.axis
    sign = int(np.dot((-x, y, -z), JOINT_AXES[partner]))
    return partner, sign


MIRROR: dict[str, tuple[str, int]] = {joint.name: _mirrored(joint) for joint in _TABLE}
"""For each joint, its left-right partner (itself for the head) and the sign the angle takes there."""

_INDEX = {name: i for i, name in enumerate(JOINTS)}


def indices(names: Iterable[str]) -> NDArray[np.int64]:
    """Positions of joints in `JOINTS`.

    Args:
        names: joint names in any order.

    Returns:
        Integer array [joint], in the order of `names`.
    """
    wanted = [names] if isinstance(names, str) else list(names)
    unknown = [name for name in wanted if name not in _INDEX]
    if unknown:
        raise ValueError(f"unknown joint {', '.join(map(repr, unknown))}; the joints are {', '.join(JOINTS)}")
    return np.array([_INDEX[name] for name in wanted], dtype=np.int64)


_MIRROR_INDEX = np.array([_INDEX[MIRROR[name][0]] for name in JOINTS])
_MIRROR_SIGN = np.array([MIRROR[name][1] for name in JOINTS], dtype=float)


def mirror(joint_position: ArrayLike) -> NDArray[np.float64]:
    """Joint angles (or velocities, or torques) of the robot's mirror image.

    Args:
        joint_position: [..., joint] in `JOINTS` order.

    Returns:
        [..., joint], the same units.
    """
    # The sign of a pair is the same both ways, so the receiving joint's sign serves.
    return np.asarray(joint_position, dtype=float)[..., _MIRROR_INDEX] * _MIRROR_SIGN
