"""Cases: drawn from seeds, sealed before they are opened, told by nothing that the diagnosis sees."""

import dataclasses
import hashlib
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from op3.robot import JOINTS, LEG_JOINTS, leg_suite, leg_walking, robot_suite
from op3.rollout import read_logs
from op3.stand_in import CATALOGUE, OUTSIDERS, Hidden, draw_case, make_case, open_answers, record_leg, seal
from op3.stand_in.bench import commit, draw_mix, run_all, run_beside, run_policy
from op3.stand_in.cases import ALIAS_PAIRS, BASES, TEST_SEEDS, answer_bytes, write_answer
from op3.stand_in.world import World

MIX = {
    "singles": {"mild": 0, "moderate": 1, "strong": 1},
    "effects": ["dte", "backlash"],
    "nulls": 3,
    "pairs": 2,
    "outsiders": 2,
    "poor": 1,
}


def test_a_case_is_what_its_seed_says():
    """Equal seeds and wishes give equal answers, byte by byte; another seed another case."""
    assert answer_bytes(draw_case(4, "pair", "strong")) == answer_bytes(draw_case(4, "pair", "strong"))
    assert answer_bytes(draw_case(4, "pair", "strong")) != answer_bytes(draw_case(5, "pair", "strong"))


@pytest.mark.parametrize("seed", range(40))
def test_kinds_hide_what_they_say(seed):
    """One, two, none, an outsider; a base model lacks exactly the effect of `BASES` that is hidden, if any is."""
    names = {kind: [h.name for h in draw_case(seed, kind, "strong").truth.hidden] for kind in ("single", "pair")}
    assert len(names["single"]) == 1
    assert len(set(names["pair"])) == 2
    assert set(names["single"] + names["pair"]) <= set(CATALOGUE)
    assert not {"backlash", "compliance"} <= set(names["pair"])
    assert draw_case(seed, "null").truth.hidden == ()
    assert draw_case(seed, "null").truth == draw_case(seed, "null").bare
    assert draw_case(seed, "outsider", "strong").truth.hidden[0].name in OUTSIDERS
    for kind in names:
        case = draw_case(seed, kind, "strong")
        lacking = [name for name in names[kind] if name in BASES]
        assert len(lacking) <= 1
        assert not lacking or case.base == BASES[lacking[0]]


def test_the_base_model_does_not_give_the_answer_away():
    """Cases that hide nothing start from models with and without dte, stribeck and latency, as the robot has them."""
    cases = [draw_case(seed, "null") for seed in range(200)]
    assert {case.base for case in cases} == {"paper", *BASES.values()}
    for case in cases:
        world = case.truth.world
        assert (world.backward_efficiency == 1.0) == (case.base == "paper_without_dte")
        assert (world.static_friction_excess == 0.0) == (case.base == "paper_without_stribeck")
        assert (world.command_latency == 0.0) == (case.base == "paper_without_latency")


def test_half_of_the_pairs_look_alike():
    """Between a third and two thirds of random pairs are of effects that are mistaken for each other."""
    drawn = [{hidden.name for hidden in draw_case(seed, "pair").truth.hidden} for seed in range(300)]
    alike = sum(any(set(pair) == names for pair in ALIAS_PAIRS) for names in drawn)
    assert 100 < alike < 200


def test_sizes_follow_the_severity():
    """dte of 0.1 is the smallest that matters: mild is 0.9 to 1.1 times that, strong five times as much."""
    sizes = {
        severity: draw_case(7, "single", severity, "dte").truth.hidden[0].size
        for severity in ("mild", "moderate", "strong")
    }
    assert 0.09 <= sizes["mild"] <= 0.11
    assert sizes["moderate"] == pytest.approx(2.5 * sizes["mild"])
    assert sizes["strong"] == pytest.approx(5 * sizes["mild"])
    assert draw_case(7, "single", "strong", "dte").truth.world.backward_efficiency == pytest.approx(
        1 / (1 + sizes["strong"])
    )
    assert draw_case(7, "single", "strong", "dte", scale=0.0).truth.world == draw_case(7, effect="dte").bare.world


