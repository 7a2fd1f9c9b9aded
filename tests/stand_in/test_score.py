"""Scores of hand-made verdicts against numbers worked out by hand."""

import math

import numpy as np
import pytest
import yaml

from experiments.hidden_bench.score import (
    BenchFinding,
    BenchVerdict,
    calibration,
    closure,
    median,
    random_name,
    rate,
    read_verdict,
    score_case,
    summarise,
)
from op3.common.sample_intervals import wilson_interval
from tests.op3_table import LEG_JOINTS


def answer(kind="single", *effects, severity="clear"):
    """An answer that hides (name, joint or None, size)."""
    hidden = [
        {"name": name, "joints": [joint] if joint else list(LEG_JOINTS), "shared": joint is None, "size": size}
        for name, joint, size in effects
    ]
    return {"case": "c", "kind": kind, "severity": None if kind == "null" else severity, "effects": hidden}


BACKLASH = answer("single", ("backlash", "r_knee", 0.004))
RIGHT = BenchFinding("backlash", ("r_knee",), 0.9, 0.005, (0.003, 0.006))


def test_the_right_name_in_the_right_joint_counts_fully():
    """Name, joint, family, size inside the interval: all right, and 0.9 is not misleading."""
    row = score_case(BACKLASH, BenchVerdict((RIGHT,)))
    assert all(row[key] for key in ("exact", "name", "joints", "family", "clean", "covered"))
    assert row["size_ratio"] == pytest.approx(1.25)  # 0.005 / 0.004
    assert row["confident_wrong"] is False
    assert row["stated"] == [[0.9, True]]


def test_the_right_name_in_the_wrong_joint_is_not_exact():
    """The name is right, the joint is not; at 0.9 this misleads."""
    row = score_case(BACKLASH, BenchVerdict((BenchFinding("backlash", ("r_hip_pitch",), 0.9),)))
    assert row["name"] is True
    assert row["exact"] is row["joints"] is row["family"] is row["clean"] is False
    assert row["confident_wrong"] is True


@pytest.mark.parametrize(("probability", "misleads"), [(0.85, True), (0.6, False)])
def test_a_further_name_misleads_as_the_first_does(probability, misleads):
    """The hidden effect is named first; a second that is not hidden is a wrong name, as sure as it is stated."""
    row = score_case(BACKLASH, BenchVerdict((RIGHT, BenchFinding("lugre", ("r_hip_pitch",), probability))))
    assert row["exact"] is True
    assert row["clean"] is False
    assert row["confident_wrong"] is misleads


def test_an_alternative_is_in_the_family():
    """`compliance` that could be `backlash` is right as a family and not by name; so is one joint for another."""
    wrong = BenchFinding("compliance", ("r_knee",), 0.6, others=(BenchFinding("backlash", ("r_knee",), 0.4),))
    row = score_case(BACKLASH, BenchVerdict((wrong,)))
    assert (row["exact"], row["family"]) == (False, True)


def test_a_hint_is_no_name():
    """What is not more likely than not, as all is on a base in doubt, names nothing, and counts in the calibration."""
    row = score_case(answer("null"), BenchVerdict((BenchFinding("dte", (), 0.5),)))
    assert row["named"] is False
    assert row["stated"] == [[0.5, False]]
    assert score_case(answer("null"), BenchVerdict((BenchFinding("dte", (), 0.7),)))["named"] is True


def test_an_unusual_base_is_no_name():
    """That the latency is far from usual is a name where more of it is hidden, and passed over where none is."""
    latency = BenchFinding("latency", (), 0.95, of_base=True)
    assert score_case(answer("null"), BenchVerdict((latency,)))["named"] is False
    assert score_case(answer("single", ("latency", None, 0.006)), BenchVerdict((latency,)))["exact"] is True


def test_an_outsider_has_no_name():
    """Whatever is named for it is wrong, and misleading when sure."""
    outsider = answer("outsider", ("creep", "r_knee", 0.5))
    assert score_case(outsider, BenchVerdict())["named"] is False
    row = score_case(outsider, BenchVerdict((BenchFinding("viscous", ("r_knee",), 0.85),)))
    assert row["named"] is row["confident_wrong"] is True
    assert row["exact"] is None


def test_pairs():
    """One of two without a wrong name is one; both, in any order, are both; a wrong name spoils the one."""
    pair = answer("pair", ("dte", None, 0.25), ("backlash", "r_knee", 0.004))
    dte, wrong = BenchFinding("dte", (), 0.8), BenchFinding("viscous", (), 0.6)
    for findings, both, one in (((dte,), False, True), ((RIGHT, dte), True, True), ((dte, wrong), False, False)):
        row = score_case(pair, BenchVerdict(findings))
        assert (row["both"], row["one"]) == (both, one)


def test_a_rate_counts_only_what_was_asked():
    """One of two is half; without anything asked there is no rate."""
    found = rate([True, None, False])
    assert found is not None
    assert (found["value"], found["count"], found["of"]) == (0.5, 1, 2)
    assert rate([None]) is None


def test_calibration_by_hand():
    """0.9 right, 0.9 wrong, 0.3 wrong. Upper fifth: |0.9 - 0.5| of 2; lower: |0.3 - 0| of 1; ECE = (0.8 + 0.3)/3."""
    values = calibration([[0.9, True], [0.9, False], [0.3, False]])
    assert values["ece"] == pytest.approx(1.1 / 3)
    lower, upper = values["reliability"]
    assert (lower[0], lower[1], lower[4]) == (pytest.approx(0.3), 0.0, 1)
    assert (upper[0], upper[1], upper[4]) == (pytest.approx(0.9), 0.5, 2)
    assert (upper[2], upper[3]) == wilson_interval(1, 2)
    assert calibration([])["ece"] is None


