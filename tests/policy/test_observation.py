"""What a policy sees, against MuJoCo and against its own definition."""

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.policy import Observer, Sensed, layout_slices, observations
from op3.policy.forward_kinematics import leg_kinematics
from op3.robot import asset_path, key_points, load_robot
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
    points, speeds = leg_kinematics(load_robot("op3")).key_points(
        torch.from_numpy(position), torch.from_numpy(velocity)
    )
    np.testing.assert_allclose(points.numpy(), key_points(position, "op3"), atol=1e-12)
    np.testing.assert_allclose(speeds.numpy(), expected, atol=1e-12)


def test_key_points_are_batched():
    """Rows of a batch are what each row gives alone."""
    generator = torch.Generator().manual_seed(0)
    position, velocity = torch.randn(2, 5, 7, 20, generator=generator, dtype=torch.float64)
    together = leg_kinematics(load_robot("op3")).key_points(position, velocity)
    alone = leg_kinematics(load_robot("op3")).key_points(position[3, 4], velocity[3, 4])
    assert together[0].shape == (5, 7, 6, 3)
    for many, one in zip(together, alone, strict=True):
        torch.testing.assert_close(many[3, 4], one, rtol=0, atol=1e-14)


def sensed(values: torch.Tensor, **others) -> Sensed:
    """Robots whose readings all have these values, ``[row]``."""
    rows = values.double()[:, None]
    return Sensed(rows.expand(-1, 20), rows.expand(-1, 20), rows.expand(-1, 20), **others)


def observer(terms: dict, history: int = 0) -> Observer:
    """Of terms of the OP3."""
    return Observer(terms, load_robot("op3"), history, sensed(torch.zeros(1), phase=torch.zeros(1)))


ACTION = {"previous_action": {}}


def test_phase():
    """Sine and cosine of the phase; both are 0 while the robot is asked to stand."""
    phase = torch.tensor([0.0, 0.25, 0.5, 1.0])
    seen = observer({"phase": {}}).reset(sensed(torch.zeros(4), phase=phase))
    expected = torch.tensor([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(seen, expected, atol=1e-6, rtol=0)
    asked = {"velocity": torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])}
    some = observations.phase(sensed(torch.zeros(2), phase=phase[:2], commands=asked), command="velocity")
    torch.testing.assert_close(some.double(), torch.tensor([[0.0, 0.0], [1.0, 0.0]]).double(), atol=1e-6, rtol=0)


def test_history_is_newest_first():
    """After three pushes the stack holds the last three observations, the latest in front."""
    history = observer(ACTION, 2)
    first = history.reset(sensed(torch.zeros(1)))
    assert first.tolist() == [[0.0] * 60]
    for value in (1.0, 2.0, 3.0):
        stacked = history.push(sensed(torch.full((1,), value)))
    assert stacked.tolist() == [[3.0] * 20 + [2.0] * 20 + [1.0] * 20]


def test_history_resets_rows_alone():
    """Rows that start over forget; the others keep what they have seen."""
    history = observer(ACTION, 1)
    history.reset(sensed(torch.zeros(2)))
    history.push(sensed(torch.ones(2)))
    stacked = history.reset(sensed(torch.full((2,), 5.0)), torch.tensor([False, True]))
    assert stacked[:, [0, 20]].tolist() == [[1.0, 0.0], [5.0, 5.0]]


def test_an_observer_without_a_beginning():
    """A push before the first reset is refused."""
    with pytest.raises(RuntimeError, match=r"before the first step"):
        observer(ACTION).push(sensed(torch.zeros(1)))


def test_delay():
    """Two policy steps late; a robot that starts over sees its first value until then."""
    late = observer({"previous_action": {"delay": 2}})
    seen = [late.reset(sensed(torch.full((2,), 9.0)))]
    seen += [late.push(sensed(torch.full((2,), float(value)))) for value in (1, 2)]
    seen += [late.reset(sensed(torch.full((2,), 5.0)), torch.tensor([True, False]))]
    seen += [late.push(sensed(torch.full((2,), float(value)))) for value in (6, 7)]
    assert [row[:, 0].tolist() for row in seen] == [[9, 9], [9, 9], [9, 9], [5, 9], [5, 1], [5, 2]]


def test_noise_and_resolution():
    """Noise has its deviation and comes from each robot's own generator; resolution rounds."""
    noisy = observer({"previous_action": {"noise": 0.1}})
    rngs = [np.random.default_rng(seed) for seed in (0, 1)]
    drawn = torch.stack([noisy.reset(sensed(torch.zeros(2)), noise=rngs) for _ in range(200)])
    assert float(drawn.std()) == pytest.approx(0.1, rel=0.05)
    alone = observer({"previous_action": {"noise": 0.1}})
    again = alone.reset(sensed(torch.zeros(1)), noise=[np.random.default_rng(1)])
    assert torch.equal(again[0], drawn[0, 1])
    assert noisy.reset(sensed(torch.zeros(2)))[0, 0] == 0.0
    coarse = observer({"previous_action": {"resolution": 0.25}})
    assert coarse.reset(sensed(torch.full((1,), 0.3)))[0, 0] == 0.25


def test_layout():
    """Widths follow from the terms, and parts lie in their order."""
    made = observer({"phase": {}, "joint_velocity": {}, "key_point_position": {}})
    assert made.layout == {"phase": 2, "joint_velocity": 20, "key_point_position": 18}
    assert layout_slices(made.layout)["joint_velocity"] == slice(2, 22)
