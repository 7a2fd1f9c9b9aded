"""The training loop on a real, small environment."""

import dataclasses
import os
import signal
import threading
import time
from pathlib import Path

import pytest
import torch
from train_pendulum import LIMIT, MANIFEST, Pendulum

from op3.envs import make_env
from op3.policy import ActionMap, Manifest, PolicyBundle
from op3.tasks import find_task
from op3.train import SAC, Batch, Collector, Explorer, Progress, SACSettings, TrainSettings, evaluate, train
from op3.train.checkpoint import stop_requested

SAC_SETTINGS = SACSettings(hidden=(32, 32), batch=64, initial_std=0.5, actor_rate=1e-3, critic_rate=1e-3, discount=0.95)
SETTINGS = TrainSettings(
    steps=4000, warmup=512, rollout=4, updates_per_step=0.25, evaluate_every=2000, checkpoint_every=2000, log_every=1000
)


def run(
    folder: Path, settings: TrainSettings = SETTINGS, resume: bool = False, seed: int = 0, **options
) -> tuple[SAC, Progress]:
    sac = SAC(3, 2, SAC_SETTINGS, torch.Generator().manual_seed(seed))
    collector, judge = Collector(Pendulum(16)), Pendulum(32)
    progress = train(
        sac,
        collector,
        lambda policy: evaluate(judge, policy, 1000, LIMIT),
        dataclasses.replace(settings, seed=seed),
        MANIFEST,
        folder,
        say=options.pop("say", lambda line: None),
        resume=resume,
        **options,
    )
    return sac, progress


def same(first: SAC, second: SAC) -> bool:
    pairs = zip(first.actor.parameters(), second.actor.parameters(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs) and torch.equal(first.normaliser.mean, second.normaliser.mean)


def test_a_pendulum_learns_to_lean(tmp_path):
    """Trained for 20,000 steps, the policy stays within 0.1 rad of the angle asked for, from several times that."""
    judge = Pendulum(32)
    untrained = SAC(3, 2, SAC_SETTINGS, torch.Generator().manual_seed(0))
    before = evaluate(judge, lambda observation: untrained.act(observation, 0.0), 7, LIMIT)
    settings = dataclasses.replace(SETTINGS, steps=16_000, updates_per_step=0.125)
    run(tmp_path, settings)
    after = evaluate(judge, PolicyBundle.load(tmp_path / "policy").act, 7, LIMIT)
    # the reward is 1 - error / 0.5 rad; untrained, the target is 0 and the angles asked for are +-0.5 rad
    assert before["return"] < 0.7 * LIMIT
    assert after["return"] > 0.8 * LIMIT
    assert after["upright"] == 1.0


def test_same_seed_same_run(tmp_path):
    """Two runs of one seed have the same weights to the last bit after 1000 steps; another seed has others."""
    settings = dataclasses.replace(SETTINGS, steps=1024, warmup=256)
    first, second = (run(tmp_path / name, settings)[0] for name in "ab")
    other, _ = run(tmp_path / "c", settings, seed=1)
    assert first.updates > 100
    assert same(first, second)
    assert not same(first, other)


def test_resumed_run_equals_the_one_without_interruption(tmp_path):
    """A run ended at its checkpoint and resumed has the weights, history and policy of the run that went through."""
    whole, progress = run(tmp_path / "whole")
    run(tmp_path / "parts", dataclasses.replace(SETTINGS, steps=2048, checkpoint_every=2000))
    resumed, again = run(tmp_path / "parts", resume=True)
    assert same(whole, resumed)
    numbers = [[_measured(entry) for entry in p.history if entry["steps"] > 2048] for p in (progress, again)]
    assert numbers[0] == numbers[1]
    observation = torch.randn(4, 3, generator=torch.Generator().manual_seed(0))
    acts = [PolicyBundle.load(tmp_path / name / "policy").act(observation) for name in ("whole", "parts")]
    assert torch.equal(*acts)


def test_overlap_changes_nothing_but_the_time(tmp_path):
    """Updates during the next rollout or after it leave the same weights to the last bit."""
    short = dataclasses.replace(SETTINGS, steps=2048, warmup=256)
    first, second = (
        run(tmp_path / name, dataclasses.replace(short, overlap=overlap))[0]
        for name, overlap in (("a", True), ("b", False))
    )
    assert first.updates > 300
    assert same(first, second)


@pytest.mark.slow
def test_a_resumed_walk_takes_the_steps_of_the_one_without_interruption(tmp_path):
    """On walking OP3s too: killed at a checkpoint and resumed, weights and measures agree to the last bit."""
    task, action_map = find_task("walk"), ActionMap.around_stand()
    size = task.observation_size
    manifest = Manifest("walk", task.layout, task.history, action_map, (32, 32))
    settings = TrainSettings(
        steps=96, warmup=32, rollout=4, updates_per_step=0.5, evaluate_every=96, checkpoint_every=48, log_every=16
    )

    def walk(folder: Path, steps: int, resume: bool = False) -> tuple[SAC, Progress]:
        stand = torch.as_tensor(action_map.stand(5.5))
        sac = SAC(size, 20, dataclasses.replace(SAC_SETTINGS, initial_std=0.2), generator(), stand)
        env, judge = (make_env(task, "paper", 4, action_map=action_map) for _ in range(2))
        progress = train(
            sac,
            Collector(env),
            lambda policy: evaluate(judge, policy, 1000, 20),
            dataclasses.replace(settings, steps=steps),
            manifest,
            folder,
            say=lambda line: None,
            resume=resume,
        )
        return sac, progress

    whole, progress = walk(tmp_path / "whole", 96)
    walk(tmp_path / "parts", 48)
    resumed, again = walk(tmp_path / "parts", 96, resume=True)
    assert whole.updates == resumed.updates > 20
    assert same(whole, resumed)
    late = [[_measured(e) for e in p.history if e["steps"] > 48] for p in (progress, again)]
    assert late[0] == late[1] != []


def _measured(entry: dict[str, float]) -> dict[str, float]:
    """An entry of the history without the speed of the machine."""
    return {name: value for name, value in entry.items() if not name.startswith("speed/")}


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_without_the_buffer_a_resumed_run_fills_a_new_one_first(tmp_path):
    """Without the stored buffer there are no updates before `warmup` new steps, and no burst afterwards."""
    settings = dataclasses.replace(SETTINGS, steps=2048, checkpoint_buffer=False)
    first, _ = run(tmp_path, settings)
    resumed, _ = run(tmp_path, dataclasses.replace(settings, steps=2048 + 448), resume=True)
    assert resumed.updates == first.updates
    resumed, _ = run(tmp_path, dataclasses.replace(settings, steps=2048 + 448 + 1024), resume=True)
    assert resumed.updates - first.updates == pytest.approx((1024 - 512) * 0.25, abs=17)


def test_sigterm_leaves_a_checkpoint_to_resume_from(tmp_path):
    """SIGTERM ends the run at the next rollout with a checkpoint, from which it goes on."""
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGTERM))
    timer.start()
    _, progress = run(tmp_path, dataclasses.replace(SETTINGS, steps=10_000_000))
    timer.join()
    assert progress.stopped
    assert 0 < progress.steps < 10_000_000
    _, again = run(tmp_path, dataclasses.replace(SETTINGS, steps=progress.steps + 64), resume=True)
    assert again.steps == progress.steps + 64
    assert not again.stopped


