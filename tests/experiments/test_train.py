"""The training and evaluation scripts, at budgets of seconds."""

import dataclasses
import re
from importlib import import_module
from pathlib import Path

import pytest
from hydra.utils import instantiate

from op3.apps.command_result import CommandResult
from op3.apps.compose import composed, configured
from op3.apps.job import one_sentence
from op3.apps.sentences import as_sentence
from op3.policy import PolicyBundle
from op3.report import read_result
from op3.rollout import Rollout
from op3.train import PPOSettings, SACSettings, TD3Settings, TrainSettings
from tests.scripts import run_script

ROOT = Path(__file__).resolve().parents[2]
TINY = [
    "budget=demo",
    "environments=4",
    "threads=1",
    "algorithm.hidden=[16,16]",
    "algorithm.batch=32",
    "train.steps=320",
    "algorithm.warmup=128",
    "train.log_every=64",
    "train.evaluate_every=160",
    "evaluation.episodes=2",
    "evaluation.video=false",
    "wandb=disabled",
]

ARM = """<mujoco><compiler angle="radian"/><worldbody><body name="base"><geom size="0.03"/>
<body name="upper" pos="0 0 0.05"><joint name="shoulder" axis="0 1 0"/><geom size="0.03" pos="0 0 0.05" mass="0.1"/>
<body name="lower" pos="0 0 0.12"><joint name="elbow" axis="0 1 0"/><geom size="0.03" pos="0 0 0.05" mass="0.1"/>
<site name="tip" pos="0 0 0.12"/></body></body></body></worldbody></mujoco>"""


def in_process(name: str, overrides: list[str], folder: Path) -> CommandResult:
    """A command's run in this process, which spares the seconds that a new one takes to import."""
    with configured(name, overrides=overrides, folder=folder) as cfg:
        return import_module(f"op3.apps.{name}").main(cfg)


@pytest.mark.slow
def test_a_policy_is_trained_resumed_and_judged(tmp_path):
    """Training writes bundle, checkpoint, page and numbers; it resumes; the bundle is judged with logs and numbers."""
    run = tmp_path / "run"
    done = run_script("train.py", *TINY, f"hydra.run.dir={run}")
    assert done.returncode == 0, done.stderr
    assert "left" in done.stdout
    manifest = PolicyBundle.load(run / "policy").manifest
    assert manifest.task == "balance"
    assert manifest.training.command.startswith("op3 train ")
    assert (run / "checkpoint.pt").is_file()
    assert (run / "index.html").is_file()
    assert read_result(run / "result.yaml")["steps"] >= 320

    done = run_script("train.py", f"resume={run}", f"hydra.run.dir={tmp_path / 'again'}")
    assert "continues in its own folder; remove hydra.run.dir" in done.stderr
    assert not (tmp_path / "again").exists()
    done = run_script("train.py", *TINY, f"hydra.run.dir={run}")
    assert f"continue with resume={run}, or choose another folder" in done.stderr
    done = run_script("train.py", "task=walk", f"resume={run}")
    assert f"task=walk: the run in {run} has task=balance; omit this override" in done.stderr

    # with the settings it had, but for what is given now
    done = run_script("train.py", "train.steps=640", f"resume={run}")
    assert done.returncode == 0, done.stderr
    assert "resumed with train.steps=640, was 320" in done.stdout
    assert read_result(run / "result.yaml")["steps"] >= 640
    assert PolicyBundle.load(run / "policy").manifest.hidden == (16, 16)
    (run / "checkpoint.pt").write_bytes((run / "checkpoint.pt").read_bytes()[:5000])
    done = run_script("train.py", f"resume={run}")
    assert "checkpoint.pt: truncated, or not a checkpoint" in done.stderr
    assert "Traceback" not in done.stderr

    judged = tmp_path / "judged"
    options = ["episodes=2", "threads=1", "video=false", "task=balance_eval", f"hydra.run.dir={judged}"]
    done = run_script("evaluate.py", f"policy={run / 'policy'}", *options)
    assert done.returncode == 0, done.stderr
    numbers = read_result(judged / "result.yaml")
    assert numbers["evaluation.episodes"] == 2
    assert 0 <= numbers["evaluation.upright"] <= 1
    log = Rollout.load(judged / "logs" / "001")
    assert log.metadata.extra["task"] == "balance_eval"


