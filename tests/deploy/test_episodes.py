"""Episodes of a policy on the emulated robot, on the ground of a task."""

import numpy as np
import pytest

from op3.deploy import Player
from op3.policy import PolicyBundle
from op3.robot import asset_path
from op3.sim import load_model
from op3.tasks.evaluation import evaluation_return
from op3.transfer.returns import ReturnsBench
from tests.envs.holding import holding_bundle

SOURCES = (
    pytest.param({"world": "default"}, id="stand_in"),
    pytest.param({"model": "paper"}, id="model", marks=pytest.mark.slow),
)
EITHER = pytest.mark.parametrize("source", SOURCES)


@EITHER
def test_the_board_tilts_when_the_policy_begins(source, tmp_path):
    """Level for a second, then the board takes the trunk along; the log is judged by R_eval as it is."""
    player = Player(folder=tmp_path, confirm=False, seed=3, report=lambda _: None, robot="op3", **source)
    log = player.run_policy(holding_bundle("balance", 5.5), 2.6, task="balance_eval", recording="a")
    pitch = log.array("imu/orientation")[:, 1]
    assert np.ptp(pitch[:100]) < np.deg2rad(1.5)
    assert abs(pitch[-1] - pitch[0]) > np.deg2rad(5.0)
    assert not log.metadata.fallen
    assert log.metadata.extra["task"] == "balance_eval"
    steps = round(log.metadata.episode_duration * 31.25)
    assert 0.6 * steps < evaluation_return(log) < steps


@pytest.mark.slow
@EITHER
def test_a_walk_is_measured(source, tmp_path):
    """A policy that stands has travelled nothing, and R_eval of the walk says so."""
    player = Player(folder=tmp_path, confirm=False, seed=1, report=lambda _: None, robot="op3", **source)
    log = player.run_policy(holding_bundle("walk", 5.5), 1.0, task="walk_bricks_a", cycle=1.0, recording="a")
    assert 0.0 <= log.metadata.travelled_distance < 0.01
    assert evaluation_return(log) < 0.8 * 31


@pytest.mark.slow
def test_the_bus_costs_the_shipped_policy_little(tmp_path):
    """Through the whole emulated bus the balancing policy reaches its return in the plain environment within 5 %."""
    policy = PolicyBundle.load(asset_path("policies/balance/manifest.yaml").parent)
    player = Player(folder=tmp_path, confirm=False, seed=0, report=lambda _: None, model="paper", robot="op3")
    logs = [player.run_policy(policy, 10.0, task="balance_eval", recording=str(number)) for number in range(3)]
    through = np.mean([evaluation_return(log) for log in logs])
    plain = float(ReturnsBench(policy, load_model("paper"), "balance_eval", episodes=6).run().returns.mean())
    assert through == pytest.approx(plain, rel=0.05)


@pytest.mark.parametrize(("name", "task", "duration"), [("walk", "walk", 2.0), ("balance", "balance_eval", 3.0)])
def test_a_robot_is_caught_when_its_policy_ends(tmp_path, name, task, duration):
    """It cannot stop within a step, nor the board; on the way to the end pose it hangs and does not fall."""
    policy = PolicyBundle.load(asset_path(f"policies/{name}/manifest.yaml").parent)
    player = Player(folder=tmp_path, confirm=False, seed=1, report=lambda _: None, robot="op3")
    log = player.run_policy(policy, duration, task=task, recording="a")
    assert not log.metadata.fallen
    assert "afterwards" not in log.metadata.extra
    if task == "walk":
        assert log.metadata.travelled_distance > 0.2
