"""The whole method at the smallest budget, in every condition."""

from pathlib import Path

import pytest
from hydra.utils import instantiate

from op3.apps.compose import composed
from op3.policy import PolicyBundle
from op3.report import read_result
from op3.sim import load_model
from tests.scripts import run_script

ROOT = Path(__file__).resolve().parents[2]
TRAIN = (
    "train.steps=1200",
    "algorithm.warmup=400",
    "train.evaluate_every=600",
    "environments=8",
    "evaluation.episodes=2",
)
TINY = {
    "train": ("budget=demo", *TRAIN),
    "retrain": ("budget=retrain", *TRAIN),
    "reidentify": ("hydra.sweeper.n_trials=6", "hydra.sweeper.population=6", "repeats=2"),
    "identify": ("refine.starts=1", "refine.max_iterations=1", "hydra.sweeper.n_trials=8"),
}
CONDITIONS = (
    "excitation_only",
    "retrained",
    "reidentified",
    "excitation_only_without_dte",
    "reidentified_without_dte",
    "domain_randomisation",
    "diagnosed",
    "diagnosed_reidentified",
    "diagnosed_without_dte",
)


def sim2real(folder, *overrides):
    tiny = [f"budgets.demo.{stage}=[{','.join(map(repr, values))}]" for stage, values in TINY.items()]
    tiny += ["budgets.demo.episodes=2", "diagnosis=[squat_fast,squat_shallow]"]
    return run_script("sim2real.py", "budget=demo", *tiny, *overrides, f"hydra.run.dir={folder}")


DEMO = ("source=emulated", "task=balance", "world=robot_4")


def refused(folder, arguments, sentence):
    done = sim2real(folder / "run", *arguments)
    assert done.returncode != 0
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr
    assert not (folder / "run" / "squat").exists()


def test_unknown_names_are_refused(tmp_path):
    """What does not exist is named in one sentence, before anything is done; else as `make demo` writes it."""
    refused(tmp_path, (*DEMO, "condition=nonsense"), "condition must be one of excitation_only")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((*DEMO[1:], "source=stand_in"), "source must be emulated or real"),
        ((*DEMO, "policy=nowhere"), "nowhere"),
        ((*DEMO, "policy=assets/policies/walk"), "was trained for walk, not for balance"),
        ((*DEMO, "policy=assets/policies/balance", "trained_on=paper_without_dte"), "is not that; give trained_on="),
        ((*DEMO, "rounds=x"), "rounds must be a whole number, got 'x'"),
        ((*DEMO, "criterion=much"), "criterion must be a number, got 'much'"),
        ((*DEMO, "criterion=80"), "criterion must be a share of the expected return (0.8 for 80 %), got 80"),
        ((*DEMO, "world=robot_99"), "robot_99"),
        ((*DEMO, "model=nowhere.yaml"), "nowhere.yaml"),
        ((*DEMO, "diagnose=perhaps"), "diagnose must be true, false, or null"),
        ((*DEMO, "train.steps=10"), "train.steps=10 has no effect on any stage"),
    ],
)
def test_what_is_impossible_is_refused_before_anything_is_done(arguments, sentence, tmp_path):
    """One sentence names the field."""
    refused(tmp_path, arguments, sentence)


@pytest.mark.slow
def test_a_folder_of_another_condition_is_refused(tmp_path):
    """Its stages would be taken for those of this one, and its page overwritten."""
    (tmp_path / "asked.yaml").write_text("{condition: excitation_only, criterion: 0.8}")
    done = sim2real(tmp_path, *DEMO, "condition=reidentified")
    assert done.returncode != 0
    assert "was started with other settings (condition: excitation_only -> reidentified" in done.stderr
    assert not (tmp_path / "squat").exists()


def test_make_demo_is_a_command_that_the_script_takes():
    """The overrides of the Makefile's demo compose, so that a new user's first command does not end in an error."""
    line = next(row for row in (ROOT / "Makefile").read_text().splitlines() if "experiments/sim2real.py" in row)
    overrides = line.split("experiments/sim2real.py")[1].split()
    cfg = composed("sim2real", overrides)
    assert cfg.world == "robot_4"
    assert cfg.condition == "reidentified"


