"""Benches: mixes, their seal, and other processes that diagnose."""

import sys
from pathlib import Path

import pytest
import yaml

from experiments.hidden_bench.bench import COST_FILE, draw_mix, read_cost, run_all, run_case, run_command
from op3.motions import leg_suite
from op3.stand_in.cases import TEST_SEEDS, answer_bytes, commit, draw_case
from op3.stand_in.suites import SETTINGS, Setting

MIX = {
    "robots": ["leg", "pendulum"],
    "singles": {"mild": 0, "clear": 1, "strong": 1},
    "effects": ["dte", "backlash"],
    "nulls": 3,
    "pairs": 2,
    "outsiders": 2,
    "poor": 1,
}


@pytest.fixture
def short(monkeypatch):
    """Legs are recorded in three short runs."""
    suite = lambda seed: leg_suite(seed, duration=0.25)[:3]  # noqa: E731
    monkeypatch.setitem(SETTINGS, "leg", Setting(SETTINGS["leg"].scene, suite, suite, 0.1))


def test_development_and_test_seeds_are_apart():
    """No case is in both sets, each case has its own seed, robots take turns, and the names say nothing."""
    development, test = draw_mix(MIX, "development"), draw_mix(MIX, "test")
    assert len(development) == 4 + 3 + 2 + 2 + 1
    assert len({case.seed for case in development}) == len(development)
    assert max(case.seed for case in development) < TEST_SEEDS <= min(case.seed for case in test)
    assert not {case.name for case in development} & {case.name for case in test}
    assert [sum(case.robot == robot for case in development) for robot in MIX["robots"]] == [6, 6]


def test_a_bench_of_other_ranges():
    """Robots of a bench are drawn from the ranges that it is given."""
    cases = draw_mix({**MIX, "robots": ["leg"]}, ranges={"velocity_lag": [0.03, 0.04]})
    assert all(0.03 <= case.world.velocity_lag <= 0.04 for case in cases)


def test_a_bench_keeps_its_commitment(tmp_path):
    """Sealing again changes nothing; other cases or a changed answer are refused."""
    cases = draw_mix({**MIX, "singles": {}})
    sealed = commit(cases, tmp_path).read_bytes()
    assert commit(cases, tmp_path).read_bytes() == sealed
    with pytest.raises(ValueError, match="another bench"):
        commit(cases[1:], tmp_path)
    changed = tmp_path / f"{cases[0].name}.yaml"
    changed.write_text(changed.read_text() + "# more\n")
    with pytest.raises(ValueError, match="a different answer"):
        commit(cases, tmp_path)


def test_a_bench_runs_another_process_once_per_case(tmp_path, short):
    """Every case gets data, model and a folder; a verdict that is there is not made again; a silent failure is None."""
    cases = [draw_case(seed, "single", "strong", name, robot="leg") for seed, name in ((1, "dte"), (2, "backlash"))]
    script = tmp_path / "fake.py"
    script.write_text(
        "import sys, pathlib\n"
        "data, model, run = map(pathlib.Path, sys.argv[1:])\n"
        "assert len(list(data.iterdir())) == 3\n"
        "if str(model) != 'paper_without_dte': sys.exit('cannot')\n"
        "(run / 'verdict.yaml').write_text('findings: []\\n')\n"
    )
    lines: list[str] = []
    command = [sys.executable, str(script), "{data}", "{model}", "{run}"]
    folder, answers = tmp_path / "cases", tmp_path / "answers"
    found = run_all(cases, folder, answers, command, timeout=60, keep_data=False, say=lines.append)
    assert len(lines) == 2
    assert [found[case.name] is not None for case in cases] == [case.base == "paper_without_dte" for case in cases]
    assert not list(Path(folder).glob("*/data"))
    verdict = found[cases[0].name]
    assert verdict is not None
    assert 0 < read_cost(verdict)["processor_seconds"] < 10
    made = verdict.stat().st_mtime_ns
    again = run_all(cases, folder, answers, command, timeout=60, say=lines.append)
    assert again[cases[0].name].stat().st_mtime_ns == made
    # one that may know the answer, beside the diagnosis
    tell = ["cp", "{answer}", "{run}/verdict.yaml"]
    told = run_case(cases[0], folder, answers, tell, timeout=60, keep_data=True, place="told")
    assert told is not None
    assert told == folder / cases[0].name / "told" / "verdict.yaml"
    assert told.read_bytes() == answer_bytes(cases[0])


def test_what_a_process_costs(tmp_path):
    """A process that fills 200 MB and works for a while is counted with both."""
    work = "x = bytearray(200_000_000)\nsum(range(10_000_000))"
    cost = run_command([sys.executable, "-c", work], tmp_path / "log", 60)
    assert cost.peak_memory > 2e8
    assert 0.05 < cost.processor_seconds <= cost.seconds + 0.2


def test_a_process_that_takes_too_long_is_stopped(tmp_path):
    """With the processes that it has started; its log says so."""
    cost = run_command(["sh", "-c", "echo begun; sleep 60 & wait"], tmp_path / "log", 1.0)
    assert cost.seconds < 10
    assert (tmp_path / "log").read_text() == "begun\n\nstopped after 1 s\n"


def test_costs_of_a_verdict_without_any(tmp_path):
    """Nothing is known of a verdict that stands alone."""
    assert read_cost(tmp_path / "verdict.yaml") == {}
    (tmp_path / COST_FILE).write_text(yaml.safe_dump({"seconds": 2.0}))
    assert read_cost(tmp_path / "verdict.yaml") == {"seconds": 2.0}
