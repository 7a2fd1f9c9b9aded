"""Re-identification as a user runs it, at a tiny budget."""

import shutil
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from op3.envs import BatchedEnv, record_episodes
from op3.motions import squat
from op3.replay import simulate_motion
from op3.report import read_result
from op3.rollout import Rollout
from op3.sim import load_model, save_model
from op3.tasks.task import find_task
from tests.envs.holding import holding_bundle
from tests.scripts import run_script

ROOT = Path(__file__).resolve().parents[2]
SMALL = ("hydra.sweeper.n_trials=6", "hydra.sweeper.population=4", "hydra.sweeper.starts=2", "repeats=2", "finalists=1")


def reidentify(*arguments: str) -> CompletedProcess[str]:
    return run_script("reidentify.py", *arguments, "wandb=disabled", "processes=1")


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> tuple[Path, list[str]]:
    """A folder with a squat, two episodes, the policy and its model, and the arguments that name them."""
    folder = tmp_path_factory.mktemp("given")
    model, policy, task = load_model("paper"), holding_bundle(p_gain=2.0), find_task("balance_eval")
    robot = model.with_values({"torque_constant": 0.0049})
    save_model(model.with_values({"torque_constant@joint=l_knee": 0.0066}), folder / "model.yaml")
    simulate_motion(robot, squat(frequency=1.0, duration=0.8)).save(folder / "squat")
    env = BatchedEnv(task, robot, 2, 3, action_map=policy.manifest.action_map)
    for number, log in enumerate(record_episodes(env, policy)):
        log.save(folder / "episodes" / f"episode-{number}")
    policy.save(folder / "policy")
    names = {"policy": "policy", "model": "model.yaml", "data": "squat", "episodes": "episodes"}
    return folder, [f"{key}={folder / name}" for key, name in names.items()]


def test_a_run_goes_on_and_takes_no_other_episodes(given, tmp_path):
    """Model, page and numbers; the same command is done at once; with other episodes the folder is refused."""
    folder, arguments = given
    done = reidentify(*arguments, *SMALL, f"hydra.run.dir={tmp_path}")
    assert done.returncode == 0, done.stderr
    numbers = read_result(tmp_path / "result.yaml")
    assert numbers["trials"] == 6
    assert numbers["accepted"] in (True, False)
    found = load_model(tmp_path / "model.yaml")
    assert found.estimate("torque_constant@joint=l_knee").value / found.value("torque_constant") == pytest.approx(
        0.0066 / load_model("paper").value("torque_constant")
    )
    assert "Pareto front" in (tmp_path / "index.html").read_text(encoding="utf-8")
    written = (tmp_path / "result.yaml").read_bytes()
    shutil.rmtree(folder / "episodes" / "episode-1")
    refused = reidentify(*arguments, *SMALL, f"hydra.run.dir={tmp_path}")
    assert refused.returncode == 1
    assert "has other objectives than this run" in refused.stderr
    assert (tmp_path / "result.yaml").read_bytes() == written


@pytest.mark.slow
def test_bad_input_is_named(given, tmp_path):
    """One sentence each, and nothing written."""
    folder, arguments = given
    log = Rollout.load(folder / "episodes" / "episode-0")
    flat = log.metadata.replace(extra={**log.metadata.extra, "exit": "voltage"})
    Rollout(log.data, flat).save(tmp_path / "flat" / "episode-0")
    for extra, sentence in (
        (["repeats=2.5"], "repeats must be a whole number, got 2.5"),
        (["finalists=-1"], "finalists must be at least 1, got -1"),
        ([f"episodes={tmp_path / 'flat'}"], "all ended because of voltage, which no simulation of the policy"),
    ):
        names = {argument.split("=")[0] for argument in extra}
        others = [argument for argument in (*arguments, *SMALL) if argument.split("=")[0] not in names]
        done = reidentify(*others, *extra, f"hydra.run.dir={tmp_path / 'run'}")
        assert done.returncode == 1, done.stderr
        assert sentence in done.stderr
        assert "Traceback" not in done.stderr
        assert not (tmp_path / "run" / "study.journal").exists()
