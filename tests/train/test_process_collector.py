"""Collecting in two processes through TorchRL's collector."""

import pytest
import torch
from train_pendulum import seeded_pendulums

from op3.train import SAC, SACSettings
from op3.train.process_collector import ProcessCollector
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


def test_impossible_counts_are_refused():
    """No processes are refused by number."""
    with pytest.raises(ValueError, match="at least 1, got 0 and 16"):
        ProcessCollector(seeded_pendulums, processes=0, environments=16)
