"""Provenance: the facts are there, and no path that nobody gave."""

import sys
from pathlib import Path

import op3.report.provenance as module
from op3.report import read_result, run_provenance, write_result


def test_facts_go_into_a_result(tmp_path):
    """Provenance is plain data, with seed, versions and machine."""
    facts = run_provenance(seed=3, data=["a.csv", "b.csv"])
    found = read_result(write_result(tmp_path / "result.yaml", {"provenance": facts}))
    assert found["provenance.seed"] == 3
    assert found["provenance.data"] == "a.csv, b.csv"
    assert found["provenance.versions.mujoco"].startswith("3.")
    assert found["provenance.machine.cpu_count"] >= 1


def test_the_script_is_named_without_the_folders_above_it(monkeypatch, tmp_path):
    """An absolute script path is shown from where one stands, arguments as typed; no path of the machine appears."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(tmp_path / "experiments" / "identify.py"), "data=my logs/a"])
    assert run_provenance()["command"] == "python experiments/identify.py 'data=my logs/a'"
    monkeypatch.setattr(sys, "argv", ["/somewhere/else/identify.py"])
    facts = run_provenance()
    assert facts["command"] == "python identify.py"
    assert str(Path(module.__file__).parents[2]) not in str(facts)
    assert sys.prefix not in str(facts)


def test_the_code_is_named_or_unknown(monkeypatch):
    """Commit and changes stand in the facts; outside a repository of its own the code is unknown."""
    monkeypatch.setattr(module, "git_hash", lambda: "abc")
    monkeypatch.setattr(module, "git_changes", lambda: True)
    assert run_provenance().items() >= {"git_hash": "abc", "git_changes": True}.items()
    monkeypatch.setattr(module, "git_hash", lambda: None)
    facts = run_provenance()
    assert facts["git_hash"] == "unknown"
    assert "git_changes" not in facts
