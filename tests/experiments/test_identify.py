"""The experiment scripts as a user runs them, at a tiny budget."""

import subprocess
import sys
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from op3.motions import squat
from op3.replay import simulate_motion
from op3.report import read_result
from op3.sim import load_model
from tests.scripts import run_script

REPOSITORY = Path(__file__).resolve().parents[2]
BENCH = REPOSITORY / ".." / "shared" / "data" / "servo_bench" / "sts3032"
SMALL = ["hydra.sweeper.n_trials=6", "hydra.sweeper.population=6", "wandb=disabled"]


def identify(*arguments: str) -> CompletedProcess[str]:
    return run_script("identify.py", *arguments)


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("logs") / "squat"
    simulate_motion(load_model("paper"), squat(frequency=1.0, duration=0.8)).save(folder)
    return folder


@pytest.fixture(scope="module")
def heldout(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("logs") / "slower"
    simulate_motion(load_model("paper"), squat(frequency=1.2, duration=0.8)).save(folder)
    return folder


def test_one_process(log, heldout, tmp_path):
    """A run writes page, numbers and model, and prints their paths last, the model's in the next command."""
    folder = tmp_path / "run"
    done = identify(f"data={log}", f"heldout={heldout}", f"hydra.run.dir={folder}", *SMALL)
    assert done.returncode == 0, done.stderr
    *paths, following = done.stdout.strip().splitlines()[-3:]
    assert paths == [str(folder / name) for name in ("index.html", "result.yaml")]
    assert following == f"next: op3 predict model={folder}/model.yaml data=<other logs>"
    page, result = map(Path, paths)
    numbers = read_result(result)
    assert numbers["trials"] == 6
    # the log comes from the model itself, whose values are the first trial
    assert numbers["loss.fit"] < 1e-4 < numbers["loss.fit_without_dte"]
    # 0.792 s of motion after 0.2 s of settling, for 6 trials, the point of the intervals with 2 * 10 ends of short arms
    # and 2 * 10 of arms as long as an interval, and the score
    assert numbers["simulated_seconds"] == pytest.approx((6 + 1 + 20 + 20 + 1) * 0.992)
    assert numbers["wall_seconds"] > numbers["wall_seconds_without_dte"] > 0
    assert set(numbers["parameters.backward_efficiency"]) == {"value", "low", "high"}
    told = [*numbers["identifiability.identifiable"], *numbers["identifiability.not_identifiable"]]
    assert sorted(told) == sorted(numbers["identifiability.parameters"])
    assert len(numbers["identifiability.singular_values"]) == 10
    assert "Identifiability" in page.read_text()
    assert load_model(folder / "model.yaml").value("torque_constant") == numbers["parameters.torque_constant"]["value"]


def test_a_value_for_each_joint(log, tmp_path):
    """A parameter is searched per joint, and told so in numbers, on the page and in the model file."""
    joints = ["l_knee", "r_hip_pitch"]
    options = ["groups=[motor,friction]", "per_joint=[coulomb_friction]", f"joints=[{','.join(joints)}]", "ablate=[]"]
    done = identify(f"data={log}", *options, f"hydra.run.dir={tmp_path}", *SMALL)
    assert done.returncode == 0, done.stderr
    numbers, model = read_result(tmp_path / "result.yaml"), load_model(tmp_path / "model.yaml")
    for joint in joints:
        told = numbers[f"parameters.coulomb_friction@joint={joint}"]
        found = model.estimate(f"coulomb_friction@joint={joint}")
        assert (told["value"], told["low"], told["high"]) == (found.value, found.low, found.high)
    assert "parameters.coulomb_friction" not in numbers
    assert "coulomb friction of the left knee" in (tmp_path / "index.html").read_text()


def test_multirun_is_one_study_per_cell(log, tmp_path):
    """With -m and a comma sweep, each cell has its own study, model and numbers."""
    done = identify(
        "-m", f"data={log}", "seed=0,1", "groups=[gear]", "ablate=[]", f"hydra.sweep.dir={tmp_path}", *SMALL
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-3:] == [
        str(tmp_path / "comparison.html"), str(tmp_path / "comparison.yaml"), "variants: all runs"
    ]  # fmt: skip
    comparison = read_result(tmp_path / "comparison.yaml")
    assert comparison["runs"] == 2
    assert [entry["runs"] for entry in comparison["variants"]] == [["0", "1"]]
    cells = [read_result(tmp_path / cell / "result.yaml") for cell in "01"]
    assert [cell["provenance.seed"] for cell in cells] == [0, 1]
    assert all(
        list(k for k in cell if k.startswith("parameters.")) == ["parameters.backward_efficiency"] for cell in cells
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["data=nowhere"], "nowhere"),
        (["data={log}", "model=papr"], "the nearest is 'paper'"),
        (["data={log}", "heldout_where={{firmware_gain: 8}}"], "matches none"),
        (["data={log}", "heldout_where={{firmware_gain: 8, speed: null}}"], "matches none"),
        pytest.param(["data={log}", "model=paper_without_stribeck"], "static_friction_excess", marks=pytest.mark.slow),
        pytest.param(["data={log}", "heldout={log}"], "both fitted and held out", marks=pytest.mark.slow),
        pytest.param(["data={log}", "joints=[l_kne]"], "l_kne", marks=pytest.mark.slow),
        pytest.param(
            ["data={log}", "groups=[motor]", "per_joint=[coulomb_friction]"],
            "is not searched",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ["data={log}", "per_joint=[base_mass_offset]"], "quantity of the whole robot", marks=pytest.mark.slow
        ),
        pytest.param(["data={log}", "heldout_where={{speed: 1}}"], "metadata field 'speed'", marks=pytest.mark.slow),
    ],
)
def test_wrong_input_is_one_sentence(log, tmp_path, arguments, message):
    """A wrong argument ends the run with a non-zero exit, its reason, and nothing written but Hydra's own log."""
    folder = tmp_path / "run"
    done = identify(*(a.format(log=log) for a in arguments), f"hydra.run.dir={folder}", *SMALL)
    assert done.returncode != 0
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not (folder / "result.yaml").exists()
    assert not (folder / "model.yaml").exists()


