"""The sinusoidal walk: inverse kinematics against forward kinematics, and the shape of the gait."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.motions import SinusoidalGait
from op3.motions.op3_motions import leg_angles
from op3.robot import key_points
from op3.robot.kinematics import sole_normals
from tests.op3_table import JOINTS, MIRROR, SOFT_LIMITS, indices

HIP = np.array([0.0001, 0.035, -0.0285])
"""Where roll and pitch axis of the left hip meet, relative to the trunk [m]."""

SOLE = np.array([-0.0241 + 0.0875, -0.015, -0.0305])
"""Inner tip of the left sole relative to the ankle [m], sole level."""


@settings(max_examples=60, deadline=None)
@given(st.floats(-0.06, 0.06), st.floats(-0.05, 0.06), st.floats(-0.2, -0.13))
def test_inverse_is_inverse(x, y, z):
    """Forward kinematics of the angles puts the sole level and its tip where it was asked for."""
    position = np.zeros(20)
    for name, angle in leg_angles(np.array([x, y, z])).items():
        position[indices([f"l_{name}"])] = angle
    np.testing.assert_allclose(sole_normals(position, "op3")[0], [0.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(key_points(position, "op3")[0], HIP + np.array([x, y, z]) + SOLE, atol=2e-6)


def test_out_of_reach():
    """An ankle beyond the stretched leg is refused with both numbers."""
    with pytest.raises(ValueError, match=r"the ankle is 0.3000 m from the hip, out of"):
        leg_angles(np.array([0.0, 0.0, -0.3]))


def test_gait_is_periodic_symmetric_and_within_limits():
    """After its start the walk repeats every period, the right leg half a period later; soft limits hold."""
    gait = SinusoidalGait()
    position = gait.motion(4.8, rate=1000.0).position
    cycle = 600
    np.testing.assert_allclose(position[2400:3000], position[2400 + cycle : 3000 + cycle], atol=1e-9)
    for name in ("l_hip_roll", "l_hip_pitch", "l_knee", "l_ank_pitch", "l_ank_roll"):
        partner, sign = MIRROR[name]
        left = position[2400:3000, JOINTS.index(name)]
        right = position[2400 + cycle // 2 : 3000 + cycle // 2, JOINTS.index(partner)]
        np.testing.assert_allclose(left, sign * right, atol=1e-9)
    low, high = np.array([SOFT_LIMITS[name] for name in JOINTS]).T
    assert ((position >= low) & (position <= high)).all()


def test_gait_is_continuous():
    """Targets never jump: within 1 ms no joint moves by more than 20 mrad."""
    position = SinusoidalGait().motion(4.0, rate=1000.0).position
    assert np.abs(np.diff(position, axis=0)).max() < 0.02
