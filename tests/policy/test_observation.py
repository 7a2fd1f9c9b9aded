"""What a policy sees, against MuJoCo and against its own definition."""

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.policy.leg_kinematics import leg_kinematics
from op3.policy.observation import BALANCE_LAYOUT, WALK_LAYOUT, History, layout_slices, observe
from op3.robot import asset_path, key_points
from tests.op3_table import KEY_POINTS

angles = st.lists(st.floats(-1.2, 1.2), min_size=20, max_size=20).map(np.array)


@settings(max_examples=40, deadline=None)
@given(angles, angles)
def test_key_points_are_mujocos(position, velocity):
    """Positions and velocities of the soles equal MuJoCo's sites and their Jacobians to rounding."""
    model = mujoco.MjModel.from_xml_path(str(asset_path("op3/op3.xml")))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = position, velocity
    mujoco.mj_forward(model, data)
    expected = []
    for name in KEY_POINTS:
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jacobian, None, model.site(name).id)
        expected.append(jacobian @ velocity)
    points, speeds = leg_kinematics().key_points(torch.from_numpy(position), torch.from_numpy(velocity))
    np.testing.assert_allclose(points.numpy(), key_points(position), atol=1e-12)
    np.testing.assert_allclose(speeds.numpy(), expected, atol=1e-12)


def test_key_points_are_batched():
    """Rows of a batch are what each row gives alone."""
    generator = torch.Generator().manual_seed(0)
    position, velocity = torch.randn(2, 5, 7, 20, generator=generator, dtype=torch.float64)
    together = leg_kinematics().key_points(position, velocity)
    alone = leg_kinematics().key_points(position[3, 4], velocity[3, 4])
    assert together[0].shape == (5, 7, 6, 3)
    for many, one in zip(together, alone, strict=True):
        torch.testing.assert_close(many[3, 4], one, rtol=0, atol=1e-14)


def test_layout():
    """Balance sees 62 numbers and walking 64, in the order of the paper's list."""
    assert sum(BALANCE_LAYOUT.values()) == 62
    assert sum(WALK_LAYOUT.values()) == 64
    joints, three, action = torch.zeros(4, 20), torch.full((4, 3), 0.5), torch.full((4, 20), 0.75)
    seen = observe(joints, joints, three, 2 * three, action, torch.tensor([0.0, 0.25, 0.5, 1.0]))
    part = layout_slices(WALK_LAYOUT)
    assert seen.shape == (4, 64)
    assert (seen[:, part["previous_action"]] == 0.75).all()
    assert (seen[:, part["orientation"]] == 0.5).all()
    assert (seen[:, part["angular_velocity"]] == 1.0).all()
    expected = torch.tensor([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(seen[:, part["phase"]], expected, atol=1e-6, rtol=0)
    assert observe(joints, joints, three, three, action).shape == (4, 62)


def test_history_is_newest_first():
    """After three pushes the stack holds the last three observations, the latest in front."""
    history = History(2)
    first = history.reset(torch.zeros(1, 2))
    assert first.tolist() == [[0.0] * 6]
    for value in (1.0, 2.0, 3.0):
        stacked = history.push(torch.full((1, 2), value))
    assert stacked.tolist() == [[3.0, 3.0, 2.0, 2.0, 1.0, 1.0]]


def test_history_resets_rows_alone():
    """Rows that begin anew forget; the others keep what they have seen."""
    history = History(1)
    history.reset(torch.zeros(2, 1))
    history.push(torch.ones(2, 1))
    stacked = history.reset(torch.full((2, 1), 5.0), torch.tensor([False, True]))
    assert stacked.tolist() == [[1.0, 0.0], [5.0, 5.0]]


def test_history_without_a_beginning():
    """A push before the first reset is refused."""
    with pytest.raises(RuntimeError, match=r"begins with reset"):
        History(1).push(torch.zeros(1))
