"""The training loop on a real, small environment."""

import dataclasses
import os
import signal
import threading
import time
from pathlib import Path

import pytest
import torch
from torchrl.data import Composite, Unbounded
from train_pendulum import LIMIT, MANIFEST, Pendulum

from op3.envs import make_env
from op3.policy import ActionMap, Manifest, PolicyBundle
from op3.robot import load_robot
from op3.tasks import find_task
from op3.train import PPO, SAC, TD3, Algorithm, Curriculum, Progress, TrainSettings, evaluate, train
from op3.train.checkpoint import stop_requested

LEARN = {
    "hidden": (32, 32),
    "batch": 64,
    "initial_std": 0.5,
    "actor_rate": 1e-3,
    "critic_rate": 1e-3,
    "discount": 0.95,
    "warmup": 512,
    "rollout": 4,
    "updates_per_step": 0.25,
}
SETTINGS = TrainSettings(steps=2048, evaluate_every=1000, checkpoint_every=1000, log_every=500)


def run(
    folder: Path,
    settings: TrainSettings = SETTINGS,
    resume: bool = False,
    seed: int = 0,
    kind: type[Algorithm] = SAC,
    learn: dict | None = None,
    **options,
) -> tuple[Algorithm, Progress]:
    env, judge = Pendulum(16), Pendulum(32)
    algorithm = kind(env, seed=seed, **(LEARN if learn is None else learn))
    progress = train(
        algorithm,
        env,
        lambda policy: evaluate(judge, policy, 1000, LIMIT),
        dataclasses.replace(settings, seed=seed),
        options.pop("manifest", MANIFEST),
        folder,
        say=options.pop("say", lambda line: None),
        resume=resume,
        **options,
    )
    return algorithm, progress


def same(first: Algorithm, second: Algorithm) -> bool:
    states = first.state_dict(), second.state_dict()
    pairs = [(states[0][name], states[1][name]) for name in states[0] if not name.endswith("_extra_state")]
    return all(torch.equal(*pair) for pair in pairs)


PPO_LEARN = {"hidden": (32, 32), "batch": 256, "rollout": 32, "rate": 1e-3, "initial_std": 0.5, "discount": 0.95}


@pytest.mark.parametrize(
    ("kind", "learn", "steps"),
    [
        (SAC, {**LEARN, "updates_per_step": 0.125}, 8_000),
        (TD3, {**LEARN, "updates_per_step": 0.125, "initial_std": 0.3, "actor_every": 2}, 8_000),
        (PPO, PPO_LEARN, 16_000),
    ],
)
def test_a_pendulum_learns_to_lean(tmp_path, kind, learn, steps):
    """The policy stays within 0.1 rad of the angle asked for, from several times that, with each algorithm."""
    judge = Pendulum(32)
    before = evaluate(judge, kind(judge, **learn).act, 7, LIMIT)
    run(tmp_path, dataclasses.replace(SETTINGS, steps=steps), kind=kind, learn=learn)
    after = evaluate(judge, PolicyBundle.load(tmp_path / "policy").act, 7, LIMIT)
    # the reward is 1 - error / 0.5 rad; untrained, the target is 0 and the angles asked for are +-0.5 rad
    assert before["return"] < 0.7 * LIMIT
    assert after["return"] > 0.8 * LIMIT
    assert after["upright"] == 1.0


def test_same_seed_same_run(tmp_path):
    """Two runs of one seed have the same weights to the last bit after 1000 steps; another seed has others."""
    settings, learn = dataclasses.replace(SETTINGS, steps=1024), {**LEARN, "warmup": 256}
    first, second = (run(tmp_path / name, settings, learn=learn)[0] for name in "ab")
    other, _ = run(tmp_path / "c", settings, learn=learn, seed=1)
    assert first.updates > 100
    assert same(first, second)
    assert not same(first, other)


@pytest.mark.parametrize(("kind", "learn"), [(SAC, LEARN), (TD3, LEARN), (PPO, PPO_LEARN)])
def test_resumed_run_equals_the_one_without_interruption(tmp_path, kind, learn):
    """A run ended at its checkpoint and resumed has the weights, history and policy of the run that went through."""
    whole, progress = run(tmp_path / "whole", kind=kind, learn=learn)
    run(tmp_path / "parts", dataclasses.replace(SETTINGS, steps=1024), kind=kind, learn=learn)
    resumed, again = run(tmp_path / "parts", resume=True, kind=kind, learn=learn)
    assert same(whole, resumed)
    numbers = [[_measured(entry) for entry in p.history if entry["steps"] > 1024] for p in (progress, again)]
    assert numbers[0] == numbers[1]
    observation = torch.randn(4, 3, generator=torch.Generator().manual_seed(0))
    acts = [PolicyBundle.load(tmp_path / name / "policy").act(observation) for name in ("whole", "parts")]
    assert torch.equal(*acts)


