"""Learning that begins from demonstrations, on a real, small environment."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor
from train_pendulum import LIMIT, MANIFEST, Pendulum

from op3.train import (
    SAC,
    Batch,
    Collector,
    Demonstrations,
    DemonstrationSettings,
    SACSettings,
    TrainSettings,
    evaluate,
    train,
)

SAC_SETTINGS = SACSettings(hidden=(32, 32), batch=64, initial_std=0.05, actor_rate=3e-4, critic_rate=1e-3)
SETTINGS = DemonstrationSettings(steps=640, rounds=2, noise=0.2, cloning=300, imitation=5.0, imitation_updates=1000)


def lean(observation: Tensor) -> Tensor:
    """Rests at the angle asked for with the highest gain: 4 sin(wanted) + 4 p (target - wanted) = 0, p = 6."""
    wanted = observation[:, 2]
    target = wanted - torch.sin(wanted) / 6
    return torch.stack([target / 0.8, torch.full_like(target, 0.9)], -1)


def learner(seed: int = 0) -> SAC:
    return SAC(3, 2, SAC_SETTINGS, torch.Generator().manual_seed(seed))


def demonstrations(settings: DemonstrationSettings = SETTINGS) -> Demonstrations:
    return Demonstrations(Collector(Pendulum(16)), lean, settings)


def seen(count: int = 200) -> Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(9)) * 0.8 - 0.4


def test_the_policy_imitates_the_demonstrator():
    """Where neither has been, the clone's actions are within 0.05 of the demonstrator's; its exploration stays."""
    sac = learner()
    before = (sac.act(seen(), 0.0) - lean(seen())).abs().mean()
    demonstrations().show(sac, say=lambda line: None)
    after = (sac.act(seen(), 0.0) - lean(seen())).abs().mean()
    assert before > 0.2
    assert after < 0.05
    _, log_std = sac.actor(sac.normaliser(seen(), 10.0))
    torch.testing.assert_close(log_std.exp(), torch.full_like(log_std, 0.05), rtol=0.2, atol=0)


def test_what_is_imitated_has_no_noise():
    """Answers are the demonstrator's own actions; the recorded ones carry noise that grows from robot to robot."""
    shown = demonstrations().show(learner(), say=lambda line: None)
    torch.testing.assert_close(shown.answer, lean(shown.observation))
    noise = shown.replay.action - torch.stack([lean(row) for row in shown.replay.observation])
    spread = noise[..., 0].std(0)
    assert float(spread[0]) < 1e-6
    torch.testing.assert_close(spread[8], torch.tensor(0.2 * 8 / 15), rtol=0.4, atol=0)


def test_only_the_first_round_is_the_demonstrators():
    """Two rounds are asked about, but the critics' episodes are those of the first, and they end where it does."""
    shown = demonstrations().show(learner(), say=lambda line: None)
    assert len(shown.answer) == 2 * 640
    assert len(shown.replay) == 640
    assert bool(shown.replay.done[-1].all())


def run(folder: Path, settings: TrainSettings, resume: bool = False) -> SAC:
    sac, judge = learner(), Pendulum(8)
    train(
        sac,
        Collector(Pendulum(16)),
        lambda policy: evaluate(judge, policy, 1000, LIMIT),
        settings,
        MANIFEST,
        folder,
        say=lambda line: None,
        resume=resume,
        demonstrations=demonstrations(),
    )
    return sac


def test_a_resumed_run_still_has_its_demonstrations(tmp_path):
    """Interrupted and resumed, a run with demonstrations has the weights of the one that went through."""
    settings = TrainSettings(
        steps=1024, warmup=256, rollout=4, evaluate_every=1024, checkpoint_every=512, buffer=4096, updates_per_step=0.1
    )
    whole = run(tmp_path / "whole", settings)
    run(tmp_path / "parts", dataclasses.replace(settings, steps=512))
    parts = run(tmp_path / "parts", settings, resume=True)
    assert whole.updates == parts.updates > 50
    for first, second in zip(whole.actor.parameters(), parts.actor.parameters(), strict=True):
        assert torch.equal(first, second)


def test_imitation_draws_the_policy_to_the_answers():
    """With a heavy weight on imitation the policy ends near the answers; without, the critics lead it elsewhere."""
    g = torch.Generator().manual_seed(3)
    batch = Batch(torch.randn(64, 3, generator=g), torch.rand(64, 2, generator=g), *torch.zeros(2, 64), seen(64))
    answers = (seen(64), torch.full((64, 2), -0.6))
    left = {}
    for weight in (0.0, 100.0):
        sac = learner()
        for _ in range(300):
            sac.update(batch, answers, weight)
        left[weight] = float((sac.act(seen(64), 0.0) + 0.6).abs().mean())
    assert left[100.0] < 0.1 < left[0.0]


def test_the_weight_of_imitation_falls_to_nothing():
    """Half of it is left half-way, and nothing beyond the end."""
    assert [SETTINGS.imitation_after(updates) for updates in (0, 500, 1000, 5000)] == [5.0, 2.5, 0.0, 0.0]


def test_impossible_settings_are_refused():
    """Settings that cannot be are refused by name."""
    with pytest.raises(ValueError, match="rounds must be at least 1"):
        DemonstrationSettings(rounds=0)
    with pytest.raises(ValueError, match="share"):
        DemonstrationSettings(share=1.0)
