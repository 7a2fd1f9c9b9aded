"""What gaps of joints say."""

import dataclasses

import numpy as np
import pytest
from contenders import contender

from op3.diagnose.gaps import contradicted, leaves_a_joint, local_ceiling, unresolved


def test_black_box_counts_where_one_joint_carries_it():
    """Torque that a black box finds in all joints alike is a law that is a little wrong, not an outsider."""
    assert local_ceiling(0.3, np.array([0.05, 0.06, 0.1, 0.09])) is None
    assert local_ceiling(0.2, np.array([0.0, 0.18, 0.01])) == pytest.approx(0.18)
    assert local_ceiling(0.0, np.zeros(3)) is None


@pytest.mark.parametrize(
    ("name", "most", "room"),
    [("compliance@3", 2.4, True), ("compliance@3", 1.5, False), ("backlash@3", 6.0, False), ("backlash@2", 6.0, True)],
)
def test_a_joint_that_stands_out_leaves_room(name, most, room):
    """What is left in one joint is another effect's, but impacts in the joint itself leave much."""
    left = np.array([1.0, 0.9, 1.1, most, 1.2, 1.0])
    leader = dataclasses.replace(contender(name, 0.5), left=left)
    assert leaves_a_joint([leader]) is room
    assert leaves_a_joint([leader, dataclasses.replace(contender("latency", 0.5), left=left)]) is room
    assert not leaves_a_joint([dataclasses.replace(leader, left=0.5 * left)]) or most > 4
    assert not leaves_a_joint([contender(name, 0.5)])  # of free runs nothing is known


@pytest.mark.parametrize(
    ("names", "left", "expected"),
    [
        (["load_friction@3", "velocity_filter"], 48.0, True),
        (["lugre", "backlash@3"], 48.0, False),
        (["lugre", "backlash@2"], 48.0, True),
        (["load_friction@3", "velocity_filter"], 12.0, True),
        (["load_friction@3", "velocity_filter"], 2.0, False),
        ([], 48.0, False),
    ],
)
def test_names_that_leave_a_large_gap_resolve_nothing(names, left, expected):
    """Behind a hard stop other effects explain some of its impacts; play in the joint itself leaves impacts as well."""
    rest = np.array([0.2, 0.2, 0.2, 1.0, 0.2, 0.2]) * left
    named = [dataclasses.replace(contender(name, 0.3), left=rest) for name in names]
    assert unresolved(named) is expected


@pytest.mark.parametrize(
    ("label", "joint", "expected"),
    [
        ("load_friction@2", 2, True),
        ("load_friction@2", 1, False),
        ("load_friction@2", None, False),
        ("dte", 2, False),
        ("backlash@2", 2, False),
    ],
)
def test_a_fault_is_contradicted_by_what_it_leaves_in_its_joint(label, joint, expected):
    """Where the joint of a fault still stands out and nothing explains that, it was another; impacts rattle on."""
    assert contradicted([contender(label, 0.4)], joint) == expected