def test_overlap_changes_nothing_but_the_time(tmp_path):
    """Updates during the next rollout or after it leave the same weights to the last bit."""
    short, learn = dataclasses.replace(SETTINGS, steps=1024), {**LEARN, "warmup": 256}
    first, second = (
        run(tmp_path / name, dataclasses.replace(short, overlap=overlap), learn=learn)[0]
        for name, overlap in (("a", True), ("b", False))
    )
    assert first.updates > 150
    assert same(first, second)


@pytest.mark.slow
def test_a_resumed_walk_takes_the_steps_of_the_one_without_interruption(tmp_path):
    """On walking OP3s too: killed at a checkpoint and resumed, weights and measures agree to the last bit."""
    task, action_map = find_task("walk"), ActionMap.around_stand(load_robot("op3"))
    manifest = Manifest("walk", task.layout, task.history, action_map, (32, 32))
    settings = TrainSettings(steps=96, evaluate_every=96, checkpoint_every=48, log_every=16)
    learn = {**LEARN, "initial_std": 0.2, "warmup": 32, "updates_per_step": 0.5}

    def walk(folder: Path, steps: int, resume: bool = False) -> tuple[Algorithm, Progress]:
        env, judge = (make_env(task, "paper", 4, action_map=action_map) for _ in range(2))
        sac = SAC(env, initial_action=torch.as_tensor(action_map.stand(5.5)), **learn)
        progress = train(
            sac,
            env,
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


def test_without_the_buffer_a_resumed_run_fills_a_new_one_first(tmp_path):
    """Without the stored buffer there are no updates before `warmup` new steps, and no burst afterwards."""
    learn = {**LEARN, "checkpoint_buffer": False}

    def until(steps: int, resume: bool) -> Algorithm:
        return run(tmp_path, dataclasses.replace(SETTINGS, steps=steps), resume, learn=learn)[0]

    first = until(1024, resume=False)
    resumed = until(1024 + 448, resume=True)
    assert resumed.updates == first.updates
    resumed = until(1024 + 448 + 1024, resume=True)
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
    with pytest.raises(FileNotFoundError, match="there is no checkpoint"):
        run(tmp_path, resume=True)
    settings = dataclasses.replace(SETTINGS, steps=256)
    run(tmp_path, settings)
    with pytest.raises(ValueError, match="resume with its original settings"):
        run(tmp_path, settings, resume=True, learn={**LEARN, "hidden": (16, 16)})
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"checkpoint.pt: truncated, or not a checkpoint"):
        run(tmp_path, settings, resume=True)


def test_a_run_is_not_written_over(tmp_path):
    """Training in a folder that has a checkpoint is refused, and leaves it as it is."""
    settings = dataclasses.replace(SETTINGS, steps=256)
    run(tmp_path, settings)
    before = (tmp_path / "checkpoint.pt").read_bytes()
    with pytest.raises(ValueError, match=r"continue with resume=.*, or choose another folder"):
        run(tmp_path, settings)
    assert (tmp_path / "checkpoint.pt").read_bytes() == before


def test_a_run_does_not_go_on_as_another(tmp_path):
    """Another span, task, model, seed or algorithm, which no tensor's shape would tell, is refused by name."""
    settings = dataclasses.replace(SETTINGS, steps=256)
    run(tmp_path, settings)
    wider = ActionMap(MANIFEST.action_map.joints, (-0.2,), (1.5,))
    trained = dataclasses.replace(MANIFEST.training, model_hash="another")
    for manifest, field in (
        (dataclasses.replace(MANIFEST, action_map=wider), "span"),
        (dataclasses.replace(MANIFEST, task="walk"), "task"),
        (dataclasses.replace(MANIFEST, training=trained), "model"),
    ):
        with pytest.raises(ValueError, match=f"different {field}; resume with its overrides"):
            run(tmp_path, settings, resume=True, manifest=manifest)
    with pytest.raises(ValueError, match="different seed"):
        run(tmp_path, settings, resume=True, seed=3)
    with pytest.raises(ValueError, match="different algorithm"):
        run(tmp_path, settings, resume=True, kind=TD3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TrainSettings(steps="many"), "steps must be a whole number, got 'many'"),
        (lambda: TrainSettings(seed=-1), "seed must be at least 0"),
        (lambda: Curriculum({"height": [[0, 1], 2]}), "curricula.height.1 must be a list, got 2"),
        (lambda: Curriculum({"height": [[9, 1.0], [3, 2.0]]}), "lists pairs of steps and value, with increasing steps"),
    ],
)
def test_settings_name_what_is_wrong(make, message):
    """Words and fractions where whole numbers belong are refused by the name of the field."""
    with pytest.raises(ValueError, match=message):
        make()