def test_sealed_answers_open_only_unchanged(tmp_path):
    """The file lists the SHA-256 of each answer; a changed, added or missing answer is refused by name."""
    paths = [write_answer(draw_case(seed), tmp_path) for seed in (1, 2)]
    commitment = seal(tmp_path).read_text()
    assert hashlib.sha256(paths[0].read_bytes()).hexdigest() + "  " + paths[0].name in commitment
    assert set(open_answers(tmp_path)) == {path.stem for path in paths}
    content = paths[0].read_bytes()
    paths[0].write_bytes(content.replace(b"seed: 1", b"seed: 9"))
    with pytest.raises(ValueError, match=f"{paths[0].name} was changed"):
        open_answers(tmp_path)
    paths[0].unlink()
    with pytest.raises(ValueError, match="sealed but gone"):
        open_answers(tmp_path)
    paths[0].write_bytes(content)
    write_answer(draw_case(3), tmp_path)
    with pytest.raises(ValueError, match="never sealed"):
        open_answers(tmp_path)


def test_development_and_test_seeds_are_apart():
    """No case is in both sets, each case has its own seed, and the names say nothing."""
    development, test = draw_mix(MIX, "development"), draw_mix(MIX, "test")
    assert len(development) == 4 + 3 + 2 + 2 + 1
    assert len({case.seed for case in development}) == len(development)
    assert max(case.seed for case in development) < TEST_SEEDS <= min(case.seed for case in test)
    assert not {case.name for case in development} & {case.name for case in test}


def test_a_bench_keeps_its_commitment(tmp_path):
    """Sealing again changes nothing; other cases or a changed answer are refused."""
    cases = draw_mix(MIX)
    sealed = commit(cases, tmp_path).read_bytes()
    assert commit(cases, tmp_path).read_bytes() == sealed
    with pytest.raises(ValueError, match="another bench"):
        commit(cases[1:], tmp_path)
    changed = tmp_path / f"{cases[0].name}.yaml"
    changed.write_text(changed.read_text() + "# more\n")
    with pytest.raises(ValueError, match="another answer"):
        commit(cases, tmp_path)


@pytest.fixture
def short(monkeypatch):
    """Suites of four short runs."""
    monkeypatch.setattr("op3.stand_in.cases.leg_suite", lambda seed: leg_suite(seed, duration=0.25)[:4])
    monkeypatch.setattr("op3.stand_in.cases.leg_walking", lambda seed: leg_walking(seed, duration=0.25, runs=3))


def test_the_logs_tell_nothing_but_what_sensors_say(tmp_path, short):
    """A case's folder holds logs that read back and the base model; no seed, size or name of what is hidden."""
    case = draw_case(1, "single", "strong", "backlash")
    place = make_case(case, tmp_path / "cases", tmp_path / "answers")
    logs = read_logs(place / "data")
    assert len(logs) == 4
    assert logs[0].joints == LEG_JOINTS
    assert logs[0].metadata.seed is None
    for log in logs:
        log.check()
    given = yaml.safe_load((place / "case.yaml").read_text())
    assert given == {"case": case.name, "base": case.base}
    texts = "".join(path.read_text() for path in place.rglob("*.yaml"))
    assert "backlash" not in texts
    assert answer_bytes(case) == (tmp_path / "answers" / f"{case.name}.yaml").read_bytes()
    again = record_leg(case.truth, leg_suite(1, duration=0.25)[:4], 1, case.name)
    assert np.array_equal(again[2].array("joint/current"), logs[2].array("joint/current"))


