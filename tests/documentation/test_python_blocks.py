"""The Python of README.md and docs/ runs, from top to bottom of each page, at sizes that take seconds."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from documented import PAGES, ROOT

from op3.motions import squat
from op3.replay import simulate_motion
from op3.robot import load_robot
from op3.servo import Servos
from op3.sim import load_model

BLOCK = re.compile(r"(<!-- not executed: [^>]+-->\n+)?^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)

SMALLER = {
    "duration=10.0": "duration=0.5",
    "num_envs=64": "num_envs=2",
    "num_envs=8": "num_envs=1",
    "env.rollout(10)": "env.rollout(1)",
    "range(313)": "range(2)",
    "n_trials=64": "n_trials=2",
    "starts=4": "starts=0",
    "outputs/collect/<time>/squat-0": "log",
    '"squat-0"': '"log"',
    ".between(1.0, 3.0)": ".between(0.2, 0.5)",
}
"""What a page says, and what is run in its place."""

WITH_PYTHON = [page for page in PAGES if any(not skipped for skipped, _ in BLOCK.findall(page.read_text()))]


@pytest.fixture(scope="module")
def log():
    return simulate_motion(load_model("paper"), squat(frequency=1.0, duration=0.6), mount="stand")


def known(log) -> dict:
    """What a reader of the pages has at hand."""
    joints, still = load_robot("op3").joints, np.zeros((2, 20))
    return {
        "model": load_model("paper"), "joints": joints, "num_sims": 2, "Servos": Servos, "other": log,
        "observation": torch.zeros(4, 124), "target": torch.zeros(2, 20), "position": still, "velocity": still,
        "load": still,
    }  # fmt: skip


@pytest.mark.parametrize("page", WITH_PYTHON, ids=lambda page: page.name)
def test_the_python_of_a_page_runs(page: Path, log, tmp_path, monkeypatch):
    """One namespace per page, as in a notebook; what a comment before a block excuses is left out."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "assets").symlink_to(ROOT / "assets")
    log.save("log")
    space = known(log)
    for skipped, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        for said, small in SMALLER.items():
            text = text.replace(said, small)
        if not skipped:
            exec(compile(text, page.name, "exec"), space)
