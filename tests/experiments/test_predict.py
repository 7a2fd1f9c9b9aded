"""The prediction script as a user runs it."""

from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest

from op3.motions import hold, squat
from op3.replay import simulate_motion
from op3.report import read_result
from op3.robot import pose
from op3.rollout import Metadata, Rollout
from op3.sim import load_model, save_model
from tests.scripts import run_script

REPOSITORY = Path(__file__).resolve().parents[2]
BENCH = REPOSITORY / ".." / "shared" / "data" / "servo_bench" / "sts3032"


def predict(*arguments: str) -> CompletedProcess[str]:
    return run_script("predict.py", *arguments, "wandb=disabled")


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> Path:
    """Two logs of the robot, one of them held still."""
    folder = tmp_path_factory.mktemp("logs")
    for motion in (squat(frequency=1.0, duration=0.4), hold(pose("stand", "op3"), 0.4, robot="op3")):
        simulate_motion(load_model("paper"), motion).save(folder / motion.name)
    return folder


def test_page_and_numbers(logs, tmp_path):
    """A run prints page and numbers last; every channel, joint and trajectory has an error with its interval."""
    save_model(load_model("paper").with_values({"coulomb_friction": 0.2}), tmp_path / "model.yaml")
    done = predict(f"model={tmp_path / 'model.yaml'}", f"data={logs}", f"hydra.run.dir={tmp_path}")
    assert done.returncode == 0, done.stderr
    page, result = map(Path, done.stdout.strip().splitlines()[-2:])
    assert page == tmp_path / "index.html"
    numbers = read_result(result)
    for key in ("error_mrad", "loss.paper_eq7", "rms.joint/current", "rms_by_joint.joint/position.l_knee"):
        assert numbers[key]["low"] <= numbers[key]["value"] <= numbers[key]["high"]
    assert {"by_trajectory.squat", "by_trajectory.hold"} <= set(numbers)
    assert [log["seen"] for log in numbers["logs"]] == [False, False]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["model=paper"], "data is missing"),
        (["model=papr", "data={logs}"], "the nearest is 'paper'"),
        (["model=paper", "data={logs}", "where={{mount: stand}}"], "matches none of the 2 logs"),
        (["model=sts3032", "data={logs}"], "firmware_gain"),
        (["model=paper", "data={other}"], "op3 has no joint wrist; name the log's robot with robot="),
    ],
)
def test_wrong_input_is_one_sentence(logs, tmp_path, arguments, message):
    """A wrong argument ends the run with its reason and a non-zero exit."""
    time = np.arange(200)[:, None] / 125
    arrays = {"time": time, "command/position": np.sin(time), "joint/position": np.sin(time - 0.02)}
    Rollout.from_arrays(arrays, Metadata(("wrist",), "real", "stand", 125.0)).save(tmp_path / "other")
    given = (a.format(logs=logs, other=tmp_path / "other") for a in arguments)
    done = predict(*given, f"hydra.run.dir={tmp_path}")
    assert done.returncode != 0
    assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_servo_bench(tmp_path):
    """The recorded runs of the held-out gain are predicted from a model file alone."""
    if not BENCH.is_dir():
        pytest.skip(f"the servo-bench logs are not at {BENCH}")
    done = predict("model=sts3032", f"data={BENCH}", "where={firmware_gain: 8}", f"hydra.run.dir={tmp_path}")
    assert done.returncode == 0, done.stderr
    numbers = read_result(tmp_path / "result.yaml")
    assert len(numbers["logs"]) == 24
    assert numbers["error_mrad"]["low"] < numbers["error_mrad"]["value"] < 40
    assert numbers["intervals_from"] == "logs"
