"""Joints with values of their own, when the value that they share is another."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from op3.servo import Estimate, RobotModel
from op3.servo.effects import Backlash, Coulomb, CurrentOffset, DirectionalEfficiency

JOINTS = ("l_knee", "r_knee", "l_ank_pitch")


def model(shared: float, **own: float) -> RobotModel:
    return RobotModel((Coulomb(),)).with_values({"coulomb_friction": Estimate(shared, joints=own)})


@given(st.floats(0.01, 0.3), st.floats(0.5, 2.0), st.floats(0.01, 0.3))
def test_joints_keep_their_ratio(shared, ratio, moved):
    """Servos differ by shares; those that do not differ have the shared value; at the model's own nothing changes."""
    robot = model(shared, l_knee=shared * ratio)
    values = robot.for_joints("coulomb_friction", torch.tensor([moved, shared], dtype=torch.float64), JOINTS)
    assert values[0].tolist() == pytest.approx([moved * ratio, moved, moved])
    torch.testing.assert_close(values[1:], robot.tensors(JOINTS)["coulomb_friction"])
    after = robot.moved({"coulomb_friction": moved}).tensors(JOINTS)["coulomb_friction"]
    torch.testing.assert_close(values[:1], after)


def test_joints_without_the_effect_stay_without():
    """A fault of one joint grows there and nowhere else."""
    robot = RobotModel((Backlash(),)).with_values(
        {"backlash_half_gap": Estimate(0.002, joints={"l_knee": 0.006, "r_knee": 0.0, "l_ank_pitch": 0.0})}
    )
    values = robot.for_joints("backlash_half_gap", torch.tensor([0.004], dtype=torch.float64), JOINTS)
    assert values[0].tolist() == pytest.approx([0.012, 0.0, 0.0])


def test_what_has_no_ratio_keeps_its_difference():
    """Zeros of sensors lie on both sides of nothing."""
    robot = RobotModel((CurrentOffset(),)).with_values(
        {"current_offset": Estimate(0.01, joints={"l_knee": -0.02, "r_knee": 0.03})}
    )
    values = robot.for_joints("current_offset", torch.tensor([0.02], dtype=torch.float64), JOINTS)
    assert values[0].tolist() == pytest.approx([-0.01, 0.06, 0.02])


def test_no_joint_is_moved_beyond_physics():
    """An efficiency stays at most one, in what is simulated and in the model that is kept."""
    robot = RobotModel((DirectionalEfficiency(),)).with_values(
        {"backward_efficiency": Estimate(0.7, joints={"l_knee": 0.9})}
    )
    values = robot.for_joints("backward_efficiency", torch.tensor([0.95], dtype=torch.float64), JOINTS)
    assert values[0].tolist() == pytest.approx([1.0, 0.95, 0.95])
    kept = robot.moved({"backward_efficiency": Estimate(0.95, 0.9, 1.0)}).estimate("backward_efficiency")
    assert (kept.value, kept.low, kept.high, kept.joints) == (0.95, 0.9, 1.0, {"l_knee": 1.0})


def test_a_model_without_differences_takes_values_as_they_are():
    """Shared values stay one per candidate, and a number alone replaces a shared value."""
    values = torch.tensor([0.1, 0.2], dtype=torch.float64)
    assert model(0.1).for_joints("coulomb_friction", values, JOINTS) is values
    assert model(0.1).moved({"coulomb_friction": 0.2}).estimate("coulomb_friction") == Estimate(0.2)