def test_broken_checkpoints_are_refused(tmp_path):
    """Resuming without a checkpoint, from a torn one, or with other networks ends with one sentence."""
    with pytest.raises(FileNotFoundError, match="no checkpoint there"):
        run(tmp_path, resume=True)
    settings = dataclasses.replace(SETTINGS, steps=256)
    run(tmp_path, settings)
    sac = SAC(3, 2, dataclasses.replace(SAC_SETTINGS, hidden=(16, 16)), torch.Generator().manual_seed(0))
    manifest = dataclasses.replace(MANIFEST, hidden=(16, 16))
    with pytest.raises(ValueError, match="resume with the settings it had"):
        train(sac, Collector(Pendulum(16)), lambda policy: {}, settings, manifest, tmp_path, resume=True)
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match="not a checkpoint"):
        run(tmp_path, settings, resume=True)


def test_a_run_does_not_go_on_as_another(tmp_path):
    """Another span, task, model or seed, which no tensor's shape would tell, is refused by name."""
    settings = dataclasses.replace(SETTINGS, steps=256)
    run(tmp_path, settings)
    wider = ActionMap(MANIFEST.action_map.joints, (-0.2,), (1.5,))
    trained = dataclasses.replace(MANIFEST.training, model_hash="another")
    for manifest, field in (
        (dataclasses.replace(MANIFEST, action_map=wider), "span"),
        (dataclasses.replace(MANIFEST, task="walk"), "task"),
        (dataclasses.replace(MANIFEST, training=trained), "model"),
    ):
        sac = SAC(3, 2, SAC_SETTINGS, generator())
        with pytest.raises(ValueError, match=f"another {field}; resume with the overrides it had"):
            train(sac, Collector(Pendulum(16)), lambda policy: {}, settings, manifest, tmp_path, resume=True)
    with pytest.raises(ValueError, match="another seed"):
        run(tmp_path, settings, resume=True, seed=3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TrainSettings(rollout=2.5), "rollout must be a whole number, got 2.5"),
        (lambda: TrainSettings(steps="many"), "steps must be a whole number, got 'many'"),
        (lambda: TrainSettings(seed=-1), "seed must be at least 0"),
        (lambda: TrainSettings(noise="loud"), "noise must be a number, got 'loud'"),
        (lambda: TrainSettings(updates_per_step=float("nan")), "updates_per_step must be a finite number, got nan"),
        (lambda: SACSettings(batch=10.5), "batch must be a whole number, got 10.5"),
        (lambda: SACSettings(hidden=256), "hidden must be a list, got 256"),
        (lambda: SACSettings(discount="high"), "discount must be a number"),
    ],
)
def test_settings_name_what_is_wrong(make, message):
    """Words and fractions where whole numbers belong are refused by the name of the field."""
    with pytest.raises(ValueError, match=message):
        make()


