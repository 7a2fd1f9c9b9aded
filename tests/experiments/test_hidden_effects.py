"""The bench from the command line, with a diagnosis that always says the same."""

import hashlib
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from op3.report import read_result
from op3.stand_in.bench import draw_mix

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_a_bench_seals_diagnoses_scores_and_goes_on(tmp_path):
    """Answers are sealed, every case is diagnosed once, and result and page count what the verdicts say.

    One empty case and one outsider, both called unknown: one false alarm of one, one outsider of one right.
    """
    script = tmp_path / "always_unknown.py"
    script.write_text("import sys\nopen(sys.argv[1] + '/verdict.yaml', 'x').write('verdict: unknown\\n')\n")
    run = tmp_path / "run"
    command = [
        sys.executable, "experiments/hidden_effects.py", "bench=ci", "mix.singles.moderate=0", "mix.nulls=1",
        "mix.pairs=0", "mix.poor=0", "keep_data=false", "limit=2",
        f"command=[python,{script},'{{run}}']", f"hydra.run.dir={run}",
    ]  # fmt: skip
    for _ in range(2):  # the second time finds both verdicts and only scores
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    result = read_result(run / "result.yaml")
    assert result["answers_sha256"] == hashlib.sha256((run / "answers.sha256").read_bytes()).hexdigest()
    assert (result["diagnosis.false_alarms"]["count"], result["diagnosis.false_alarms"]["of"]) == (1, 1)
    assert (result["diagnosis.outsiders_unknown"]["count"], result["diagnosis.outsiders_unknown"]["of"]) == (1, 1)
    assert result["base_refit_only.false_alarms"]["count"] == 0
    assert result["sparse_regression.false_alarms"]["of"] == 1
    assert (run / "index.html").is_file()


@pytest.mark.slow
def test_the_small_bench_from_seeds_to_page(tmp_path):
    """Twelve legs, the real diagnosis, baselines and oracle: every case gets a verdict and hardly any misleads."""
    command = [sys.executable, "experiments/hidden_effects.py", "bench=ci", f"hydra.run.dir={tmp_path}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    result = read_result(tmp_path / "result.yaml")
    assert (result["diagnosis.cases"], result["diagnosis.failed"]) == (12, 0)
    assert (result["sparse_regression.cases"], result["sparse_regression.failed"]) == (12, 0)
    assert result["diagnosis.confident_wrong"]["count"] <= 1
    assert result["diagnosis.false_alarms"]["count"] <= 1
    assert result["diagnosis.top1_class"]["count"] > result["random_name.top1_class"]["count"]
    assert result["diagnosis.oracle_closure_median"]["of"] > 0


@pytest.mark.parametrize(("bench", "cases"), [("full", 688), ("laptop", 100), ("ci", 12), ("op3", 24)])
def test_every_bench_can_be_drawn(bench, cases):
    """Each mix names effects that can be hidden and has as many cases as its first line says."""
    path = ROOT / "conf" / "bench" / f"{bench}.yaml"
    assert f"# {cases} cases" in path.read_text()
    assert len(draw_mix(yaml.safe_load(path.read_text()))) == cases
