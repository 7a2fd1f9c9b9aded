"""The diagnosis script as a user runs it."""

import time
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
import yaml

from op3.motions import squat
from op3.replay import simulate_motion
from op3.rollout import Rollout
from op3.servo import catalogue
from op3.sim import load_model
from tests.scripts import run_script

LEG = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ank_pitch", "ank_roll")
REPOSITORY = Path(__file__).resolve().parents[2]


def diagnose(*arguments: str) -> CompletedProcess[str]:
    return run_script("diagnose.py", *arguments)


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> Path:
    """Three squats of the right leg on the stand, with a little noise, and one of the whole robot on the floor."""
    folder, model, rng = tmp_path_factory.mktemp("logs"), load_model("paper"), np.random.default_rng(3)
    for number, frequency in enumerate((0.4, 0.7, 1.0)):
        log = simulate_motion(model, squat(frequency=frequency, duration=3.0), mount="stand")
        arrays = {k: log.array(k)[:, 14:] if k[0] in ("joint", "command") else log.array(k) for k in log.channels}
        arrays["joint", "position"] = arrays["joint", "position"] + rng.normal(
            0, 6e-4, arrays["joint", "position"].shape
        )
        metadata = log.metadata.replace(joints=log.joints[14:], recording=f"squat_{number}")
        Rollout.from_arrays(arrays, metadata).save(folder / f"squat_{number}")
    simulate_motion(model, squat(duration=1.0), mount="floor").save(folder / "floor")
    return folder


def test_jobs_write_verdict_page_and_one_wandb_group(logs, tmp_path):
    """Two jobs on nine seconds of logs: no name for certain, all that a verdict holds, the floor apart, one group."""
    without = ",".join(set(catalogue()) - {"dte", "load_friction", "link_mass", "current_offset"})
    options = [f"data={logs}", "seed=0,1", f"without=[{without}]", "windows=12"]
    done = diagnose("-m", *options, f"hydra.sweep.dir={tmp_path}/sweep")
    assert done.returncode == 0, done.stderr
    for job in ("0", "1"):
        folder = tmp_path / "sweep" / job
        told = yaml.safe_load((folder / "verdict.yaml").read_text())
        assert told["verdict"] in ("named", "ambiguous", "nothing_missing", "unknown")
        assert any("record 100 s" in text for text in told["cannot_tell"])
        assert all(finding["probability"] <= 0.5 for finding in told["findings"])
        assert set(told["windows"]["horizons"]) <= {"250 ms", "500 ms", "1000 ms"}
        assert set(told["joints"]) <= {f"r_{joint}" for joint in LEG}
        for gap in told["gap"].values():
            for end in ("before", "after"):
                low, high = gap[f"{end}_interval"]
                assert low <= gap[end] <= high
            assert gap["floor"] is None  # no command was repeated
        assert told["loss"]["name"] == "paper_eq7"
        assert (told["mount"], told["other_mounts"]["floor"]["logs"]) == ("stand", 1)
        assert load_model(str(folder / "model.yaml")).effect_names
        assert "logs of the mount floor" in (folder / "index.html").read_text()
        (run,) = folder.glob("wandb/offline-run-*/*.wandb")
        expected = (f"{tmp_path.name}/sweep", "gap.joint/position.before", "floor.loss.paper_eq7.after")
        deadline = time.monotonic() + 30  # another process of wandb writes the file, late on a busy machine
        while not all(text.encode() in run.read_bytes() for text in expected) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert all(text.encode() in run.read_bytes() for text in expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "data is missing"),
        (["data={logs}/none"], "none"),
        (["data={logs}", "model=papr"], "the nearest is 'paper'"),
        (["data={logs}", "mode=twice"], "once, loop or aliasing"),
        (["data={logs}", "policy=nowhere"], "policy=nowhere: no such folder"),
        (["planned=leg_suite"], "mode=aliasing"),
        (["planned=push_down", "mode=aliasing"], "push_down"),
    ],
)
def test_wrong_input_is_one_sentence(logs, tmp_path, arguments, message):
    """A wrong argument ends the run with its reason and a non-zero exit, and leaves no verdict."""
    done = diagnose(*(a.format(logs=logs) for a in arguments), f"hydra.run.dir={tmp_path}")
    assert done.returncode != 0
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "verdict.yaml").exists()
