"""What a diagnosis is worth to a policy."""

import pytest

from op3.envs import BatchedEnv, record_episodes
from op3.sim import load_model
from op3.tasks.task import find_task
from op3.transfer.downstream import downstream
from tests.envs.holding import holding_bundle


@pytest.mark.slow
def test_the_true_model_predicts_the_return_and_another_does_not():
    """Episodes recorded under one model: that model predicts their mean return exactly, a weaker motor does not."""
    task, policy = find_task("balance_eval", duration=1.5), holding_bundle("balance")
    truth = load_model("paper")
    weaker = truth.with_values({"torque_constant": 0.0047})
    env = BatchedEnv(task, truth, 2, 3, action_map=policy.manifest.action_map)
    env.reset = lambda *_, **__: env.begin({robot: robot for robot in range(2)})
    logs = record_episodes(env, policy)
    found = downstream(policy, weaker, truth, task=task, episodes=2, actual=logs, seed=3)
    assert found["error_after"] == pytest.approx(0.0, abs=1e-9)
    assert found["error_before"] > 1e-4
    low, high = found["after"]["interval"]
    assert low <= found["after"]["mean"] <= high


def test_without_episodes_of_the_robot_nothing_is_compared():
    """A verdict that changed nothing predicts the same return, once."""
    task, policy, model = find_task("balance_eval", duration=0.5), holding_bundle("balance"), load_model("paper")
    found = downstream(policy, model, model, task=task, episodes=1)
    assert found["before"] == found["after"]
    assert "error_after" not in found
