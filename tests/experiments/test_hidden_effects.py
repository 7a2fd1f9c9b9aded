"""The bench from the command line, with a diagnosis that always says the same."""

import hashlib
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.hidden_bench.bench import draw_mix
from op3.common.assets import named_configs
from op3.report import read_result

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_a_bench_seals_diagnoses_scores_and_goes_on(tmp_path):
    """Answers are sealed, every case is diagnosed once, and result and page count what the verdicts say.

    One sound leg and one outsider, of which a blunt diagnosis says dte with 0.9: both named, both misled.
    """
    script = tmp_path / "always_dte.py"
    script.write_text(
        "import sys\nverdict = 'findings: [{effect: dte, probability: 0.9}]'\n"
        "open(sys.argv[1] + '/verdict.yaml', 'x').write(verdict)\n"
    )
    run = tmp_path / "run"
    command = [
        sys.executable, "experiments/hidden_effects.py", "bench=ci", "mix.singles.clear=0", "mix.nulls=1",
        "mix.pairs=0", "mix.poor=0", "keep_data=false", "limit=2",
        f"command=[python,{script},'{{run}}']", f"hydra.run.dir={run}",
    ]  # fmt: skip
    for _ in range(2):  # the second time finds both verdicts and only scores
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    result = read_result(run / "result.yaml")
    assert result["answers_sha256"] == hashlib.sha256((run / "answers.sha256").read_bytes()).hexdigest()
    for name in ("sound_named", "outsiders_named"):
        assert (result[f"diagnosis.{name}"]["count"], result[f"diagnosis.{name}"]["of"]) == (1, 1)
    assert result["diagnosis.confident_wrong"]["count"] == 2
    assert result["diagnosis.processor_seconds_median"]["value"] > 0
    assert result["sparse_regression.cases"] == 2
    assert result["sparse_regression.failed"] == 0
    assert (run / "index.html").is_file()


@pytest.mark.parametrize(("bench", "cases"), [("full", 680), ("laptop", 100), ("ci", 12), ("op3", 48)])
def test_every_bench_can_be_drawn(bench, cases):
    """Each mix names effects that can be hidden and has as many cases as its comment says."""
    assert len(draw_mix(named_configs("bench")[bench])) == cases
