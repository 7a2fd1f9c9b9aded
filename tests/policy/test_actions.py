"""What an action commands."""

import copy
import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from op3.policy import ActionMap
from op3.policy.actions import HELD_GAIN
from op3.robot import load_robot, pose
from tests.op3_table import CONTROLLED_JOINTS, JOINTS, SOFT_LIMITS, indices

MAP = ActionMap.around_stand(load_robot("op3"))
ACTIONS = hnp.arrays(np.float64, (3, 20), elements=st.floats(-1, 1))


def test_zero_is_the_stand_pose_in_the_middle_of_the_gains():
    """Action 0 targets the stand pose with the mean gain of (0.1 + 6) / 2 = 3.05 A/rad."""
    position, gain = MAP.targets(np.zeros(20))
    np.testing.assert_allclose(position, pose("stand", "op3")[indices(CONTROLLED_JOINTS)], atol=1e-12)
    np.testing.assert_allclose(gain, 3.05)


def test_ends_of_the_range():
    """Action +1 and -1 command the ends: 6 and 0.1 A/rad, and the stand pose plus and minus 0.6 rad."""
    high, stiff = MAP.targets(np.ones(20))
    low, loose = MAP.targets(-np.ones(20))
    np.testing.assert_allclose(high - low, 1.2)
    assert np.all(stiff == 6.0)
    np.testing.assert_allclose(loose, 0.1)


@given(ACTIONS)
def test_inverse(action):
    """Targets and back give the action again."""
    np.testing.assert_allclose(MAP.action(*MAP.targets(action)), action, atol=1e-12)


@given(hnp.arrays(np.float64, (20,), elements=st.floats(-1e6, 1e6)))
def test_no_action_leaves_the_soft_limits(action):
    """Whatever a network puts out, the commanded angles stay within the soft limits and the gains in 0.1 to 6."""
    position, gain = MAP.targets(action)
    low, high = np.array([SOFT_LIMITS[joint] for joint in CONTROLLED_JOINTS]).T
    assert np.all((low - 1e-9 <= position) & (position <= high + 1e-9))
    assert np.all((gain >= 0.1 - 1e-9) & (gain <= 6.0 + 1e-9))


@given(ACTIONS)
def test_torch_equals_numpy(action):
    """Torch tensors give the same commands as numpy arrays."""
    for ours, theirs in zip(MAP.targets(action), MAP.targets(torch.from_numpy(action)), strict=True):
        np.testing.assert_allclose(theirs.numpy(), ours, atol=1e-15)
    back = MAP.action(*MAP.targets(torch.from_numpy(action)))
    np.testing.assert_allclose(back.numpy(), action, atol=1e-12)


@pytest.mark.parametrize("degrees", [140.0, 150.0])
def test_limits_of_any_digits_can_be_reached(degrees):
    """150 degrees are 2.617993878 rad when rounded up to nine digits, which is beyond the limit."""
    robot, limit = load_robot("arm"), np.deg2rad(degrees)
    limited = copy.copy(robot)
    limited.limits = np.full_like(robot.limits, limit) * (-1, 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("op3.policy.actions.load_robot", lambda _: limited)
        wide = ActionMap.around_stand(limited, span=4.0)
    assert wide.position_high == (limit,) * 6
    assert wide.position_low == (-limit,) * 6


def test_wide_spans_are_clipped_to_the_soft_limits():
    """A span wider than a joint's soft limits ends at them, and the stand action still stands."""
    wide = ActionMap.around_stand(load_robot("op3"), span=2.0)
    knee = wide.joints.index("l_knee")
    assert wide.position_high[knee] == SOFT_LIMITS["l_knee"][1]
    position, gain = wide.targets(wide.stand())
    np.testing.assert_allclose(position, pose("stand", "op3")[indices(CONTROLLED_JOINTS)], atol=1e-12)
    assert np.all(gain == 6.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position_low": (0.0,)}, "position_low has 1 angles for 10 joints"),
        ({"position_high": (9.0,) * 10}, "l_hip_roll ranges from"),
        ({"joints": ("l_knee",) * 10}, "listed once"),
        ({"gain_low": 7.0}, "gain_high must not be below gain_low, got 7.0 to 6.0"),
        ({"d_gain": float("nan")}, "d_gain"),
    ],
)
def test_impossible_maps_are_refused(change, message):
    """Maps with wrong counts, angles beyond the limits or falling ranges are refused by name."""
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(MAP, **change)


def test_wrong_sizes_are_refused():
    """An action of 10 numbers is refused, and the message carries both numbers."""
    with pytest.raises(ValueError, match=r"must have 20 numbers, got shape \(10,\)"):
        MAP.targets(np.zeros(10))


def test_dictionary_round_trip():
    """A map written as plain values and read again is equal."""
    assert ActionMap.from_dict(MAP.to_dict()) == MAP
    with pytest.raises(ValueError, match="needs exactly the fields"):
        ActionMap.from_dict({"joints": []})


@pytest.mark.parametrize("span", [0.1, 0.4, 0.6])
def test_span_is_how_far_targets_may_lie_from_the_stand_pose(span):
    """It is what `around_stand` was told, where no soft limit is nearer."""
    assert ActionMap.around_stand(load_robot("op3"), span).span == pytest.approx(span)


def test_commands_of_all_joints():
    """Controlled joints get the action's targets, the others hold the stand pose; numpy and torch alike."""
    action_map = ActionMap.around_stand(load_robot("op3"))
    action = np.random.default_rng(0).uniform(-1, 1, (3, action_map.size))
    found = action_map.commands(action)
    position, gain = found["position_target"], found["p_gain"]
    places = indices(action_map.joints)
    held = np.setdiff1d(np.arange(len(JOINTS)), places)
    np.testing.assert_array_equal(position[:, places], action_map.targets(action)[0])
    np.testing.assert_array_equal(gain[:, places], action_map.targets(action)[1])
    np.testing.assert_array_equal(position[:, held], np.tile(pose("stand", "op3")[held], (3, 1)))
    assert (gain[:, held] == HELD_GAIN).all()
    assert (found["d_gain"] == action_map.d_gain).all()
    for name, values in action_map.commands(torch.from_numpy(action)).items():
        np.testing.assert_array_equal(values, found[name])