@pytest.mark.slow
def test_wrong_input_ends_with_one_sentence(tmp_path):
    """A missing bundle, a bundle of another task's size and a GPU that is not there end with one sentence."""
    cases = [
        ("evaluate.py", ["policy=nowhere"], "no such folder; give the folder of a policy bundle, hold, zero, random"),
        ("train.py", [*TINY, "task=fly"], "there is no 'fly' in the group task"),
        ("train.py", [*TINY, "algorithm.n_step=0"], "n_step must be at least 1, got 0"),
    ]
    for name, overrides, message in cases:
        done = run_script(name, *overrides, f"hydra.run.dir={tmp_path / 'out'}")
        assert done.returncode != 0
        assert message in done.stderr
        assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["device=gpu"], "device=gpu: give cpu or cuda"),
        (["algorithm.mirrored=2"], "mirrored must be at most 1, got 2"),
        (["train.steps=many"], "steps must be a whole number, got 'many'"),
        (["seed=1.5"], "seed must be a whole number, got 1.5"),
        (["environments=0"], "environments must be at least 1, got 0"),
        (["evaluation.episodes=0"], "evaluation.episodes must be an integer"),
        (["+environment.foo=1"], "the batched environment has no option 'foo'; it has"),
        (["algorithm._target_=op3.train.Sarsa"], "algorithm._target_: op3.train has no 'Sarsa'"),
        (["+algorithm.gama=0.9"], "gama is not a field"),
        (["env=gym"], "unknown backend 'gym'"),
        (["env=composer", "environments=2"], "set environments=1"),
        (["task.duration=-1"], "duration must be above 0"),
    ],
)
def test_settings_that_cannot_be_end_with_one_sentence(overrides, message, tmp_path):
    """The sentence names the setting, and there is no more than it."""
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        in_process("train", [*TINY, "wandb=offline", *overrides], tmp_path)
    assert not (tmp_path / "wandb").exists()
    assert len(as_sentence(error.value).splitlines()) == 1


def test_a_baseline_that_is_not_there_is_refused_before_the_episodes(tmp_path):
    """No episode of the policy is played for nothing."""
    with pytest.raises(FileNotFoundError, match=r"^baseline=nobody: no such folder"):
        in_process("evaluate", ["policy=hold", "baseline=nobody"], tmp_path)
    assert not list(tmp_path.glob("*.html"))


def test_ctrl_c_says_how_a_training_goes_on(capsys):
    """Training goes on with `resume`, and not as sweeps do."""
    with pytest.raises(SystemExit) as end, one_sentence("op3.apps.train"):
        raise KeyboardInterrupt
    assert end.value.code == 130
    assert "resume=<folder of the run>" in capsys.readouterr().err


def test_a_fixed_gain_holds_for_a_policy_that_begins_with_another():
    cfg = composed("train", ["fixed_gain=2", "warm_start=assets/policies/balance"])
    made = import_module("op3.apps.train").actions(cfg, instantiate(cfg.task))
    start = PolicyBundle.load(ROOT / "assets/policies/balance").manifest.action_map
    assert made.gain_low == made.gain_high == 2.0
    assert made.position_low == start.position_low


def test_an_arm_of_current_driven_servos_reaches_with_a_fixed_gain(tmp_path):
    """A task without gains gets them, all alike; the policy is saved and judged like any other."""
    (tmp_path / "arm.xml").write_text(ARM)
    robot = tmp_path / "arm.yaml"
    head = "format: op3-robot/1\nname: own\nmodel: arm.xml\nbase: base\nfixed: true\ntip: tip\nservo: xm430-w350\n"
    robot.write_text(
        head + "joints:\n  shoulder: {limits: [-1.4, 1.4], home: 0.5}\n  elbow: {limits: [-1.4, 1.4], home: 0.5}\n"
    )
    trained = in_process("train", ["task=reach", f"robot={robot}", "fixed_gain=1.5", *TINY], tmp_path / "train")
    policy = tmp_path / "train" / "policy"
    assert trained.folder == policy.parent
    overrides = [f"policy={policy}", "task=reach", f"robot={robot}", "episodes=1", "video=false", "wandb=disabled"]
    judged = in_process("evaluate", overrides, tmp_path / "evaluate")
    assert judged.numbers["evaluation.gain"] == pytest.approx(1.5)


