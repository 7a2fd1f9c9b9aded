"""The comparison of runs: variants, spread over seeds, and the page."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from report_logs import PageReader

from op3.report import read_result, write_result
from op3.report.comparison_page import read_runs, varied, write_comparison


@pytest.fixture
def runs(tmp_path) -> Path:
    """Two models times three seeds, as identify leaves them."""
    for number, (model, seed) in enumerate([(m, s) for m in ("paper", "coulomb_viscous") for s in (0, 1, 2)]):
        cell = tmp_path / str(number)
        base = 10.0 if model == "paper" else 30.0
        numbers = {
            "loss.fit": 0.1 * base,
            "loss.heldout": None,
            "loss.paper_eq7": 0.1 * base,
            "error_mrad.train": base + seed,
            "error_mrad.heldout": 2 * base + seed,
            "wall_seconds": 5.0,
            "simulated_seconds": 100.0,
            "identifiability.at_bound": ["coulomb_friction"] if seed == 2 else [],
            "parameters": {"coulomb_friction": {"value": 0.1 + 0.01 * seed, "low": 0.0, "high": 0.2}},
        }
        write_result(cell / "result.yaml", numbers)
        (cell / ".hydra").mkdir()
        overrides = [f"model={model}", f"seed={seed}", "data=x", f"hydra.sweep.dir={cell}", "++population=null"]
        (cell / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    return tmp_path


def test_variants_differ_in_more_than_the_seed(runs):
    """Six runs are two variants; means and deviations over the three seeds are those of the numbers."""
    cells = read_runs(runs)
    assert varied(cells) == ["model", "seed"]
    _, result = write_comparison(cells, runs)
    variants = read_result(result)["variants"]
    assert [entry["variant"] for entry in variants] == ["model=paper", "model=coulomb_viscous"]
    held = variants[0]["error_mrad.heldout"]
    assert held == {"value": 21.0, "deviation": 1.0, "count": 3}
    spread = variants[0]["parameters.coulomb_friction"]
    assert spread["deviation"] == pytest.approx(np.std([0.1, 0.11, 0.12], ddof=1))


def test_the_page_names_the_best_and_links_the_runs(runs):
    """The verdict is the variant with the least held-out error; every run's page is linked."""
    page, _ = write_comparison(read_runs(runs), runs)
    reader = PageReader(page.read_text())
    assert "Best variant by held-out error: model=paper." in reader.text
    assert "at its bound in 2 of 6 runs" in reader.text
    links = [value for tag, name, value in reader.attributes if tag == "a" and name == "href"]
    assert {f"{number}/index.html" for number in range(6)} <= set(links)


def test_one_run_has_no_spread(runs):
    """A single run is a variant of its own without a deviation."""
    _, result = write_comparison(read_runs(runs)[:1], runs)
    entry = read_result(result)["variants"][0]
    assert entry["variant"] == "all runs"
    assert entry["error_mrad.train"] == {"value": 10.0, "deviation": None, "count": 1}


def test_no_run_is_said(tmp_path):
    """An empty folder is refused with what to name instead."""
    with pytest.raises(ValueError, match="folder of a multirun"):
        read_runs(tmp_path)
