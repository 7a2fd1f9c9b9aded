"""The training and evaluation scripts, at budgets of seconds."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from op3.policy import PolicyBundle
from op3.report import read_result
from op3.rollout import Rollout

ROOT = Path(__file__).resolve().parents[2]
TINY = [
    "budget=demo",
    "environments=4",
    "threads=1",
    "sac.hidden=[16,16]",
    "sac.batch=32",
    "train.steps=320",
    "train.warmup=128",
    "train.log_every=64",
    "train.evaluate_every=160",
    "evaluation.episodes=2",
    "evaluation.video=false",
    "wandb=disabled",
]


def script(name: str, *overrides: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(ROOT / "experiments" / name), *overrides]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT, timeout=600)


@pytest.mark.slow
def test_a_policy_is_trained_resumed_and_judged(tmp_path):
    """Training writes bundle, checkpoint, page and numbers; it resumes; the bundle is judged with logs and numbers."""
    run = tmp_path / "run"
    done = script("train.py", *TINY, f"hydra.run.dir={run}")
    assert done.returncode == 0, done.stderr
    assert "left" in done.stdout
    manifest = PolicyBundle.load(run / "policy").manifest
    assert manifest.task == "balance"
    assert "experiments/train.py" in manifest.training.command
    assert (run / "checkpoint.pt").is_file()
    assert (run / "index.html").is_file()
    assert read_result(run / "result.yaml")["steps"] >= 320

    done = script("train.py", *TINY, "train.steps=640", f"resume={run}", f"hydra.run.dir={tmp_path / 'again'}")
    assert done.returncode == 0, done.stderr
    assert read_result(run / "result.yaml")["steps"] >= 640

    judged = tmp_path / "judged"
    options = ["episodes=2", "threads=1", "video=false", "task=balance_eval", f"hydra.run.dir={judged}"]
    done = script("evaluate.py", f"policy={run / 'policy'}", *options)
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
        ("evaluate.py", ["policy=nowhere"], "no such folder; give a bundle's, or hold, zero, random"),
        ("train.py", [*TINY, "task=fly"], "Could not find 'task/fly'"),
        ("train.py", [*TINY, "sac.n_step=0"], "n_step must be at least 1, got 0"),
    ]
    for name, overrides, message in cases:
        done = script(name, *overrides, f"hydra.run.dir={tmp_path / 'out'}")
        assert done.returncode != 0
        assert message in done.stderr
        assert "Traceback" not in done.stderr
