"""The script that records, from the command line to the files."""

import shutil
import subprocess
import sys
import time
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest

from op3.rollout import Rollout
from tests.scripts import run_script

ROOT = Path(__file__).resolve().parents[2]


COMMAND = [sys.executable, "-W", "ignore", str(ROOT / "experiments" / "collect.py")]


def collect(*arguments: str) -> CompletedProcess[str]:
    return run_script("collect.py", *arguments)


def test_two_recordings(tmp_path):
    """Repeats land in the run's folder, their paths are printed, and they are logs of the asked motion."""
    result = collect(
        *("source=stand_in", "motion=squat", "world=eta_070", "repeats=2", "seed=3"),
        *("motion.duration=0.4", "motion.frequency=0.6", f"hydra.run.dir={tmp_path}"),
    )
    assert result.returncode == 0, result.stderr
    logs = [Rollout.load(tmp_path / f"squat-{number}") for number in range(2)]
    for number, log in enumerate(logs):
        assert f"{tmp_path}/squat-{number}: 50 rows" in result.stdout
        assert log.metadata.recording == f"squat-{number}"
        assert log.metadata.seed == 3
        assert log.metadata.date is not None
        knee = log.column("l_knee.target")
        assert knee[-1] == pytest.approx(0.6 + 0.87 * (1 + np.cos(2 * np.pi * 0.6 * 49 / 125)) / 2)
    assert (logs[0].array("joint/position") != logs[1].array("joint/position")).any()
    assert "eta_070" not in (tmp_path / "squat-0" / "metadata.yaml").read_text()


def test_several_worlds(tmp_path):
    """Hydra's multirun collects from several worlds, one folder each."""
    result = collect(
        *("-m", "world=eta_060,random", "world_seed=7", "motion=squat_heldout", "mount=stand"),
        *("motion.duration=0.1", f"hydra.sweep.dir={tmp_path}"),
    )
    assert result.returncode == 0, result.stderr
    logs = [Rollout.load(tmp_path / job / "squat_heldout-0") for job in "01"]
    assert [log.metadata.mount for log in logs] == ["stand", "stand"]
    assert logs[0].metadata.extra["world"] != logs[1].metadata.extra["world"]
    assert logs[0].column("l_knee.target")[0] == pytest.approx(1.3)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("world=utopia", "there is no world 'utopia'; choose random, default, eta_060"),
        ("mount=bench", "mount must be floor or stand, got 'bench'"),
    ],
)
def test_bad_arguments(tmp_path, argument, message):
    """One sentence, a non-zero exit, no stack trace, no files."""
    result = collect("motion.duration=0.1", argument, f"hydra.run.dir={tmp_path}")
    assert result.returncode != 0
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert not list(tmp_path.glob("squat*"))


def test_a_motion_brings_its_own_gains(tmp_path):
    """`soften` is played with the gain it carries, row by row."""
    result = collect("motion=soften", "motion.cycles=1", "motion.period=0.5", f"hydra.run.dir={tmp_path}")
    assert result.returncode == 0, result.stderr
    gain = Rollout.load(tmp_path / "soften-0").column("l_knee.p_gain")
    assert gain.max() == pytest.approx(6.0)
    assert gain.min() == pytest.approx(3.0, rel=0.01)


def test_a_motion_on_the_wrong_mount_is_refused(tmp_path):
    """A chirp on the floor would tip the robot over: the sentence says which mount it is for."""
    result = collect("motion=chirp_knee", f"hydra.run.dir={tmp_path}")
    assert result.returncode != 0
    assert "'chirp_knee' is not for the floor; choose mount=stand" in result.stderr


@pytest.mark.slow
def test_a_plan_is_played_in_order(tmp_path):
    """Every entry of a plan is recorded on its own mount, repeats are numbered, nothing is played if one is unsafe."""
    plan = tmp_path / "plan.yaml"
    plan.write_text("plan:\n- {motion: stroke_ankle, mount: stand}\n- {motion: hold, mount: floor}\n")
    result = collect(f"plan={plan}", f"hydra.run.dir={tmp_path / 'logs'}")
    assert result.returncode == 0, result.stderr
    mounts = [Rollout.load(tmp_path / "logs" / name).metadata.mount for name in ("stroke_ankle-0", "hold-0")]
    assert mounts == ["stand", "floor"]
    plan.write_text("plan:\n- {motion: hold, mount: floor}\n- {motion: stroke_ankle, mount: floor}\n")
    result = collect(f"plan={plan}", f"hydra.run.dir={tmp_path / 'unsafe'}")
    assert result.returncode != 0
    assert "choose mount=stand" in result.stderr
    assert not (tmp_path / "unsafe" / "hold-0").exists()
    plan.write_text("plan: squat\n")
    assert "is not a plan" in collect(f"plan={plan}").stderr


def test_what_has_been_recorded_is_not_recorded_again(tmp_path):
    """A recording that is missing is made as it would have been; other settings are refused, and nothing is touched."""
    asked = ("motion=squat", "world=eta_070", "repeats=2", "seed=3", "motion.duration=0.2", f"hydra.run.dir={tmp_path}")
    assert collect(*asked).returncode == 0
    whole = Rollout.load(tmp_path / "squat-1").fingerprint()
    shutil.rmtree(tmp_path / "squat-1")
    refused = collect(*(argument.replace("eta_070", "eta_080") for argument in asked))
    assert refused.returncode == 1
    assert "was started with other settings (world: eta_070 -> eta_080); choose another" in refused.stderr
    assert not (tmp_path / "squat-1").exists()
    again = collect(*asked)
    assert again.returncode == 0, again.stderr
    assert again.stdout.count("already recorded") == 1
    assert Rollout.load(tmp_path / "squat-1").fingerprint() == whole


@pytest.mark.slow
def test_a_killed_run_on_the_robot_goes_on(tmp_path):
    """Killed while it records, the same command sets the ticks of that run aside, and ends with the same logs."""
    asked = ["source=emulated", "motion=squat", "motion.duration=1.0"]
    straight = collect(*asked, f"hydra.run.dir={tmp_path / 'straight'}")
    assert straight.returncode == 0, straight.stderr
    folder = tmp_path / "killed"
    process = subprocess.Popen([*COMMAND, *asked, f"hydra.run.dir={folder}"], cwd=ROOT, stdout=subprocess.DEVNULL)
    unfinished = folder / "ticks" / "squat-0"
    while not unfinished.exists() and process.poll() is None:
        time.sleep(0.01)
    process.kill()
    assert process.wait() != 0
    again = collect(*asked, f"hydra.run.dir={folder}")
    assert again.returncode == 0, again.stderr
    assert (folder / "ticks" / "squat-0.unfinished-0").exists()
    one, other = (Rollout.load(place / "squat-0") for place in (tmp_path / "straight", folder))
    assert one.fingerprint() == other.fingerprint()