def test_a_bench_runs_another_process_once_per_case(tmp_path, short):
    """Every case gets data, model and a folder; a verdict that is there is not made again; a silent failure is None."""
    cases = draw_mix({**MIX, "singles": {"strong": 1}, "effects": ["dte"], "nulls": 1, "pairs": 0, "outsiders": 0,
                      "poor": 0})  # fmt: skip
    script = tmp_path / "fake.py"
    script.write_text(
        "import sys, pathlib\n"
        "data, model, run = map(pathlib.Path, sys.argv[1:])\n"
        "assert len(list(data.iterdir())) == 4\n"
        "if str(model) != 'paper_without_dte': sys.exit('cannot')\n"
        "(run / 'verdict.yaml').write_text('verdict: nothing_missing\\n')\n"
    )
    lines: list[str] = []
    command = ["python3", str(script), "{data}", "{model}", "{run}"]
    folder, answers = tmp_path / "cases", tmp_path / "answers"
    found = run_all(cases, folder, answers, command, timeout=60, keep_data=False, say=lines.append)
    assert len(lines) == 2
    assert [found[case.name] is not None for case in cases] == [case.base == "paper_without_dte" for case in cases]
    assert not list(Path(folder).glob("*/data"))
    made = {name: path.stat().st_mtime_ns for name, path in found.items() if path}
    assert made
    again = run_all(cases, folder, answers, command, timeout=60, say=lines.append)
    assert {name: path.stat().st_mtime_ns for name, path in again.items() if path} == made


def test_the_whole_robot_hides_effects_in_either_leg():
    """Its cases have twenty joints; one seed hides the same on the leg, in the right leg alone."""
    cases = [draw_case(seed, "single", "strong", "backlash", robot="op3") for seed in range(20)]
    places = {case.truth.hidden[0].joints[0][:2] for case in cases}
    assert places == {"l_", "r_"}
    assert all(case.truth.joints == JOINTS for case in cases)
    for seed, case in enumerate(cases):
        leg = draw_case(seed, "single", "strong", "backlash").truth.hidden[0]
        assert leg.size == case.truth.hidden[0].size
        assert leg.joints[0][2:] == case.truth.hidden[0].joints[0][2:]


def test_the_whole_robot_is_recorded_with_what_is_hidden():
    """An encoder offset in the left knee shows in the left knee alone, where the robot holds still."""
    case = draw_case(3, "null", robot="op3")
    hidden = Hidden("encoder_offset", 0.05, ("l_knee",))
    suite = robot_suite(3, duration=0.4)[:1]
    shifted = dataclasses.replace(case.truth, hidden=(hidden,))
    plain, moved = (record_leg(truth, suite, 3)[0] for truth in (case.truth, shifted))
    assert plain.joints == JOINTS
    apart = np.abs(moved.array("joint/current") - plain.array("joint/current")).max(0)
    assert apart[JOINTS.index("l_knee")] > 5 * apart[JOINTS.index("r_knee")]
    assert len(leg_suite(3)) == len(robot_suite(3, duration=0.4))


def test_processes_beside_the_diagnosis_are_told_where_things_are(tmp_path):
    """The answer's file, the logs and the result's folder are handed over; a result that is there is kept."""
    case = draw_case(5, "null")
    (tmp_path / "cases" / case.name / "data").mkdir(parents=True)
    write_answer(case, tmp_path / "answers")
    script = "import sys; open(sys.argv[2] + '/out.yaml', 'a').write(open(sys.argv[1]).read())"
    command = [sys.executable, "-c", script, "{answer}", "{beside}"]
    for _ in range(2):
        path = run_beside(case, tmp_path / "cases", tmp_path / "answers", command, "other/out.yaml", 60.0, True)
        assert path == tmp_path / "cases" / case.name / "other" / "out.yaml"
        assert path.read_bytes() == answer_bytes(case)
    assert run_beside(case, tmp_path / "cases", tmp_path / "answers", ["true"], "none.yaml", 60.0, True) is None


def test_a_policy_runs_in_the_truth_where_a_world_holds_it(tmp_path):
    """A hidden dte is part of the world that is handed over; backlash is not, and a leg does not balance."""
    script = "import os, sys; os.makedirs(sys.argv[2] + '/0'); open(sys.argv[2] + '/0/metadata.yaml', 'w')"
    command = [sys.executable, "-c", script, "{world}", "{run}"]
    lossy = draw_case(6, "single", "strong", "dte", robot="op3")
    episodes = run_policy(lossy, tmp_path, command, 60.0)
    assert episodes is not None
    assert World.load(episodes / "world.yaml") == lossy.truth.world
    assert run_policy(draw_case(6, "single", "strong", "backlash", robot="op3"), tmp_path, command, 60.0) is None
    assert run_policy(draw_case(6, "single", "strong", "dte"), tmp_path, command, 60.0) is None
