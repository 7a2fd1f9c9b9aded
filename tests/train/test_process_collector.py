"""Collecting in two processes through TorchRL's collector."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors.distributed import DistributedCollector
from train_pendulum import seeded_pendulums

from op3.train import SAC, SACSettings
from op3.train.process_collector import ProcessCollector, worker_policy
from op3.train.sac import Exploring


@pytest.mark.slow
def test_two_processes_collect_with_the_learners_weights():
    """Two processes give one continuous rollout, follow new weights and noise at once, and repeat for a seed."""
    sac = SAC(3, 2, SACSettings(hidden=(16,), initial_std=0.1), torch.Generator().manual_seed(0))
    collector = ProcessCollector(seeded_pendulums, processes=2, environments=16)
    first = []
    try:
        for _ in range(2):
            with torch.no_grad():
                sac.actor.biases[-1][:2] = 0.0
            collector.restart(3)
            one, _ = collector.collect(Exploring.ranged(sac, 32, 1.0), 8)
            first.append(one)
            with torch.no_grad():
                sac.actor.biases[-1][:2] = 1.0
            two, _ = collector.collect(Exploring.ranged(sac, 32, 8.0), 8)
            running = ~one["done"][-1]
            assert torch.equal(one["next_observation"][-1][running], two["observation"][0][running])
        assert torch.equal(first[0]["action"], first[1]["action"])
        # each process has other episodes
        assert not torch.equal(first[0]["observation"][0, :16], first[0]["observation"][0, 16:])
        raw = torch.atanh(two["action"].clamp(-0.9999, 0.9999))
        assert float(torch.atanh(one["action"]).mean()) == pytest.approx(0.0, abs=0.1)
        assert float(raw[:, :4].mean()) == pytest.approx(1.0, abs=0.1)
        assert float(raw[:, 28:].std()) > 3 * float(raw[:, :4].std())
    finally:
        collector.close()


@pytest.mark.slow
def test_collectors_of_a_cluster_take_the_same_policy():
    """TorchRL's distributed collector, here with two local nodes, gives the same rollouts and follows new weights."""
    sac = SAC(3, 2, SACSettings(hidden=(16,), initial_std=0.1), torch.Generator().manual_seed(0))
    policy = worker_policy(sac, torch.zeros(16, 1), seed=0)
    nodes = DistributedCollector(
        [partial(seeded_pendulums, seed) for seed in (3, 4)],
        policy,
        frames_per_batch=256,
        total_frames=512,
        sync=True,
        launcher="mp",
        tcp_port="10013",
    )
    try:
        rollouts = iter(nodes)
        first = next(rollouts).clone()
        with torch.no_grad():
            sac.actor.biases[-1][:2] = 1.0
        nodes.update_policy_weights_(TensorDict.from_module(worker_policy(sac, torch.zeros(16, 1), 0)).data)
        second = next(rollouts).clone()
    finally:
        nodes.shutdown()
    assert first.shape == (2, 16, 8)  # node, environment, time
    assert not torch.equal(first["observation"][0], first["observation"][1])
    assert float(first["action"].mean()) == pytest.approx(0.0, abs=0.05)
    assert float(second["action"].mean()) == pytest.approx(0.762, abs=0.05)  # tanh(1)


def test_impossible_counts_are_refused():
    """No processes are refused by number."""
    with pytest.raises(ValueError, match="at least 1, got 0 and 16"):
        ProcessCollector(seeded_pendulums, processes=0, environments=16)
