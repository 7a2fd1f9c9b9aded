"""What counts, on synthetic numbers."""

import dataclasses

import numpy as np
import pytest
from contenders import BLOCKS, contender

from op3.diagnose.counting import better_beside, of_another_kind, shows_at_home, worth_a_candidate
from op3.diagnose.evidence import Own, signed_ranks
from op3.diagnose.thresholds import OWN_CLEAR_Z, OWN_Z


@pytest.mark.parametrize(("gain", "enough"), [(0.12, False), (0.3, True)])
def test_a_fault_that_explains_more_of_its_joint_needs_fewer_seconds(gain, enough):
    """Of sixty seconds half have gained and the others lost a little: the ranks score about 3."""
    rng = np.random.default_rng(2)
    gained = np.where(np.arange(BLOCKS) < 28, 1.0, -0.05) * rng.uniform(0.5, 1.5, size=BLOCKS)
    assert OWN_CLEAR_Z + 0.5 < signed_ranks(gained) < OWN_Z - 0.5
    assert shows_at_home(Own(gain, gain, np.full(BLOCKS, 2.0), gained)) is enough


@pytest.mark.parametrize(
    ("gain", "fit_gain", "seconds", "better"),
    [
        (0.3, 0.15, BLOCKS, True),
        (0.3, 0.05, BLOCKS, False),
        (0.05, 0.3, BLOCKS, False),
        (0.3, 0.3, 3, False),
        (0.4, 0.4, 3, True),  # so much may be of few seconds
    ],
)
def test_a_fault_has_to_beat_the_leader_in_its_joint(gain, fit_gain, seconds, better):
    """In fitted and choosing runs, and in more than a few seconds."""
    gained = np.full(BLOCKS, -0.01)
    gained[:seconds] = 1.0
    one = Own(gain, fit_gain, np.full(BLOCKS, 5.0), gained)
    assert better_beside(one) is better
    # of what all joints share less will do, in as many seconds
    assert better_beside(one, alone=False) is (better or seconds == BLOCKS)


@pytest.mark.parametrize(
    ("label", "gain", "changes", "another"),
    [
        ("current_lag", 0.2, {}, False),  # its direction is not known
        ("current_lag", 0.1, {"direction": np.array([0.1, 1.0])}, False),  # too little
        ("current_lag@2", 0.2, {}, False),  # a fault of one joint, of which is asked elsewhere
        ("lugre", 0.2, {}, False),  # the same in another form
        ("current_lag", 0.2, {"confounders": ("lugre",), "direction": np.array([0.1, 1.0])}, False),
        ("current_lag", 0.2, {"implausible": True, "direction": np.array([0.1, 1.0])}, False),
        ("current_lag", 0.2, {"size": 0.01, "direction": np.array([0.1, 1.0])}, False),
        ("current_lag", 0.2, {"direction": np.array([1.0, 0.1])}, False),  # alike to these logs
        ("current_lag", 0.2, {"direction": np.array([0.1, 1.0])}, True),
    ],
)
def test_an_effect_of_another_kind_is_a_sign_of_more(control, label, gain, changes, another):
    """Two of all joints that explain much and are not alike are two effects, whichever explains more."""
    leader = dataclasses.replace(contender("lugre", 0.3), direction=np.array([1.0, 0.0]))
    one = dataclasses.replace(contender(label, gain, seed=1), **changes)
    assert of_another_kind(one, leader, control) is another
    assert not of_another_kind(one, dataclasses.replace(leader, joints=(3,)), control)


@pytest.mark.parametrize(
    ("gain", "size", "implausible", "told"),
    [(0.5, 0.2, False, True), (0.1, 0.2, False, False), (0.5, 0.01, False, False), (0.5, 0.2, True, False)],
)
def test_what_poor_logs_show_much_of_is_worth_a_candidate(gain, size, implausible, told):
    """In logs that carry no name an effect that explains much, with a size that matters, is told, and no other."""
    one = dataclasses.replace(
        contender("dte", gain), gain=gain, fit_gain=gain, size=size, smallest=0.1, implausible=implausible
    )
    assert worth_a_candidate(one) == told