@pytest.mark.parametrize("task", ["balance", "walk", "walk_terrain", "walk_command"])
def test_the_papers_budget_is_for_every_task(task):
    """Two layers of 256 and a million steps for balancing, of 1024 and three million for walking on whatever ground."""
    cfg = composed("train", [f"task={task}", "budget=paper"])
    units, steps = (256, 1_000_000) if task == "balance" else (1024, 3_000_000)
    assert list(cfg.algorithm.hidden) == [units, units]
    assert cfg.train.steps == steps
    assert cfg.algorithm.updates_per_step == 1


def test_the_config_has_every_setting():
    """Settings of the learner, the loop and the curricula can all be overridden without a plus sign."""
    assert set(composed("train", []).train) == {field.name for field in dataclasses.fields(TrainSettings)}
    for name, kind in (("sac", SACSettings), ("td3", TD3Settings), ("ppo", PPOSettings)):
        chosen = set(composed("train", [f"algorithm={name}"]).algorithm) - {"_target_"}
        assert chosen == {field.name for field in dataclasses.fields(kind)}


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["joint=head_pan"], "joint=head_pan: choose l_hip_roll"),
        (["hold_gain=20"], "hold_gain must be at most 6, got 20"),
        (["seed=-1"], "seed must be at least 0, got -1"),
        (["baseline=nothing"], "baseline=nothing: no such folder"),
    ],
)
def test_evaluations_that_cannot_be_end_with_one_sentence(overrides, message, tmp_path):
    """The sentence names the setting."""
    options = ["policy=hold", "task.duration=0.1", "episodes=1", "threads=1", "video=false", "logs=false"]
    with pytest.raises((ValueError, FileNotFoundError), match=re.escape(message)):
        in_process("evaluate", [*options, *overrides], tmp_path)


def test_a_baseline_is_judged_on_the_same_episodes(tmp_path):
    """Against itself the hold has no margin; against random actions it has one, with an interval, in page and file."""
    options = ["policy=hold", "task.duration=1.5", "episodes=3", "threads=1", "video=false", "logs=false"]
    same = in_process("evaluate", [*options, "baseline=hold"], tmp_path / "same").numbers
    assert same["evaluation.margin"] == 0.0
    assert same["evaluation.margin_interval"] == [0.0, 0.0]
    other = in_process("evaluate", [*options, "baseline=random"], tmp_path / "other").numbers
    low, high = read_result(tmp_path / "other" / "result.yaml")["evaluation.margin_interval"]
    assert low < other["evaluation.margin"] < high
    assert other["evaluation.returns"] == same["evaluation.returns"]
    assert "random (baseline)" in (tmp_path / "other" / "index.html").read_text()


def test_settings_are_searched(tmp_path):
    """The sweeper runs a study over settings of a training: each trial is a run of its own, and the best is told."""
    sweeper = ["-m", "hydra/sweeper=population", "hydra.sweeper.n_trials=2", "hydra.sweeper.population=2"]
    sweeper += [
        '+hydra.sweeper.params={algorithm.actor_rate: "tag(log, interval(1e-4,1e-3))"}',
        f"hydra.sweep.dir={tmp_path}",
    ]
    done = run_script("train.py", *TINY, *sweeper, "hydra.sweeper.direction=maximize", "hydra.sweeper.seed=0")
    assert done.returncode == 0, done.stderr
    found = read_result(tmp_path / "optimization_results.yaml")
    runs = sorted(path.parent for path in (tmp_path / "0/populations").glob("*/*/result.yaml"))
    returns = [read_result(run / "result.yaml")["evaluation.return"] for run in runs]
    assert found["best_value"] == max(returns)
    chosen = PolicyBundle.load(runs[returns.index(max(returns))] / "policy").manifest.training.settings["algorithm"]
    assert chosen["actor_rate"] == found["best_params"]["algorithm.actor_rate"]
    assert "The best of 2 runs gives" in done.stdout
