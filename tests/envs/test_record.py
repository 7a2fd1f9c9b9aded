"""Episodes as logs, and the sanity of the tasks that the simplest policies show."""

import numpy as np
import pytest
import torch

from op3.envs import make_env, record_episodes
from op3.rollout import read_log
from op3.sim import load_model
from op3.tasks.baselines import Hold, Random, StiffWalk, Zero, position_mode
from op3.tasks.evaluation import evaluation_return, evaluation_rewards
from op3.tasks.task import find_task


def test_log_is_complete(tmp_path):
    """A recorded episode has every channel and field that the schema knows, and survives a file."""
    env = make_env(find_task("walk", duration=0.64), num_envs=2, seed=5)
    logs = record_episodes(env, Hold(env.action_map), recording="hold")
    assert len(logs) == 2
    log = logs[1]
    assert log.rows == 80
    for key in ("joint/current", "imu/linear_acceleration", "command/p_gain", "policy/observation", "policy/reward"):
        assert key in log
    known = log.metadata
    assert (known.robot, known.mount, known.rate, known.policy_rate) == ("simulated", "floor", 125.0, 31.25)
    assert (known.fallen, known.episode_duration, known.seed) == (False, 0.64, int(env.episode_seeds[1]))
    assert known.extra["task"] == "walk"
    assert known.travelled_distance is not None
    assert abs(known.travelled_distance) < 0.01
    assert log.array("done")[:, 0].tolist() == [False] * 79 + [True]
    log.save(tmp_path / "log")
    assert evaluation_return(read_log(tmp_path / "log")) == evaluation_return(log)


def test_policy_channels_are_held():
    """Observation, action and reward change every fourth row and are what the environment exchanged."""
    env = make_env(find_task("balance", duration=0.32), num_envs=1)
    log = record_episodes(env, Random(env.action_map, 1))[0]
    for key in ("policy/observation", "policy/action", "policy/reward"):
        channel = log.array(key)
        np.testing.assert_array_equal(channel, np.repeat(channel[::4], 4, axis=0))
    target, _ = env.action_map.targets(torch.from_numpy(log.array("policy/action")))
    legs = [log.joints.index(name) for name in env.action_map.joints]
    np.testing.assert_allclose(log.array("command/position")[:, legs], target.numpy(), atol=1e-12)


def test_recording_changes_nothing():
    """An environment that is recorded gives the rewards that it gives unrecorded."""
    made = [make_env(find_task("balance", duration=0.32), num_envs=2, seed=9) for _ in range(2)]
    log = record_episodes(made[0], Zero(made[0].action_map))[0]
    state, rewards = made[1].reset(), []
    for _ in range(10):
        state["action"] = torch.zeros(2, 20)
        state = made[1].step(state)["next"]
        rewards.append(state["reward"][0, 0].item())
        state = state.exclude("reward")
    assert log.array("policy/reward")[::4, 0].tolist() == rewards


def test_more_episodes_than_robots():
    """Three episodes of two robots are three different ones."""
    env = make_env(find_task("walk", duration=0.1), num_envs=2)
    logs = record_episodes(env, Hold(env.action_map), episodes=3)
    assert len({log.metadata.seed for log in logs}) == 3


@pytest.mark.slow
def test_holding_survives_a_level_board():
    """Holding the stand pose stiffly survives 10 s on a board that stays level, with a good R_eval."""
    env = make_env(find_task("balance", {"events.board.motion": "still"}), num_envs=4)
    logs = record_episodes(env, Hold(env.action_map))
    assert not any(log.metadata.fallen for log in logs)
    assert all(log.rows == 1252 for log in logs)
    assert min(float(evaluation_rewards(log).mean()) for log in logs) > 0.5


@pytest.mark.slow
def test_holding_falls_from_the_tilting_board():
    """Holding the stand pose stiffly does not pass the evaluation: there is something to learn."""
    env = make_env("balance_eval", num_envs=4)
    logs = record_episodes(env, Hold(env.action_map))
    assert all(log.metadata.fallen for log in logs)


@pytest.mark.slow
def test_stiff_walk_is_for_level_floors():
    """The walk that the OP3 comes with gets over 1.5 m ahead on the floor in 10 s and falls on two layers of bricks."""
    stiff = position_mode(load_model("paper"))
    floor = record_episodes(make_env("walk", stiff, num_envs=2), StiffWalk())
    bricks = record_episodes(make_env("walk_bricks_d", stiff, num_envs=2), StiffWalk())
    assert not any(log.metadata.fallen for log in floor)
    assert min(log.metadata.travelled_distance for log in floor) > 1.5
    assert all(log.metadata.fallen for log in bricks)


def test_stiff_walk_commands_goals():
    """Its log has the goals of the gait at every tick and the register's gain, no gains of a current controller."""
    env = make_env(find_task("walk", duration=0.32), position_mode(load_model("paper")), num_envs=1)
    walk = StiffWalk()
    log = record_episodes(env, walk)[0]
    np.testing.assert_allclose(log.array("command/position"), walk.gait.targets(log.array("time")[:, 0]), atol=1e-12)
    assert (log.array("command/firmware_gain") == 800).all()
    assert "command/p_gain" not in log
    assert np.abs(log.array("joint/current")).max() > 0.1
    assert np.isfinite(evaluation_return(log))
