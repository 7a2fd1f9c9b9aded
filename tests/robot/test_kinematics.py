"""Forward kinematics: symmetry, rotations, key points."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.robot import key_points, quaternion
from op3.robot.kinematics import rotation_matrix
from tests.op3_table import JOINTS, KEY_POINTS, SOFT_LIMITS, mirror, sole_corners

joint_positions = st.tuples(*(st.floats(*SOFT_LIMITS[name]) for name in JOINTS)).map(np.array)
angles = st.floats(-3.0, 3.0)
MIRRORED = np.array([1.0, -1.0, 1.0])


@settings(max_examples=50, deadline=None)
@given(joint_positions)
def test_mirrored_angles_give_mirrored_feet(position):
    """Reflecting the joint angles reflects the feet: left and right change places, y changes sign."""
    left, right = np.split(key_points(position, "op3"), 2)
    mirrored_left, mirrored_right = np.split(key_points(mirror(position), "op3"), 2)
    np.testing.assert_allclose(mirrored_left, right * MIRRORED, atol=1e-9)
    np.testing.assert_allclose(mirrored_right, left * MIRRORED, atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(angles, angles, angles)
def test_rotation_is_yaw_after_pitch_after_roll(roll, pitch, yaw):
    """The rotation is Rz(yaw) Ry(pitch) Rx(roll), written out by hand."""
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    np.testing.assert_allclose(rotation_matrix(roll, pitch, yaw), rz @ ry @ rx, atol=1e-12)
    assert np.linalg.norm(quaternion(roll, pitch, yaw)) == pytest.approx(1.0)


def test_key_points_are_corners_of_the_soles():
    """In the zero pose key points lie on the underside of the soles, at the toe and heel edges."""
    points = dict(zip(KEY_POINTS, key_points(np.zeros(20), "op3"), strict=True))
    corners = sole_corners(np.zeros(20))
    for side, feet in (("l", corners[:2]), ("r", corners[2:])):
        inner, outer, heel = (points[f"{side}_sole_{name}"] for name in ("inner_tip", "outer_tip", "heel"))
        assert inner[2] == outer[2] == heel[2] == pytest.approx(feet[..., 2].min())
        assert inner[0] == outer[0] == pytest.approx(feet[..., 0].max())
        assert heel[0] == pytest.approx(feet[..., 0].min())
        assert abs(inner[1]) < abs(heel[1]) < abs(outer[1])


def test_straight_leg_adds_up():
    """The sole is the sum of the leg's lengths below the trunk: 28.5 + 110.15 + 110 + 30.5 mm."""
    assert sole_corners(np.zeros(20))[..., 2].min() == pytest.approx(-0.27915, abs=1e-9)


def test_wrong_shape():
    """A vector of the wrong length is refused with both shapes."""
    with pytest.raises(ValueError, match=r"shape \(20,\), got \(19,\)"):
        key_points(np.zeros(19), "op3")
