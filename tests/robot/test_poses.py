"""Named poses."""

import numpy as np
import pytest

from op3.robot import pose, standing_height
from op3.robot.kinematics import level_soles, rotation_matrix, sole_normals
from tests.op3_table import JOINTS, OP3, SOFT_LIMITS, center_of_mass, mirror, sole_corners

LIMITS = np.array([SOFT_LIMITS[name] for name in JOINTS])


@pytest.mark.parametrize("name", ["zero", "stand", *OP3.file.poses])
def test_poses_are_symmetric_and_within_limits(name):
    """Every pose is its own mirror image and keeps to the soft limits."""
    position = pose(name, "op3")
    np.testing.assert_array_equal(mirror(position), position)
    assert (position >= LIMITS[:, 0]).all()
    assert (position <= LIMITS[:, 1]).all()


def test_unknown_pose():
    """An unknown pose is named, with the ones that exist."""
    with pytest.raises(ValueError, match=r"op3 has no pose 'sit'; it has home, stand, zero, rest, squat_low"):
        pose("sit", "op3")


def test_stand_is_flat_and_balanced():
    """In the pose "stand" with an upright trunk the soles are level and the centre of mass is above them."""
    corners = sole_corners(pose("stand", "op3"))
    np.testing.assert_allclose(sole_normals(pose("stand", "op3"), "op3")[:, 2], 1.0, atol=1e-5)
    assert corners[..., 0].min() < center_of_mass(pose("stand", "op3"))[0] < corners[..., 0].max()


def test_height_depends_on_tilt():
    """Straight legs tilted forward about the hips stand on the toe: height = 0.27915 cos a + toe sin a."""
    toe = 0.0001 - 0.0241 + 0.0875
    tilt = 0.2
    expected = 0.27915 * np.cos(tilt) + toe * np.sin(tilt)
    assert standing_height(pose("zero", "op3"), "op3", pitch=tilt) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("name", ["zero", "stand", "squat_low", "squat_high"])
def test_level_soles_levels_them(name):
    """With the trunk tilted as told, both soles of every pose point straight up."""
    up = sole_normals(pose(name, "op3"), "op3") @ rotation_matrix(*level_soles(pose(name, "op3"), "op3")).T
    np.testing.assert_allclose(up, [[0, 0, 1], [0, 0, 1]], atol=1e-5)
