"""Terminations that look at more than the pose of the base."""

from types import SimpleNamespace

import torch

from op3.robot.self_collision import SelfCollision
from op3.tasks import find_task
from op3.tasks.terminations import CommandedCollision
from tests.op3_table import OP3


def test_an_action_that_drives_the_feet_together_fails():
    """At the highest gain it fails, at the lowest and for feet that stay apart it does not; the shape is [env]."""
    action_map = find_task("balance").action_map()
    term = CommandedCollision(OP3, action_map)
    inwards = torch.zeros(len(action_map.joints))
    inwards[action_map.joints.index("l_hip_roll")], inwards[action_map.joints.index("r_hip_roll")] = 0.5, -0.5
    stiff, soft = torch.ones_like(inwards), -torch.ones_like(inwards)
    action = torch.stack(
        [
            torch.cat([inwards, stiff]),
            torch.cat([-inwards, stiff]),
            torch.cat([inwards, soft]),
            torch.cat([0 * inwards, stiff]),
        ]
    )
    home = torch.from_numpy(OP3.home).expand(4, -1)
    failed = term(SimpleNamespace(action=action.double(), joint_position=home))  # pyright: ignore[reportArgumentType]
    assert failed.tolist().count(True) == 1
    told = action_map.commands(action[failed][0].numpy())
    gap = SelfCollision(OP3).nearest(told["position_target"])
    assert gap is not None
    assert gap.distance < -term.overlap
    assert not CommandedCollision(OP3, action_map, overlap=1.0)(
        SimpleNamespace(action=action.double(), joint_position=home)  # pyright: ignore[reportArgumentType]
    ).any()