@pytest.mark.skipif(not BENCH.is_dir(), reason=f"needs {BENCH}")
def test_what_an_experiment_holds_out_can_be_replaced(tmp_path):
    """Another field joins the experiment's, which null takes out."""
    held_out = "+heldout_where={mass: 0.3, firmware_gain: null}"
    done = identify("experiment=servo_bench", f"data={BENCH}", held_out, f"hydra.run.dir={tmp_path}")
    assert done.returncode != 0
    assert "heldout_where={'mass': 0.3} matches none of the 96 logs" in done.stderr


@pytest.mark.slow
def test_servo_bench(tmp_path):
    """On the recorded STS3032 runs the held-out error is at most 13 mrad, and far larger without DTE."""
    if not BENCH.is_dir():
        pytest.skip(f"the servo-bench logs are not at {BENCH}")
    done = identify("experiment=servo_bench", f"data={BENCH}", f"hydra.run.dir={tmp_path}", "wandb=disabled")
    assert done.returncode == 0, done.stderr
    numbers = read_result(tmp_path / "result.yaml")
    assert numbers["error_mrad.heldout"] <= 13
    assert numbers["error_mrad.heldout_without_dte"] > 1.3 * numbers["error_mrad.heldout"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_stand_in(tmp_path, seed):
    """On stand-ins with another law of gear loss, DTE lowers the loss by a factor of at least 2.5."""
    for motion in ("squat", "squat_heldout"):
        where = [f"motion={motion}", "world=random", f"seed={seed}", f"hydra.run.dir={tmp_path / motion}"]
        command = [sys.executable, "experiments/collect.py", *where]
        subprocess.run(command, cwd=REPOSITORY, check=True)
    done = identify(
        f"data={tmp_path / 'squat' / 'squat-0'}",
        f"heldout={tmp_path / 'squat_heldout' / 'squat_heldout-0'}",
        "method=lsq",
        f"hydra.run.dir={tmp_path / 'run'}",
        "wandb=disabled",
    )
    assert done.returncode == 0, done.stderr
    numbers = read_result(tmp_path / "run" / "result.yaml")
    assert numbers["loss.fit_without_dte"] >= 2.5 * numbers["loss.fit"]
    assert numbers["loss.heldout"] < numbers["loss.heldout_without_dte"]
