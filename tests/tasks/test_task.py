"""Tasks as data, their configs, and how their episodes begin."""

import re

import hydra
import numpy as np
import pytest

from op3.apps.compose import composed
from op3.envs import make_env
from op3.policy import PolicyBundle
from op3.replay import Setup
from op3.robot import asset_path, pose
from op3.servo import Estimate
from op3.sim import load_model
from op3.tasks import ParameterRanges, find_task, task_names


@pytest.mark.parametrize("name", task_names())
def test_a_task_is_the_same_through_hydra(name):
    """Composed by Hydra and instantiated, a file of conf/task gives the task that its name gives in Python."""
    config = composed("evaluate", [f"task={name}"])
    assert hydra.utils.instantiate(config.task) == find_task(name)


def test_rates():
    """Ten seconds are 313 steps of 32 ms; walking has a cycle of 1 s at 0.3 m/s."""
    balance, walk = find_task("balance"), find_task("walk")
    assert balance.steps == 313
    assert (walk.cycle, walk.desired_velocity) == (1.0, (0.3, 0.0))
    assert (balance.observation_size, walk.observation_size) == (124, 256)
    assert (sum(balance.layout.values()), sum(walk.layout.values())) == (62, 64)


def test_table_two():
    """The rewards of training are those of the paper's Table II."""
    balance, walk = find_task("balance").rewards, find_task("walk").rewards
    assert [balance[name]["weight"] for name in ("alive", "command", "smooth")] == [1.0, 0.6, 0.1]
    assert (balance["command"]["forward"], balance["command"]["sideways"]) == (2.0, 2.0)
    assert [walk[name]["weight"] for name in ("alive", "command", "smooth", "bipedal")] == [1.0, 0.3, 0.1, 0.4]
    assert (walk["command"]["forward"], walk["command"]["sideways"]) == (15.0, 1.0)


def test_changes():
    """A task by name may be changed by dotted path; what it does not have is refused by name."""
    assert find_task("walk", duration=2.0).duration == 2.0
    assert find_task("walk").duration == 10.0
    changed = find_task("walk", {"rewards.command.forward": 5.0, "rewards.smooth": None, "gait.cycle": 0.8})
    assert (changed.rewards["command"]["forward"], changed.cycle) == (5.0, 0.8)
    assert "smooth" not in changed.reward_terms
    with pytest.raises(ValueError, match="a task has no 'speed'"):
        find_task("walk", speed=1.0)
    with pytest.raises(ValueError, match="task: duration must be above 0, got -1"):
        find_task("walk", duration=-1.0)


IMPOSSIBLE = {
    "events.terrain: height must be between 0 and 0.01 m, got 0.02": ("walk_terrain", {"events.terrain.height": 0.02}),
    "events.board: scene 'floor' cannot be moved by motion='tilts'": ("walk", {"events.board": {"motion": "tilts"}}),
    "rewards.smoth: there is no term 'smoth'; the nearest is 'smooth'": ("walk", {"rewards.smoth": {"weight": 1.0}}),
    "rewards.command.foward: unknown field; the nearest is 'forward'": ("walk", {"rewards.command.foward": 2.0}),
    "rewards.command.forward is missing: give it a value": ("walk", {"rewards.command": {"sideways": 1.0}}),
    "terminations.tilt.function: 'nowhere.tilt' cannot be imported": (
        "walk",
        {"terminations.tilt.function": "nowhere.tilt"},
    ),
    "rewards.smooth.function: math has no 'smoth'": ("walk", {"rewards.smooth.function": "math.smoth"}),
    "observations.phase does not fit the robot op3: the task has no gait": ("balance", {"observations.phase": {}}),
    "observations.command does not fit the robot op3: the task has no command": ("walk", {"observations.command": {}}),
    "observations.phase.noise must be a number of at least 0": ("walk", {"observations.phase.noise": -1.0}),
    "actions.position.spam: unknown field; the nearest is 'span'": ("walk", {"actions.position.spam": 1.0}),
    "actions.positions: unknown action term": ("walk", {"actions.positions": {}}),
    "commands.velocity: forward must be a smallest and a largest value": (
        "walk",
        {"commands.velocity": {"forward": [1.0, 0.0]}},
    ),
}


@pytest.mark.parametrize("message", IMPOSSIBLE)
def test_an_impossible_term_is_named(message):
    """One sentence names the term, the field and the nearest name."""
    name, changes = IMPOSSIBLE[message]
    with pytest.raises(ValueError, match=re.escape(message)):
        make_env(find_task(name, changes), num_envs=1, num_threads=1)


def test_beginnings():
    """A beginning is a pure function of its seed, near the stand pose, with the soles near the ground."""
    env = make_env("balance", num_envs=1, num_threads=1)
    row = np.zeros(1, dtype=np.int64)
    first, again, other = (env.mdp.begin(row, np.array([seed])) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.qpos, again.qpos)
    np.testing.assert_array_equal(first.qvel, again.qvel)
    assert not np.array_equal(first.qpos, other.qpos)
    assert np.abs(first.qpos[0, 7:27] - pose("stand", "op3")).max() < 0.1
    assert first.qvel[0, [2, 5]].tolist() == [0.0, 0.0]


def test_randomisation_from_intervals():
    """Parameters with an interval are drawn from it, the others stay; without any interval it is refused."""
    model = load_model("paper")
    with pytest.raises(ValueError, match="no parameter with an interval"):
        ParameterRanges("intervals").bounds(model)
    known = model.with_values({"torque_constant": Estimate(0.006, 0.0055, 0.0065)})
    drawn = [ParameterRanges("intervals").draw(known, seed) for seed in range(50)]
    assert all(set(values) == {"torque_constant"} for values in drawn)
    assert all(0.0055 <= values["torque_constant"] <= 0.0065 for values in drawn)
    assert np.std([values["torque_constant"] for values in drawn]) > 1e-4


def test_table_one():
    """By default the ten free parameters of Table I are drawn, the forward efficiency is not."""
    bounds = ParameterRanges().bounds(load_model("paper"))
    assert len(bounds) == 10
    assert "forward_efficiency" not in bounds
    assert bounds["torque_constant"] == (0.003, 0.009)


def test_moving_ground_cannot_be_replayed():
    """A log of a board is not replayed on a board that stays level."""
    with pytest.raises(ValueError, match="cannot be replayed"):
        Setup.of_mount("board", robot="op3")


def test_a_policy_of_another_task_is_refused():
    """The one that walks sees the phase of its gait, which balancing has not."""
    manifest = PolicyBundle.load(asset_path("policies/walk")).manifest
    find_task("walk").check_policy(manifest, "policy=walk")
    balance = find_task("balance")
    with pytest.raises(ValueError, match="policy=walk does not fit task balance: field layout"):
        balance.check_policy(manifest, "policy=walk")
