"""What may be asked of a study, and how policies are compared."""

import numpy as np
import pytest
import torch

from op3.compliance.compare import _of_shares
from op3.compliance.compliance_study import Sizes, StiffFamily, Study, contestants
from op3.compliance.robustness import Passed
from op3.motions import SinusoidalGait
from op3.sim import load_model
from op3.tasks import find_task
from tests.deploy.policies import hold_policy


def test_what_cannot_be_studied():
    """Tasks without a gait, policies named twice and too few episodes are refused by name."""
    with pytest.raises(ValueError, match="task balance has no gait"):
        Study(load_model("paper"), ["balance"])
    with pytest.raises(ValueError, match="different names, got hold, hold"):
        contestants(["hold", "hold"], find_task("walk"), [])
    with pytest.raises(ValueError, match="sizes: episodes must be at least 2, got 1"):
        Sizes(episodes=1)


def test_a_policy_of_another_robot_is_refused(tmp_path):
    """By name, before anything is measured, without a setting that the command does not have."""
    folder = hold_policy("walk", robot="quadruped").save(tmp_path / "policy")
    with pytest.raises(
        ValueError, match=r"policy was trained for the robot quadruped, but the task's robot is op3; give"
    ):
        contestants([str(folder)], find_task("walk"), [])


def test_fixed_gains_stand_beside_the_policy():
    """The first policy's targets come once more for every gain that is fixed; a stiff walk has no such gains."""
    labels = [actor.label for actor in contestants(["hold", "stiff"], find_task("walk"), [2.0])]
    assert labels == ["hold", "stiff", "hold, gain fixed at 2 A/rad"]
    assert len(contestants(["stiff"], find_task("walk"), [2.0])) == 1


def test_a_family_of_stiff_walks():
    """Robots take the walks in turn."""
    gaits = [SinusoidalGait(step=0.02), SinusoidalGait(step=0.04)]
    targets = StiffFamily(gaits).commands(torch.full((4,), 3.1, dtype=torch.float64))["position_target"]
    for row, gait in zip(targets, gaits * 2, strict=True):
        np.testing.assert_allclose(row, gait.targets(np.array([3.1]))[0])


def test_difference_of_shares():
    """56 of 70 against 48 of 80: 0.2 (0.0524 to 0.3339), the example of Newcombe (1998), method 10."""
    found = _of_shares([Passed(70, 70, 56, 0.0)], [Passed(80, 80, 48, 0.0)])
    assert found == pytest.approx((0.2, 0.0524, 0.3339), abs=1e-4)
    assert _of_shares([], []) is None
