"""Motions and their files."""

import numpy as np
import pytest

from op3.motions import Motion, hold, squat, staircase
from op3.motions.op3_motions import SQUAT_LEAN
from op3.robot import pose
from op3.robot.kinematics import minimum_jerk, rotation_matrix, sole_normals
from tests.op3_table import JOINTS, SOFT_LIMITS, center_of_mass, indices, mirror, sole_corners

LIMITS = np.array([SOFT_LIMITS[name] for name in JOINTS])


@pytest.fixture(scope="module")
def motion() -> Motion:
    """The default squat."""
    return squat()


def test_squat_follows_the_paper(motion):
    """Five seconds at 125 Hz; the knee starts at 1.47 rad, is at 0.6 rad after 1 s and back after 2 s."""
    knee = motion.position[:, indices(["l_knee"])[0]]
    assert motion.time.shape == (625,)
    np.testing.assert_allclose(np.diff(motion.time), 0.008)
    assert knee[[0, 125, 250]] == pytest.approx([1.47, 0.6, 1.47])
    assert knee.max() == pytest.approx(1.47)
    assert knee.min() == pytest.approx(0.6)


def test_squat_is_symmetric_and_within_limits(motion):
    """Both legs do the same and every angle keeps to the soft limits."""
    np.testing.assert_array_equal(mirror(motion.position), motion.position)
    assert (motion.position >= LIMITS[:, 0]).all()
    assert (motion.position <= LIMITS[:, 1]).all()


def test_squat_is_flat_and_balanced(motion):
    """The soles are level within 1e-6 rad and the centre of mass stays within 2 cm of the soles' middle."""
    world = rotation_matrix(0.0, SQUAT_LEAN)
    for position in motion.position[:126:5]:
        normals = sole_normals(position, "op3") @ world.T
        tilt = np.arctan2(np.linalg.norm(normals[:, :2], axis=1), normals[:, 2])
        assert tilt.max() < 1e-6
        corners = sole_corners(position) @ world.T
        com = world @ center_of_mass(position)
        assert np.ptp(corners[..., 2].min(axis=1)) < 1e-9
        assert abs(com[0] - corners[..., 0].mean()) < 0.02
        assert abs(com[1]) < 1e-3


def test_squat_arguments():
    """Frequency, stroke, lean, duration and rate are what they say."""
    motion = squat(knee_low=1.2, knee_high=0.8, frequency=1.0, lean=0.1, duration=2.0, rate=250.0)
    knee, hip, ankle = motion.position[:, indices(["l_knee", "l_hip_pitch", "l_ank_pitch"])].T
    assert len(motion.time) == 500
    assert knee[[0, 125, 250]] == pytest.approx([1.2, 0.8, 1.2])
    # A level sole: lean + hip + knee - ankle = 0.
    np.testing.assert_allclose(0.1 + hip + knee - ankle, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("time", "position", "joints", "message"),
    [
        ([0.0], [[0.0]], ("l_knie",), "unknown joint 'l_knie'"),
        ([0.0, 0.0], [[0.0], [0.0]], ("l_knee",), "time does not increase at row 1"),
        ([0.0], [[np.nan]], ("l_knee",), "non-finite"),
    ],
)
def test_what_is_no_motion(time, position, joints, message):
    """Arrays that cannot be a motion are refused with the reason."""
    with pytest.raises(ValueError, match=message):
        Motion(np.array(time), np.array(position), joints, robot="op3")


def test_bad_arguments():
    """Wrong shapes and durations are refused with the offending value."""
    with pytest.raises(ValueError, match=r"\(2, 20\), got \(3, 20\)"):
        Motion(np.arange(2.0), np.zeros((3, 20)), robot="op3")
    with pytest.raises(ValueError, match=r"^duration must be positive, got 0.0"):
        hold(pose("stand", "op3"), duration=0.0, robot="op3")
    for field in ("duration", "ramp"):
        with pytest.raises(ValueError, match=f"motion 'staircase': {field} must be positive, got -2"):
            staircase(robot="op3", **{field: -2})


def test_minimum_jerk():
    """From 0 to 1, half way at half time, at rest at both ends."""
    shares = minimum_jerk(np.linspace(0, 1, 1001))
    assert (shares[0], shares[500], shares[-1]) == (0, 0.5, 1)
    assert np.diff(shares)[[0, -1]].max() < 1e-7
    assert np.diff(shares).max() == pytest.approx(1.875e-3, rel=1e-3)
