"""Training on the batched environment and on its composer twin."""

from pathlib import Path

import torch

from op3.envs import make_env
from op3.policy import ActionMap, Manifest
from op3.robot import load_robot
from op3.tasks import find_task
from op3.train import SAC, Progress, TrainSettings, evaluate, train


def learned(backend: str, folder: Path) -> tuple[SAC, Progress]:
    """Forty steps and ten updates of balancing on one robot."""
    task, action_map = find_task("balance", duration=0.48), ActionMap.around_stand(load_robot("op3"))
    env, judge = (make_env(task, num_envs=1, action_map=action_map, backend=backend) for _ in range(2))
    sac = SAC(
        env,
        initial_action=torch.as_tensor(action_map.stand(5.5)),
        hidden=(16, 16),
        batch=16,
        initial_std=0.05,
        warmup=16,
        rollout=4,
        updates_per_step=0.5,
    )
    progress = train(
        sac,
        env,
        lambda policy: evaluate(judge, policy, 1000, task.steps),
        TrainSettings(steps=40, evaluate_every=40, checkpoint_every=40, log_every=8),
        Manifest("balance", task.layout, task.history, action_map, (16, 16)),
        folder,
        say=lambda line: None,
    )
    return sac, progress


def test_both_backends_train_the_same_policy(tmp_path):
    """Same seed, same rewards and evaluation, and the same weights but for the rounding of the physics."""
    (one, first), (other, second) = (learned(backend, tmp_path / backend) for backend in ("batched", "composer"))
    assert one.updates == other.updates == 10  # those of the last rollout would come with the next
    for a, b in zip(one.network.parameters(), other.network.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-4)
    for name in ("reward", "evaluation/return"):
        rows = [[entry[name] for entry in progress.history if name in entry] for progress in (first, second)]
        assert len(rows[0]) > 0
        torch.testing.assert_close(torch.tensor(rows[0]), torch.tensor(rows[1]), rtol=0, atol=1e-5)
