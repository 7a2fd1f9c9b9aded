"""Who acts: names, folders, and what does not fit."""

from pathlib import Path

import pytest
import torch

from op3.envs.actors import FixedGain, find_actor
from op3.policy import ActionMap
from op3.robot import load_robot
from op3.tasks import Zero, find_task

POLICIES = Path(__file__).resolve().parents[2] / "assets" / "policies"


@pytest.mark.parametrize(
    ("name", "task", "message"),
    [
        (
            str(POLICIES / "balance"),
            "walk",
            r"does not fit task walk: field layout .* the policy was trained for balance",
        ),
        ("stiff", "balance", "policy=stiff walks, but task balance has no gait"),
    ],
)
def test_what_does_not_fit_the_task(name, task, message):
    """A policy that cannot attempt the task is refused by name."""
    with pytest.raises(ValueError, match=message):
        find_actor(name, find_task(task))


def test_fixed_gain():
    """Targets stay, and all gains become the one asked for."""
    action_map = ActionMap.around_stand(load_robot("op3"))
    observation = torch.zeros(3, 4, dtype=torch.float64)
    target, gain = action_map.targets(FixedGain(Zero(action_map), action_map, 2.0).act(observation))
    torch.testing.assert_close(target, action_map.targets(Zero(action_map).act(observation))[0])
    torch.testing.assert_close(gain, torch.full_like(gain, 2.0))