def test_a_million_may_be_written_in_short():
    """YAML reads 1e6 as a float; it is the whole number all the same."""
    settings = TrainSettings(steps=1e6)
    assert settings.steps == 1_000_000
    assert isinstance(settings.steps, int)


def test_a_resumed_run_says_what_changed(tmp_path):
    """Settings that a run may change are named with both values when it goes on."""
    lines, settings = [], dataclasses.replace(SETTINGS, steps=256)
    run(tmp_path, settings, config={"algorithm": {"noise": 1.0}})
    run(tmp_path, settings, config={"algorithm": {"noise": 2.0}}, resume=True, say=lines.append)
    assert "resumed with algorithm.noise=2.0, was 1.0" in lines


def test_progress_lines_and_measures(tmp_path):
    """Progress lines say steps per second and the time left; the log gets reward, losses and gains by name."""
    lines, logged = [], {}
    run(tmp_path, say=lines.append, log=lambda measures, step: logged.update(measures))
    assert any("/s" in line and "left" in line for line in lines)
    assert any("evaluation" in line and "upright" in line for line in lines)
    assert {"reward", "action/spread", "update/critic_loss", "speed/updates", "evaluation/return"} <= set(logged)


def test_curricula_reach_the_environment(tmp_path):
    """Numbers follow their schedules, with straight lines between, and the environment has them before it begins."""

    class Practising(Pendulum):
        given: list[float]

        def set_terms(self, height: float) -> None:
            self.given.append(height)

    env = Practising(16)
    env.given = []
    schedule = Curriculum({"height": [[0, 1.0], [256, 2.0]]})
    settings = dataclasses.replace(SETTINGS, steps=256)
    train(SAC(env, **LEARN), env, lambda policy: {}, settings, MANIFEST, tmp_path, curriculum=schedule)
    # before the first reset, before each of the four rollouts of 64 steps, and when episodes start over at the end
    assert env.given == [1.0, 1.0, 1.25, 1.5, 1.75, 2.0]


def test_measures_of_an_environment_are_logged(tmp_path):
    """The means of `reward_terms` and `measure`, and the returns and lengths of episodes over several rollouts."""

    class Measured(Pendulum):
        def __init__(self, count: int):
            super().__init__(count)
            kinds = {"reward_terms": {"lean": 0.25}, "measure": {"force": 3.0}}
            self.numbers = {kind: {k: torch.full((count, 1), v) for k, v in e.items()} for kind, e in kinds.items()}
            for kind, entries in self.numbers.items():
                specs = {name: Unbounded((count, 1)) for name in entries}
                self.observation_spec[kind] = Composite(specs, shape=(count,))

        def _reset(self, *args, **kwargs):
            return super()._reset(*args, **kwargs).update(self.numbers)

        def _step(self, *args):
            return super()._step(*args).update(self.numbers)

    history, env = [], Measured(16)
    settings = dataclasses.replace(SETTINGS, steps=16 * LIMIT, log_every=16 * LIMIT)
    learn = {**LEARN, "warmup": 10_000, "initial_std": 0.01}
    train(SAC(env, **learn), env, lambda policy: {}, settings, MANIFEST, tmp_path, log=lambda m, _: history.append(m))
    measures = history[0]
    assert measures["reward_terms/lean"] == pytest.approx(0.25)
    assert measures["measure/force"] == pytest.approx(3.0)
    assert measures["episode/length"] == LIMIT  # of 15 rollouts
    assert measures["episode/terminated"] == 0.0
    # every episode ends with the last step, so that the mean return is the mean reward of LIMIT steps
    assert measures["episode/return"] == pytest.approx(LIMIT * measures["reward"], rel=1e-4)


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
