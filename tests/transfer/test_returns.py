"""Returns of one policy on many models."""

import pytest
import torch

from op3.envs import BatchedEnv, record_episodes
from op3.sim import load_model
from op3.tasks.evaluation import evaluation_return
from op3.tasks.task import find_task
from op3.transfer.returns import ReturnsBench
from tests.envs.holding import holding_bundle

CONSTANTS = torch.tensor([0.0047, 0.0065, 0.008])


@pytest.mark.parametrize(("name", "tolerance"), [("balance_eval", 1e-12), ("walk", 1e-3)])
def test_returns_are_those_of_the_logs(name, tolerance):
    """The returns without recording equal R_eval of the logs of the same episodes."""
    task, model, policy = find_task(name, duration=1.5), load_model("paper"), holding_bundle(name.split("_")[0])
    bench = ReturnsBench(policy, model, task, episodes=3, seed=5)
    returns = bench.run({"torque_constant": CONSTANTS}, 3).returns
    values = {"torque_constant": CONSTANTS.double()[1]}
    env = BatchedEnv(task, model, 3, 5, action_map=policy.manifest.action_map, parameters=values)
    env.reset = lambda *_, **__: env.begin({robot: robot for robot in range(3)})
    logs = record_episodes(env, policy)
    expected = torch.tensor([evaluation_return(log, task) for log in logs], dtype=torch.float64)
    torch.testing.assert_close(returns[1], expected, rtol=tolerance, atol=0)


def test_episodes_do_not_depend_on_how_many_run_side_by_side(monkeypatch):
    """With two rows that are refilled after each fall, the returns are those of all episodes at once."""
    task, model, policy = find_task("balance_eval", duration=3.0), load_model("paper"), holding_bundle(p_gain=1.0)
    at_once = ReturnsBench(policy, model, task, episodes=2, seed=1).run({"torque_constant": CONSTANTS}, 3)
    monkeypatch.setattr("op3.transfer.returns.ROWS", 2)
    in_turn = ReturnsBench(policy, model, task, episodes=2, seed=1).run({"torque_constant": CONSTANTS}, 3)
    assert at_once.fallen.any()
    torch.testing.assert_close(in_turn.returns, at_once.returns, rtol=0, atol=1e-9)