@pytest.mark.parametrize(
    ("experiment", "overrides"),
    [
        ("diagnose", ["data=stand", "model=m", "seed=0", "policy=p", "actual=e", "task=walk"]),
        ("reidentify", ["policy=p", "model=m", "data=s", "episodes=e", "task=walk", "start_name=re-identified before"]),
        ("collect", ["source=emulated", "world=robot_1", "world_seed=0", "policy=p", "task=walk", "repeats=10"]),
        ("evaluate", ["policy=p", "model=m", "task=walk", "episodes=10", "seed=0", "logs=false"]),
    ],
)
def test_what_stages_are_asked_is_what_they_take(experiment, overrides):
    """The overrides that the loop hands to its stages compose, and the task arrives."""
    assert instantiate(composed(experiment, overrides).task).name == "walk"


@pytest.mark.slow
@pytest.mark.parametrize("condition", CONDITIONS)
def test_every_condition_ends_with_a_page(condition, tmp_path):
    """From collecting to the second transfer; the criterion is set so that the first one counts as failed."""
    done = sim2real(tmp_path, f"condition={condition}", "criterion=10.0", "world=robot_2")
    assert done.returncode == 0, done.stderr[-2000:]
    result = read_result(tmp_path / "result.yaml")
    learns = any(word in condition for word in ("reidentified", "diagnosed", "retrained"))
    assert result["rounds"] == (1 if learns else 0)
    assert result["success"] is False
    assert ("stage_seconds.1_reidentify" in result) == ("reidentified" in condition)
    assert ("stage_seconds.1_diagnose" in result) == ("round_1.diagnosis" in result) == ("diagnosed" in condition)
    assert ("stage_seconds.identify" in result) == (condition != "domain_randomisation")
    trained = PolicyBundle.load(tmp_path / "0_train" / "policy").manifest.training
    began = trained.model if condition == "domain_randomisation" else tmp_path / "identify" / "model.yaml"
    assert ("dte" in load_model(began).effect_names) == ("without_dte" not in condition)
    randomised = trained.settings["environment"].get("randomisation")
    assert (randomised is not None) == (condition == "domain_randomisation")
    if learns:
        assert result["transfer_1.training_began_with"] == "the policy of round 0"
        again = PolicyBundle.load(tmp_path / "1_train" / "policy").manifest.training
        assert again.settings["warm_start"] == str(tmp_path / "0_train" / "policy")
        last = (
            "1_reidentify" if "reidentified" in condition else "1_diagnose" if "diagnosed" in condition else "identify"
        )
        assert again.model == str(tmp_path / last / "model.yaml")
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert ("Diagnosis of further motions" in page) == ("diagnosed" in condition)
    again = sim2real(tmp_path, f"condition={condition}", "criterion=10.0", "world=robot_2")
    assert again.stdout.count("already finished") >= 4


@pytest.mark.slow
def test_a_walk_goes_on_from_the_shipped_one(tmp_path):
    """Where the budget is too small to learn walking, the first training starts with a policy that walks elsewhere."""
    done = sim2real(tmp_path, "task=walk", "condition=excitation_only", "world=robot_2")
    assert done.returncode == 0, done.stderr[-2000:]
    training = PolicyBundle.load(tmp_path / "0_train" / "policy").manifest.training
    assert training.settings["warm_start"] == "assets/policies/walk"
    assert training.model == str(tmp_path / "identify" / "model.yaml")


@pytest.mark.slow
def test_a_policy_that_exists_goes_first_and_its_failure_leads_to_an_identification(tmp_path):
    """The given policy is judged by the model it was trained on; the robot is identified once it has failed."""
    given = ROOT / "assets" / "policies" / "walk"
    begin = ("task=walk", "condition=excitation_only", "world=robot_4", f"policy={given}", "rounds=2")
    done = sim2real(tmp_path, *begin)
    assert done.returncode == 0, done.stderr[-2000:]
    result = read_result(tmp_path / "result.yaml")
    assert not (tmp_path / "0_train").exists()
    assert result["transfer_0.walked"] == 0.0
    assert result["transfer_0.expected"] > 200.0
    assert result["rounds"] == 1
    trained = PolicyBundle.load(tmp_path / "1_train" / "policy").manifest.training
    assert trained.model == str(tmp_path / "identify" / "model.yaml")
    assert trained.settings["warm_start"] == str(given)
