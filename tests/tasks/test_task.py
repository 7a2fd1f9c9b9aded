"""Tasks as data, their configs, and how their episodes begin."""

import hydra
import numpy as np
import pytest
from omegaconf import OmegaConf

from op3.policy import PolicyBundle
from op3.robot import asset_path, build_scene, named_configs, pose
from op3.servo import Estimate
from op3.sim import load_model
from op3.tasks import TASKS, Randomisation, Setup, find_task
from op3.tasks.beginning import begin


@pytest.mark.parametrize("name", sorted(TASKS))
def test_configs(name):
    """Every task has a config of its name that makes just this task."""
    assert hydra.utils.instantiate(OmegaConf.load(named_configs("task")[name])) == TASKS[name]


def test_no_config_without_task():
    """There is no config of a task that does not exist."""
    assert set(named_configs("task")) == set(TASKS)


def test_rates():
    """Ten seconds are 313 steps of 32 ms; walking has a cycle of 1 s at 0.3 m/s."""
    assert TASKS["balance"].steps == 313
    assert (TASKS["walk"].cycle, TASKS["walk"].desired_velocity) == (1.0, (0.3, 0.0))
    assert (TASKS["balance"].observation_size, TASKS["walk"].observation_size) == (124, 256)


def test_changes():
    """A task by name may be changed; unknown attributes and impossible grounds are refused by name."""
    assert find_task("walk", duration=2.0).duration == 2.0
    assert TASKS["walk"].duration == 10.0
    with pytest.raises(ValueError, match="a task has no 'speed'"):
        find_task("walk", speed=1.0)
    with pytest.raises(ValueError, match=r"terrain_height must be at most 0\.01, got 0\.02"):
        find_task("walk_terrain", terrain_height=0.02)
    with pytest.raises(ValueError, match="overload must be at least 0, got -1"):
        find_task("balance", overload=-1.0)
    with pytest.raises(ValueError, match="scene 'floor' cannot be moved by board='tilts'"):
        find_task("walk", board="tilts")


def test_beginnings():
    """A beginning is a pure function of its seed, near the stand pose, with the soles near the ground."""
    task, scene = TASKS["balance"], build_scene("board")
    first, again, other = (begin(task, scene, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.qpos, again.qpos)
    np.testing.assert_array_equal(first.qvel, again.qvel)
    assert not np.array_equal(first.qpos, other.qpos)
    assert np.abs(first.qpos[7:27] - pose("stand")).max() < 0.1
    assert first.qvel[[2, 5]].tolist() == [0.0, 0.0]


def test_randomisation_from_intervals():
    """Parameters with an interval are drawn from it, the others stay; without any interval it is refused."""
    model = load_model("paper")
    with pytest.raises(ValueError, match="no parameter with an interval"):
        Randomisation("intervals").bounds(model)
    known = model.with_values({"torque_constant": Estimate(0.006, 0.0055, 0.0065)})
    drawn = [Randomisation("intervals").draw(known, seed) for seed in range(50)]
    assert all(set(values) == {"torque_constant"} for values in drawn)
    assert all(0.0055 <= values["torque_constant"] <= 0.0065 for values in drawn)
    assert np.std([values["torque_constant"] for values in drawn]) > 1e-4


def test_table_one():
    """By default the ten free parameters of Table I are drawn, the forward efficiency is not."""
    bounds = Randomisation().bounds(load_model("paper"))
    assert len(bounds) == 10
    assert "forward_efficiency" not in bounds
    assert bounds["torque_constant"] == (0.003, 0.009)


def test_moving_ground_cannot_be_replayed():
    """A log of a board is not replayed on a board that stays level."""
    with pytest.raises(ValueError, match="cannot be replayed"):
        Setup.of_mount("board")


def test_a_policy_of_another_task_is_refused():
    """The one that walks sees the phase of its gait, which balancing has not."""
    manifest = PolicyBundle.load(asset_path("policies/walk")).manifest
    find_task("walk").check_policy(manifest, "policy=walk")
    balance = find_task("balance")
    with pytest.raises(ValueError, match="policy=walk does not fit task balance: field layout"):
        balance.check_policy(manifest, "policy=walk")