def test_closure_by_hand():
    """(10 - 4)/(10 - 2) = 0.75 and (1 - 1)/(1 - 0.5) = 0; mean 0.375. A channel at its floor says nothing."""
    gap = {
        "joint/position": {"before": 10.0, "after": 4.0, "floor": 2.0},
        "joint/current": {"before": 1.0, "after": 1.0, "floor": 0.5},
        "joint/velocity": {"before": 0.5, "after": 0.5, "floor": 0.5},
    }
    assert closure(gap) == pytest.approx(0.375)
    assert closure({}) is None


def test_a_summary_by_hand():
    """Three singles (exact, wrong joint, no verdict), two sound robots (one named), one outsider left alone."""
    cost = {"seconds": 40.0, "processor_seconds": 50.0, "peak_memory": 9e8}
    rows = [
        score_case(BACKLASH, BenchVerdict((RIGHT,)), cost),
        score_case({**BACKLASH, "severity": "mild"}, BenchVerdict((BenchFinding("backlash", ("r_ank_pitch",), 0.6),))),
        score_case(BACKLASH, BenchVerdict(failed=True)),
        score_case(answer("null"), BenchVerdict()),
        score_case(answer("null"), BenchVerdict((BenchFinding("dte", (), 0.7),))),
        score_case(answer("outsider", ("creep", "r_knee", 1.0)), BenchVerdict()),
    ]
    summary = summarise(rows)
    counted = {key: (summary[key]["count"], summary[key]["of"]) for key in
               ("clear_exact", "mild_exact", "name", "joints", "sound_named", "outsiders_named", "confident_wrong",
                "size_coverage")}  # fmt: skip
    assert counted == {
        "clear_exact": (1, 2), "mild_exact": (0, 1), "name": (2, 3), "joints": (1, 2), "sound_named": (1, 2),
        "outsiders_named": (0, 1), "confident_wrong": (0, 6), "size_coverage": (1, 1),
    }  # fmt: skip
    assert summary["failed"] == 1
    assert summary["pairs_both"] is summary["strong_exact"] is None
    assert summary["seconds_median"]["value"] == 40.0


def test_a_random_name_is_right_now_and_then():
    """About once in as many as there are names."""
    rng, names = np.random.default_rng(0), ["backlash", *"abcdefghi"]
    right = sum(score_case(BACKLASH, random_name(names, LEG_JOINTS, rng))["name"] for _ in range(1000))
    assert right == pytest.approx(100, abs=4 * math.sqrt(90))


def test_a_verdict_file_reads_back(tmp_path):
    """The most probable first; joints a name or a list, all of them everywhere; a trunk's effect in a joint is the
    link's; a size in another parameter is none of ours."""
    path = tmp_path / "verdict.yaml"
    findings = [
        {"effect": "payload", "joints": "r_ank_roll", "size": 0.05, "interval": [0.04, 0.06], "probability": 0.6,
         "alternatives": [{"effect": "link_com", "joints": ["r_ank_roll"]}]},
        {"effect": "dte", "joints": list(LEG_JOINTS), "size": 0.8, "parameter": "backward_efficiency",
         "interval": [0.75, 0.85], "probability": 0.7},
        {"effect": "stribeck", "size": 0.1, "parameter": "stribeck_velocity", "probability": 0.5},
    ]  # fmt: skip
    path.write_text(yaml.safe_dump({"findings": findings}))
    dte, mass, stribeck = read_verdict(path, LEG_JOINTS).findings
    assert dte == BenchFinding("dte", (), 0.7, 0.8, (0.75, 0.85))
    assert (mass.name, mass.joints, mass.size, mass.interval) == ("link_mass", ("r_ank_roll",), 0.05, (0.04, 0.06))
    assert mass.others == (BenchFinding("link_com", ("r_ank_roll",), 0.0),)
    assert stribeck.size is None
    truth = answer("single", ("dte", None, 0.25))  # an efficiency of 0.8
    assert score_case(truth, BenchVerdict((dte,)))["covered"] is True


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("verdict: maybe", "write `findings:` with a list"),
        ("findings: [{joints: []}]", "has no `effect`"),
        ("findings: [{effect: dte, probability: 80}]", "must be a number between 0 and 1, got 80"),
        ("findings: [{effect: dte}]", "probability of dte must be a number between 0 and 1, got None"),
        ("findings: [{effect: dte, probability: 1, size: 1, interval: 3}]", "must be \\[low, high\\], got 3"),
        ("findings: [", "not valid YAML"),
    ],
)
def test_a_wrong_verdict_file_is_refused(tmp_path, text, message):
    """Each refusal names the file and what is wrong."""
    path = tmp_path / "verdict.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"verdict.yaml.*{message}"):
        read_verdict(path, LEG_JOINTS)


def test_a_median_carries_an_interval():
    """Of 1 to 9 the middle is 5; the interval holds it and is not a point. Nothing gives nothing."""
    found = median([float(value) for value in range(1, 10)])
    assert found is not None
    assert found["value"] == 5.0
    assert found["low"] < 5.0 < found["high"]
    assert median([]) is None
