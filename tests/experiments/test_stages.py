"""Stages of longer experiments, each done once."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))

from stages import DONE, Stages


def test_runs_share_the_stages_that_they_ask_alike(tmp_path):
    """What is the same but for the run's folder is done once; what differs gets a folder of its own."""
    squats = {}
    for name, motion in (("a", "squat"), ("b", "squat"), ("c", "squat_fast")):
        (tmp_path / name).mkdir()
        stages = Stages(tmp_path / name, tmp_path / "shared")
        squats[name] = stages.run("squat", "collect.py", "source=model", "mount=stand", f"motion={motion}")
        shown = stages.run("1_predict", "predict.py", f"data={squats[name]}", "model=paper")
        assert (shown / "result.yaml").exists()
    assert squats["a"].resolve() == squats["b"].resolve() != squats["c"].resolve()
    assert len(list((tmp_path / "shared").glob(f"squat-*/{DONE}"))) == 2
    assert len(list((tmp_path / "shared").glob(f"predict-*/{DONE}"))) == 2
