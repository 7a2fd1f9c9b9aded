"""Terminations that look at more than the pose of the base."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from op3.robot.self_collision import SelfCollision
from op3.tasks import find_task
from op3.tasks.rewards import speed_bonus
from op3.tasks.state import State
from op3.tasks.terminations import CommandedCollision, Lag
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


def commanded(velocity: list[float], yaw: float, asked: list[float]) -> State:
    """A state of one robot that moves in the world [m/s] with a yaw [rad] under a velocity command."""
    state = {name: None for name in ("snapshot", "step", "action", "previous_action", "time", "phase")}
    quaternion = torch.tensor([[np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]])
    readings = {"orientation": torch.tensor([[0.0, 0.0, yaw]]), "angular_velocity": torch.zeros(1, 3)}
    state["snapshot"] = SimpleNamespace(velocity=torch.tensor([velocity]), readings=readings, quaternion=quaternion)
    return State(**state, commands={"velocity": torch.tensor([asked])})  # pyright: ignore[reportArgumentType]


def test_a_robot_falls_behind_its_command():
    """Asked to go left, a robot that looks along y is to move along -x; at a zero command nothing is behind."""
    asked, yaw = [0.0, 0.2, 0.0], np.pi / 2
    good, still = commanded([-0.2, 0.0, 0.0], yaw, asked), commanded([0.0, 0.3, 0.0], yaw, asked)
    assert speed_bonus(good, name="velocity").item() == pytest.approx(0.2)
    assert speed_bonus(still, name="velocity").item() == pytest.approx(0.0, abs=1e-6)
    assert speed_bonus(commanded([-0.9, 0.0, 0.0], yaw, asked), name="velocity").item() == pytest.approx(0.2)
    lag = Lag(1, policy_period=0.5, distance=0.25, name="velocity")
    assert [lag(still).item() for _ in range(3)] == [False, False, True]
    assert lag(good).item()
    assert not lag(commanded([0.0, 0.0, 0.0], yaw, [0.0, 0.0, 0.5])).item()
    assert not lag(still).item()
