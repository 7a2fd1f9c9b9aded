"""The policies that come with the project."""

import pytest

from op3.envs import make_env, record_episodes
from op3.policy import PolicyBundle
from op3.robot import asset_path
from op3.sim import load_model, model_hash
from op3.tasks import Hold, evaluation_return


@pytest.mark.slow
def test_the_shipped_balance_policy_stands_where_the_stiff_hold_falls():
    """On the tilting board the shipped policy ends 4 of 4 episodes upright, with more R_eval than the hold."""
    policy = PolicyBundle.load(asset_path("policies/balance/manifest.yaml").parent)
    assert policy.manifest.training.model_hash == model_hash(load_model("paper"))
    returns = {}
    for name, judged in (("policy", policy), ("hold", Hold())):
        action_map = policy.manifest.action_map if name == "policy" else None
        env = make_env("balance_eval", "paper", 4, seed=77, action_map=action_map)
        logs = record_episodes(env, judged)
        returns[name] = sum(evaluation_return(log) for log in logs) / 4
        if name == "policy":
            assert not any(log.metadata.fallen for log in logs)
    assert returns["policy"] > returns["hold"]


@pytest.mark.slow
def test_the_shipped_walking_policy_walks():
    """On the floor 8 of 10 robots or more walk for 10 s at 0.2 m/s or faster without falling."""
    policy = PolicyBundle.load(asset_path("policies/walk/manifest.yaml").parent)
    assert policy.manifest.training.model_hash == model_hash(load_model("paper"))
    logs = record_episodes(make_env("walk", "paper", 10, seed=78, action_map=policy.manifest.action_map), policy)
    walked = [log.metadata for log in logs if not log.metadata.fallen]
    assert sum(m.travelled_distance / m.episode_duration >= 0.2 for m in walked) >= 8
