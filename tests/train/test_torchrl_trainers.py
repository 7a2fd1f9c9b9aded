"""TorchRL's own Hydra-configured trainers on a task of the project."""

import csv
import math
import subprocess
import sys
from pathlib import Path

import pytest

TRAIN = Path(__file__).resolve().parents[2] / "examples" / "torchrl_trainers" / "train.py"


@pytest.mark.slow
@pytest.mark.parametrize("task", ["walk", "reach"])
@pytest.mark.parametrize("name", ["sac", "ppo"])
def test_torchrl_trainers_run(name, task, tmp_path):
    """For 10,000 steps, with optimisation steps, and rewards and entropies that are finite."""
    options = ["--config-name", name, "total_frames=10000", f"environment.task={task}", f"hydra.run.dir={tmp_path}"]
    done = subprocess.run([sys.executable, str(TRAIN), *options], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr

    def column(scalar: str) -> list[tuple[int, float]]:
        rows = csv.reader((tmp_path / name / "scalars" / f"{scalar}.csv").open())
        return [(int(step), float(value)) for step, value in rows]

    assert column("optim_steps")[-1][1] >= 100
    assert column("r_training")[-1][0] >= 10_000
    assert all(math.isfinite(value) for scalar in ("r_training", "entropy") for _, value in column(scalar))
