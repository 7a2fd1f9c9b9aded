"""R_eval from a log alone, against values worked out by hand."""

import math

import numpy as np
import pytest
import torch

from op3.robot import load_robot
from op3.rollout import LogError, Metadata, Rollout
from op3.tasks.evaluation import (
    evaluation_return,
    evaluation_rewards,
    succeeded,
    swayed,
)
from tests.op3_table import JOINTS

RATE = 125.0

LEVER = 0.24479
"""Height of the trunk's origin above the soles in the stand pose [m]."""


def log(task: str, steps: int = 3, **metadata) -> Rollout:
    """A robot at rest, level, without currents, whose action stays."""
    rows = 4 * steps
    arrays = {
        "time": np.arange(rows) / RATE,
        ("command", "position"): np.zeros((rows, 20)),
        ("joint", "position"): np.zeros((rows, 20)),
        ("joint", "current"): np.zeros((rows, 20)),
        ("imu", "orientation"): np.zeros((rows, 3)),
        ("imu", "angular_velocity"): np.zeros((rows, 3)),
        ("imu", "linear_acceleration"): np.tile([0.0, 0.0, 9.81], (rows, 1)),
        ("policy", "action"): np.zeros((rows, 20)),
    }
    known = dict(robot="real", mount="floor", rate=RATE, policy_rate=31.25, extra={"task": task})
    return Rollout.from_arrays(arrays, Metadata(joints=JOINTS, **{**known, **metadata}))


def test_still_robot_gets_one_per_step():
    """A robot at rest on the board gets 1 in each of its policy steps."""
    assert evaluation_rewards(log("balance_eval")).tolist() == [1.0, 1.0, 1.0]
    assert evaluation_return(log("balance_eval", steps=7)) == 7.0


def test_balance_by_hand():
    """In the second step the trunk pitches with 0.5 rad/s and all currents are 0.1 A."""
    made = log("balance_eval")
    made.data["imu", "angular_velocity"][4:8, 1] = 0.5
    made.data["joint", "current"][4:8] = 0.1
    forward = -(1 - math.exp(-2 * LEVER * 0.5))
    currents = -(1 - math.exp(-0.05 * 10 * 0.1 * math.sqrt(20)))
    turning = -(1 - math.exp(-0.1 * 0.5))
    expected = 1 + 0.6 * forward + 0.1 * (currents + turning)
    assert evaluation_rewards(made).tolist() == pytest.approx([1.0, expected, 1.0], rel=1e-5)


def test_trunk_height():
    """The lever from rates to velocities is the height of the trunk in the stand pose, 0.245 m."""
    rates = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    assert swayed(rates, load_robot("op3"))[0].item() == pytest.approx(LEVER, abs=1e-5)


def test_walk_by_hand():
    """1.5 m in 10 s are 0.15 m/s, 0.15 less than desired, in every step."""
    made = log("walk", travelled_distance=1.5, episode_duration=10.0, fallen=False)
    expected = 1 - 0.6 * (1 - math.exp(-2 * 0.15))
    assert evaluation_rewards(made).tolist() == pytest.approx([expected] * 3)


def test_only_policy_rows_count():
    """What happens between policy steps does not change R_eval; what happens at them does."""
    made = log("balance_eval")
    made.data["imu", "orientation"][1:4, 0] = 0.3
    assert evaluation_return(made) == 3.0
    made.data["imu", "orientation"][4, 0] = 0.3
    assert evaluation_return(made) < 3.0


def test_rows_that_a_loop_has_skipped_move_no_step():
    """After a missed deadline the rows of the policy's steps are still those in which it acted."""
    made = log("balance_eval", steps=4)
    kept = np.delete(np.arange(16), 5)
    arrays = {key: made.array(key)[kept].copy() for key in made.channels}
    arrays["imu", "orientation"][7, 0] = 0.3  # row 8 of the whole log: the third step
    fewer = evaluation_rewards(Rollout.from_arrays(arrays, made.metadata))
    assert (fewer < 1).tolist() == [False, False, True, False]


def test_actions_are_compared_with_the_ones_before():
    """A change of one action by 0.2 costs 0.1 (1 - exp(-0.1 * 0.2)) in its step and in the next."""
    made = log("balance_eval")
    made.data["policy", "action"][4:8, 0] = 0.2
    lost = 0.1 * (1 - math.exp(-0.1 * 0.2))
    assert evaluation_rewards(made).tolist() == pytest.approx([1.0, 1 - lost, 1 - lost])


def test_missing_fields_are_named():
    """A log without what R_eval needs is refused with the field's name."""
    with pytest.raises(LogError, match="travelled_distance"):
        evaluation_rewards(log("walk"))
    with pytest.raises(LogError, match="policy_rate"):
        evaluation_rewards(log("balance", policy_rate=None))
    with pytest.raises(LogError, match="task"):
        evaluation_rewards(log("balance", extra={}))


def test_who_stands_still_does_not_succeed_at_walking():
    """Walking succeeds upright and at least 1 m ahead; balancing succeeds upright."""
    known = dict(episode_duration=10.0, fallen=False)
    assert succeeded(log("walk", travelled_distance=1.0, **known), "walk")
    assert not succeeded(log("walk", travelled_distance=0.99, **known), "walk")
    assert not succeeded(log("walk", travelled_distance=2.0, episode_duration=10.0, fallen=True), "walk")
    assert succeeded(log("balance_eval", **known), "balance_eval")
    assert not succeeded(log("balance_eval", fallen=True), "balance_eval")
    with pytest.raises(LogError, match="fallen"):
        succeeded(log("balance_eval"), "balance_eval")
