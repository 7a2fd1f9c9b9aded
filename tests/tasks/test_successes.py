"""Success as a term: judged at the last step of an episode."""

import torch

from op3.envs import make_env
from op3.envs.record import record_episodes
from op3.tasks.baselines import Hold
from op3.tasks.evaluation import succeeded
from op3.tasks.task import find_task


def test_an_arm_succeeds_where_its_tip_is():
    """The tip of an arm that holds its pose is as far from its target as simulation says; a limit splits the arms."""
    task = find_task("reach", duration=0.32)
    env = make_env(task, num_envs=8, num_threads=1)
    hold = Hold(env.action_map)
    record_episodes(env, hold)
    state = env.mdp.state
    distance = torch.linalg.vector_norm(state.tip_position - state.commands["target"], dim=1)
    limit = float(distance.median())
    env = make_env(task.changed({"success.at_target.distance": limit}), num_envs=8, num_threads=1)
    logs = record_episodes(env, hold)
    assert [succeeded(log, env.task) for log in logs] == (distance <= limit).tolist()
    assert 0 < sum(succeeded(log, env.task) for log in logs) < 8


def test_who_stands_has_not_travelled():
    """A robot that holds its pose is upright, does not travel, and succeeds only where nothing more is asked."""
    walk = find_task("walk", duration=0.32)
    for changes, wanted in (
        ({}, False),
        ({"success.travelled": None}, True),
        ({"success.travelled.distance": -0.1}, True),
    ):
        env = make_env(walk.changed(changes), num_envs=2, num_threads=1)
        logs = record_episodes(env, Hold(env.action_map))
        assert [succeeded(log, env.task) for log in logs] == [wanted, wanted]
        assert all(log.metadata.extra["success"] == wanted for log in logs)