def test_a_million_may_be_written_in_short():
    """YAML reads 1e6 as a float; it is the whole number all the same."""
    settings = TrainSettings(steps=1e6, buffer=1e5)
    assert (settings.steps, settings.buffer) == (1_000_000, 100_000)
    assert isinstance(settings.buffer, int)


def test_a_resumed_run_says_what_changed(tmp_path):
    """Settings that a run may change are named with both values when it goes on."""
    lines, settings = [], dataclasses.replace(SETTINGS, steps=256)

    def trained(noise, **options):
        training = dataclasses.replace(MANIFEST.training, settings={"train": {"noise": noise}})
        sac = SAC(3, 2, SAC_SETTINGS, generator())
        manifest = dataclasses.replace(MANIFEST, training=training)
        train(sac, Collector(Pendulum(16)), lambda policy: {}, settings, manifest, tmp_path, **options)

    trained(1.0)
    trained(2.0, resume=True, say=lines.append)
    assert "resumed with train.noise=2.0, which was 1.0" in lines


def test_progress_lines_and_measures(tmp_path):
    """Progress lines say steps per second and the time left; the log gets reward, losses and gains by name."""
    lines, logged = [], {}
    run(tmp_path, say=lines.append, log=lambda measures, step: logged.update(measures))
    assert any("/s" in line and "left" in line for line in lines)
    assert any("evaluation" in line and "upright" in line for line in lines)
    assert {"reward", "action/gain", "update/critic_loss", "speed/updates", "evaluation/return"} <= set(logged)


def test_bold_environments_explore_more_during_the_warm_up():
    """Exploration grows from the policy's own deviation in the first environment to ten times it in the last."""
    sac = SAC(3, 2, dataclasses.replace(SAC_SETTINGS, initial_std=0.02), torch.Generator().manual_seed(0))
    policy = Explorer(sac, 3, seed=0)
    policy.follow(boldest=10.0)
    observation = torch.zeros(3, 3)
    actions = torch.stack([policy(observation) for _ in range(500)])
    assert actions.std((0, 2)).tolist() == pytest.approx([0.02, 0.02 * 10**0.5, 0.2], rel=0.15)


def test_the_policy_waits_for_the_critics():
    """Before `actor_after` updates the policy keeps its weights, afterwards it moves."""
    sac = SAC(3, 2, dataclasses.replace(SAC_SETTINGS, actor_after=2), torch.Generator().manual_seed(0))
    before = [parameter.clone() for parameter in sac.actor.parameters()]
    batch = Batch(torch.zeros(8, 3), torch.zeros(8, 2), torch.ones(8), torch.zeros(8), torch.zeros(8, 3))
    moved = []
    for _ in range(3):
        sac.update(batch)
        moved.append(any(not torch.equal(a, b) for a, b in zip(before, sac.actor.parameters(), strict=True)))
    assert moved == [False, False, True]


def test_time_limits_bootstrap_and_terminations_do_not():
    """The collector tells a time limit (done, not terminated) from a fall (terminated)."""
    collector = Collector(Pendulum(16))
    collector.restart(0)
    rollout, episodes = collector.collect(lambda observation: torch.zeros(16, 2), 2 * LIMIT)
    ended = rollout["done"]
    assert int(ended.sum()) == len(episodes.returns) > 0
    late = rollout["done"] & ~rollout["terminated"]
    assert bool(late.any())
    # the observation after the last step is the episode's own, and the next row begins a new episode
    step, row = (int(i) for i in late[:-1].nonzero()[0])
    assert not torch.equal(rollout["next_observation"][step, row], rollout["observation"][step + 1, row])


def test_checkpoints_survive_a_kill_while_writing(tmp_path):
    """A leftover of a killed write does not disturb; the checkpoint stays whole."""
    settings = dataclasses.replace(SETTINGS, steps=256)
    run(tmp_path, settings)
    (tmp_path / ".checkpoint.pt.1.tmp").write_bytes(b"torn")
    started = time.monotonic()
    _, progress = run(tmp_path, dataclasses.replace(settings, steps=320), resume=True)
    assert progress.steps == 320
    assert progress.seconds < 60 + time.monotonic() - started


def test_a_second_sigterm_does_not_interrupt():
    """It may come while a checkpoint is written; a second Ctrl-C is somebody who will not wait."""
    with stop_requested() as event:
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        assert event.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
