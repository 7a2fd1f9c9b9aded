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
    for name, action_map in (("policy", policy.manifest.action_map), ("hold", None)):
        env = make_env("balance_eval", "paper", 4, seed=77, action_map=action_map)
        logs = record_episodes(env, policy if name == "policy" else Hold(env.action_map))
        returns[name] = sum(evaluation_return(log) for log in logs) / 4
        if name == "policy":
            assert not any(log.metadata.fallen for log in logs)
    assert returns["policy"] > returns["hold"]
