"""The tables of joints."""

import numpy as np
import pytest

from op3.robot import (
    CONTROLLED_JOINTS,
    GEAR_RATIO,
    HELD_JOINTS,
    JOINTS,
    MIRROR,
    SERVO_IDS,
    SOFT_LIMITS,
    indices,
    mirror,
)


def test_servo_ids():
    """The twenty ids are 1 to 20, even on the left and odd on the right."""
    assert sorted(SERVO_IDS.values()) == list(range(1, 21))
    assert all(SERVO_IDS[name] % 2 == 0 for name in JOINTS if name.startswith("l_"))
    assert all(SERVO_IDS[name] % 2 == 1 for name in JOINTS if name.startswith("r_"))


def test_controlled_and_held_joints():
    """Ten leg joints are controlled, in the common order, and the rest is held."""
    assert CONTROLLED_JOINTS[:5] == ("l_hip_roll", "l_hip_pitch", "l_knee", "l_ank_pitch", "l_ank_roll")
    assert CONTROLLED_JOINTS[5:] == ("r_hip_roll", "r_hip_pitch", "r_knee", "r_ank_pitch", "r_ank_roll")
    assert sorted(CONTROLLED_JOINTS + HELD_JOINTS) == sorted(JOINTS)
    assert len(HELD_JOINTS) == 10


def test_gear_ratio():
    """The XM430-W350 reduces 353.5 to 1."""
    assert GEAR_RATIO == 353.5


def test_indices():
    """Indices follow the order of the names asked for."""
    assert indices(["r_ank_roll", "head_pan", "l_knee"]).tolist() == [19, 0, 11]
    assert indices(JOINTS).tolist() == list(range(20))
    assert indices(["l_knee"]).tolist() == indices("l_knee").tolist()
    assert indices([]).shape == (0,)


def test_unknown_joint():
    """An unknown joint is named, with the ones that exist."""
    with pytest.raises(ValueError, match=r"unknown joint 'left_knee'; the joints are head_pan, .*r_ank_roll"):
        indices(["l_knee", "left_knee"])


def test_mirror_partners():
    """Every partner points back with the same sign; only the head tilt keeps its sign."""
    for name, (partner, sign) in MIRROR.items():
        assert MIRROR[partner] == (name, sign)
    assert MIRROR["l_knee"] == ("r_knee", -1)
    assert MIRROR["head_pan"] == ("head_pan", -1)
    assert [name for name in JOINTS if MIRROR[name][1] == 1] == ["head_tilt"]


def test_mirror_is_an_involution():
    """Mirrored twice is unchanged, for a single row and for many."""
    rows = np.random.default_rng(0).normal(size=(3, 20))
    np.testing.assert_array_equal(mirror(mirror(rows)), rows)
    np.testing.assert_array_equal(mirror(rows[1]), mirror(rows)[1])


def test_soft_limits_are_mirror_images():
    """The limits of a joint are the mirrored limits of its partner."""
    for name, (partner, sign) in MIRROR.items():
        expected = sorted(sign * limit for limit in SOFT_LIMITS[name])
        assert list(SOFT_LIMITS[partner]) == pytest.approx(expected)
