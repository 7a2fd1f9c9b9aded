"""Recorded logs as transitions."""

import pytest
import torch

from op3.envs import make_env, record_episodes
from op3.tasks import find_task
from op3.train import SAC, transitions


def test_recorded_episodes_can_be_learned_from():
    """Two short episodes in a buffer: as many transitions as steps, with the observations, actions and rewards of the
    log; what follows the last step is unknown where the robot did not fall."""
    task = find_task("balance", {"duration": 0.32})
    env = make_env(task, num_envs=2, seed=3)
    logs = record_episodes(env, lambda observation: torch.zeros(len(observation), 20))
    sac = SAC(env, hidden=(8,), batch=8, buffer=100, n_step=1)
    for log in logs:
        rollout = transitions(log)
        assert rollout.shape == (1, 9)  # of ten steps
        sac.store(rollout)
    data = sac.buffer.storage[:]
    assert len(data) == 18
    torch.testing.assert_close(data["observation"][:9], logs[0].data["policy", "observation"][:36:4].float())
    torch.testing.assert_close(data["next", "observation"][:9], logs[0].data["policy", "observation"][4::4].float())
    torch.testing.assert_close(data["next", "reward"][9:], logs[1].data["policy", "reward"][:36:4].float())
    assert not bool(data["next", "terminated"].any())
    assert set(sac.update(sac.buffer.sample())) >= {"critic_loss", "actor_loss"}
    logs[0].metadata.__dict__["fallen"] = True
    fallen = transitions(logs[0])
    assert fallen.shape == (1, 10)
    assert fallen["next", "terminated"][0, :, 0].tolist() == [False] * 9 + [True]
    sac.store(fallen)
    assert len(sac.buffer) == 28


def test_a_log_without_a_policy_is_refused():
    env = make_env(find_task("balance", {"duration": 0.064}), num_envs=1)
    log = record_episodes(env, lambda observation: torch.zeros(len(observation), 20))[0]
    del log.data["policy", "reward"]
    with pytest.raises(ValueError, match="the log has no policy/reward; record it"):
        transitions(log)
