"""The benchmarks at tiny budgets: they run, resume and count."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from op3.report import read_result

REPOSITORY = Path(__file__).resolve().parents[2]
BENCHMARKS = REPOSITORY / "experiments" / "benchmarks"


def load_script(name: str):
    """A benchmark as a module."""
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def world(number: int, covered: bool, loss: float, identifiable: bool = True) -> dict:
    """A line of the coverage benchmark."""
    return {
        "world": number,
        "truth": {"a": 0.5},
        "low": {"a": 0.4},
        "high": {"a": 0.6},
        "covered": {"a": covered},
        "identifiable": {"a": identifiable},
        "loss": loss,
        "loss_of_truth": 1.0,
        "wall_seconds": 1.0,
        "simulated_seconds": 2.0,
    }


def test_coverage_counts_what_is_identifiable_and_tells_search_from_intervals():
    """Three of four identifiable intervals cover; of the three whose minimum was reached all do."""
    script = load_script("interval_coverage")
    worlds = [world(0, True, 0.9), world(1, True, 0.8), world(2, False, 3.0), world(3, True, 1.0)]
    worlds.append(world(4, False, 0.9, identifiable=False))
    numbers = script.summarise(worlds, ["a"])
    assert numbers["coverage.pooled"] == 0.75
    assert numbers["coverage.minimum_reached"] == 4
    assert numbers["coverage.pooled_where_reached"] == 1.0
    assert numbers["covered"] == {"a": 3}


def test_a_torn_line_is_left_out(tmp_path):
    """A line cut short by a kill does not count as done."""
    script = load_script("interval_coverage")
    path = tmp_path / "worlds.jsonl"
    path.write_text(json.dumps(world(0, True, 1.0)) + "\n" + json.dumps(world(1, True, 1.0))[:40])
    assert [line["world"] for line in script.read_lines(path)] == [0]
    script.append(path, world(2, True, 1.0))
    assert [line["world"] for line in script.read_lines(path)] == [0, 2]


def road(ratio: float, fresh: float, rise: float, start: float = 10.0) -> dict:
    """What a re-identification of a robot gives."""
    told = {"distance": ratio, "fresh": fresh, "excitation": rise}
    return {
        "trials": 100,
        "reidentify_processor_seconds": 250.0,
        **{f"{key}.ratio": share for key, share in told.items()},
        **{f"{key}.excitation_only": start for key in told},
        **{f"{key}.reidentified": start * share for key, share in told.items()},
    }


def robot(ratio: float, fresh: float, rise: float) -> dict:
    """A robot that was re-identified once."""
    return {"reidentify": road(ratio, fresh, rise)}


def test_re_identification_is_judged_by_the_median_distance_and_the_largest_loss():
    """Fresh ratios 0.1, 0.3, 0.9 have the median 0.3: met, unless one robot's excitation loss rises by 30 %."""
    script = load_script("reidentification")
    robots = {"a": robot(0.5, 0.3, 1.1), "b": robot(0.4, 0.1, 1.2), "c": robot(0.6, 0.9, 1.0)}
    numbers = script.summarise(robots)
    assert numbers["median.distance_ratio"] == 0.5
    assert numbers["median.fresh_ratio"] == 0.3
    assert numbers["processor_seconds_per_trial"] == 2.5
    assert numbers["met"]
    assert not script.summarise({**robots, "c": robot(0.6, 0.9, 1.3)})["met"]


def test_a_robot_whose_start_is_as_good_as_it_gets_has_no_ratio():
    """Where nothing lay between start and robot the others make the median; without others there is none."""
    script = load_script("reidentification")
    none = {"reidentify": {**road(0.5, 0.5, 1.0), "distance.ratio": None, "fresh.ratio": None}}
    assert script.summarise({"a": none, "b": robot(0.4, 0.2, 1.0)})["median.fresh_ratio"] == 0.2
    assert script.summarise({"a": none})["median.fresh_ratio"] is None
    assert not script.summarise({"a": none})["met"]


def test_a_model_that_was_diagnosed_first_is_compared_with_the_same_start():
    """From 10 a diagnosis went to 4, and re-identification from there to 2: a fifth is left, not a half."""
    script = load_script("reidentification")
    robots = {"a": {**robot(0.3, 0.5, 1.1), "diagnose": road(0.5, 0.75, 1.5, start=4.0)}, "b": robot(0.4, 0.4, 1.0)}
    numbers = script.summarise(robots)
    assert numbers["diagnosed.median.distance_ratio"] == pytest.approx(0.2)
    assert numbers["diagnosed.median.fresh_ratio"] == pytest.approx(0.3)
    assert numbers["diagnosed.median.excitation_ratio"] == pytest.approx(0.6)
    assert numbers["median.distance_ratio"] == pytest.approx(0.35)
    assert numbers["a.diagnosed.distance.ratio"] == 0.5


@pytest.mark.slow
def test_one_world_and_resume(tmp_path):
    """A world is drawn, recorded, identified and written; the same command again has nothing left to do."""
    command = [
        sys.executable, str(BENCHMARKS / "interval_coverage.py"), "worlds=1", "motions=[squat_shallow]", "trials=4",
        "refine={rounds: 1, batch: 4, polish: 1}", f"hydra.run.dir={tmp_path}",
    ]  # fmt: skip
    first = subprocess.run(command, capture_output=True, text=True, check=False)
    assert first.returncode == 0, first.stderr
    assert "world 0:" in first.stdout
    second = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "world 0:" not in second.stdout
    numbers = read_result(tmp_path / "result.yaml")
    assert numbers["worlds"] == 1
    line = json.loads((tmp_path / "worlds.jsonl").read_text())
    assert set(line["covered"]) == set(line["truth"])
