"""A first look at the diagnosis, as a user runs it."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from op3.report.tracks import of_diagnosis

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_the_demo_names_what_it_has_hidden_and_leaves_what_can_be_viewed(tmp_path):
    """The sealed answer's effect is the first finding, the gap shrinks, and the run has three tracks to look at."""
    command = [sys.executable, "-m", "op3", "demo", "diagnose", f"hydra.run.dir={tmp_path}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    verdict = yaml.safe_load((tmp_path / "verdict.yaml").read_text())
    (answer,) = (yaml.safe_load(path.read_text()) for path in (tmp_path / "answers").glob("*.yaml"))
    (hidden,) = answer["effects"]
    assert verdict["findings"][0]["effect"] == hidden["name"]
    gap = verdict["gap"]["joint/position"]
    assert gap["after"] < gap["before"]
    lines = done.stdout.splitlines()
    assert [line.split()[0] for line in lines[-6:]] == ["named", "hidden", "gap", "model", "page", "next"]
    assert f"Hidden in this simulated robot: {verdict['hidden']}." in (tmp_path / "index.html").read_text()
    assert "left" in done.stderr  # how long it still takes
    tracks = of_diagnosis(tmp_path)
    assert list(tracks.logs) == ["measured", "before", "after"]
    assert tracks.states(10.0).shape[0] == 3
