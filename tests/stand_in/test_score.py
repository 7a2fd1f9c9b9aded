"""Scores of hand-made verdicts against numbers worked out by hand."""

import math

import numpy as np
import pytest
import yaml

from op3.robot import LEG_JOINTS
from op3.stand_in.score import (
    MISSING,
    Claim,
    Verdict,
    by_robot,
    calibration,
    closure,
    confusion,
    median,
    oracle_closure,
    random_name,
    rate,
    read_verdict,
    refit_only,
    score_case,
    score_ranking,
    summarise,
    wilson,
)


def answer(kind="single", *effects, severity="moderate"):
    """An answer that hides (name, joint or None, size)."""
    hidden = [
        {"name": name, "joints": [joint] if joint else list(LEG_JOINTS), "shared": joint is None, "size": size}
        for name, joint, size in effects
    ]
    return {"case": "c", "kind": kind, "severity": None if kind == "null" else severity, "effects": hidden}


BACKLASH = answer("single", ("backlash", "r_knee", 0.004))


def named(*claims, verdict="named", ranking=None):
    return Verdict(verdict, claims, ranking or claims)


def test_the_right_name_in_the_right_joint_counts_fully():
    """Name, joint, class, first three, size inside the interval: all right, and confidence 0.9 is not misleading."""
    claim = Claim("backlash", ("r_knee",), 0.005, (0.003, 0.006), 0.9)
    row = score_case(BACKLASH, named(claim))
    assert all(row[key] for key in ("detected", "named_right", "exact", "class", "top3", "joint", "right", "covered"))
    assert row["size_ratio"] == pytest.approx(1.25)  # 0.005 / 0.004
    assert row["confident_wrong"] is False


def test_the_right_name_in_the_wrong_joint_is_not_exact():
    """The name is right, the joint is not; at 0.9 this misleads."""
    row = score_case(BACKLASH, named(Claim("backlash", ("r_hip_pitch",), 0.004, (0.003, 0.005), 0.9)))
    assert row["named_right"] is True
    assert row["exact"] is row["joint"] is row["class"] is False
    assert row["covered"] is None
    assert row["confident_wrong"] is True


@pytest.mark.parametrize(("confidence", "misleads"), [(0.9, True), (0.6, False)])
def test_a_further_name_misleads_as_the_first_does(confidence, misleads):
    """The hidden effect is named first; a second that is not hidden is wrong with the confidence that it states."""
    right = Claim("backlash", ("r_knee",), 0.004, (0.003, 0.005), 0.95)
    row = score_case(BACKLASH, named(right, Claim("lugre", ("r_hip_pitch",), confidence=confidence)))
    assert row["exact"] is True
    assert row["confident_wrong"] is misleads


def test_an_alias_counts_only_where_it_is_called_ambiguous():
    """`compliance` before `backlash` is right as a class when the verdict is ambiguous, and wrong when named."""
    wrong, true = Claim("compliance", ("r_knee",), confidence=0.6), Claim("backlash", ("r_knee",), confidence=0.4)
    ambiguous = score_case(BACKLASH, named(wrong, true, verdict="ambiguous"))
    assert (ambiguous["exact"], ambiguous["class"], ambiguous["top3"]) == (False, True, True)
    sure = score_case(BACKLASH, named(wrong, ranking=(wrong, true)))
    assert (sure["exact"], sure["class"], sure["top3"]) == (False, False, True)


def test_a_rank_beyond_three_does_not_count():
    """Fourth place is too late."""
    ranking = (*(Claim(name) for name in ("a", "b", "c")), Claim("backlash", ("r_knee",)))
    assert score_case(BACKLASH, named(Claim("a"), ranking=ranking))["top3"] is False


@pytest.mark.parametrize(
    ("verdict", "alarm", "name"),
    [("nothing_missing", False, False), ("unknown", True, False), ("named", True, True), ("ambiguous", True, True)],
)
def test_what_alarms_an_empty_case(verdict, alarm, name):
    """Everything but `nothing_missing` is a false alarm; only names are false names."""
    claims = (Claim("dte", (), None, None, 0.95),) if verdict in ("named", "ambiguous") else ()
    row = score_case(answer("null"), Verdict(verdict, claims))
    assert row["alarm"] is alarm
    assert row["false_name"] is name
    assert row["confident_wrong"] is name
    assert row["exact"] is None
    assert row["detected"] is None


def test_outsiders_should_be_unknown():
    """A name for what no catalogue holds is wrong, and misleading when sure."""
    outsider = answer("outsider", ("creep", "r_knee", 0.5))
    assert score_case(outsider, Verdict("unknown"))["unknown_right"] is True
    row = score_case(outsider, named(Claim("viscous", ("r_knee",), confidence=0.85)))
    assert row["unknown_right"] is False
    assert row["confident_wrong"] is True


def test_pairs_need_both_names():
    """One of two is one; both, in any order, are both; listing both as alternatives is not naming both."""
    pair = answer("pair", ("dte", None, 0.25), ("backlash", "r_knee", 0.004))
    dte, gap = Claim("dte"), Claim("backlash", ("r_knee",))
    assert [score_case(pair, named(dte))[key] for key in ("both", "one")] == [False, True]
    assert [score_case(pair, named(gap, dte))[key] for key in ("both", "one")] == [True, True]
    assert score_case(pair, named(gap, dte, verdict="ambiguous"))["both"] is False


def test_a_second_name_that_is_not_hidden_is_counted():
    """Right first and wrong second is exact, and says too much; a list of candidates is no such claim."""
    right, wrong = Claim("backlash", ("r_knee",)), Claim("dte")
    row = score_case(BACKLASH, named(right, wrong))
    assert (row["exact"], row["extra"]) == (True, True)
    assert score_case(BACKLASH, named(right))["extra"] is False
    assert score_case(BACKLASH, named(right, wrong, verdict="ambiguous"))["extra"] is False


def test_shared_is_all_joints():
    """No joints, and all six, both mean everywhere."""
    shared = answer("single", ("dte", None, 0.25))
    assert score_case(shared, named(Claim("dte")))["exact"] is True
    assert score_case(shared, named(Claim("dte", ("r_knee",))))["exact"] is False


def test_wilson_agrees_with_published_values():
    """0 of 120 proves less than 3.1 % (two-sided 95 %); 3 of 120 gives [0.9, 7.1] %; 1 of 2 is [9.5, 90.5] %."""
    assert wilson(0, 120) == pytest.approx((0.0, 3.8415 / (120 + 3.8415)), abs=1e-4)
    assert wilson(3, 120) == pytest.approx((0.00854, 0.0709), abs=3e-4)
    assert wilson(1, 2) == pytest.approx((0.0945, 0.9055), abs=1e-3)
    assert rate([True, None, False]) == {
        "value": 0.5, "low": pytest.approx(0.0945, abs=1e-3), "high": pytest.approx(0.9055, abs=1e-3), "count": 1,
        "of": 2,
    }  # fmt: skip
    assert rate([None]) is None


def test_calibration_by_hand():
    """Claims 0.9 right, 0.9 wrong, 0.3 wrong. Upper bin: |0.9 - 0.5| of 2; lower: |0.3 - 0| of 1; ECE = (0.8 + 0.3)/3.
    Brier = (0.01 + 0.81 + 0.09)/3."""
    values = calibration([0.9, 0.9, 0.3], [True, False, False])
    assert values["ece"] == pytest.approx(1.1 / 3)
    assert values["brier"] == pytest.approx(0.91 / 3)
    assert values["reliability"] == [[pytest.approx(0.3), 0.0, 1], [pytest.approx(0.9), 0.5, 2]]
    assert calibration([], [])["ece"] is None


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
    """Three singles (exact, wrong joint, no verdict), two nulls (one alarm), one outsider called unknown."""
    rows = [
        score_case(BACKLASH, named(Claim("backlash", ("r_knee",), 0.004, (0.003, 0.005), 0.9))),
        score_case(BACKLASH, named(Claim("backlash", ("r_ank_pitch",), confidence=0.5))),
        score_case(BACKLASH, Verdict(MISSING)),
        score_case(answer("null"), Verdict("nothing_missing")),
        score_case(answer("null"), named(Claim("dte", confidence=0.7))),
        score_case(answer("outsider", ("creep", "r_knee", 1.0)), Verdict("unknown")),
    ]
    summary = summarise(rows)
    shares = {key: (summary[key]["count"], summary[key]["of"]) for key in
              ("top1_name", "top1_exact", "joint_localisation", "false_alarms", "outsiders_unknown", "detection",
               "confident_wrong", "size_coverage")}  # fmt: skip
    assert shares == {
        "top1_name": (2, 3), "top1_exact": (1, 3), "joint_localisation": (1, 2), "false_alarms": (1, 2),
        "outsiders_unknown": (1, 1), "detection": (2, 3), "confident_wrong": (0, 6), "size_coverage": (1, 1),
    }  # fmt: skip
    assert summary["failed"] == 1
    assert summary["pairs_both"] is None
    assert summary["by_severity.moderate"]["top1_exact"]["of"] == 3
    truths, claims, counts = confusion(rows)
    assert truths == ["backlash", "creep", "nothing"]
    assert claims == ["backlash", "dte", MISSING, "nothing_missing", "unknown"]
    assert counts.tolist() == [[2, 0, 1, 0, 0], [0, 0, 0, 0, 1], [0, 1, 0, 1, 0]]


def test_baselines_do_what_they_say():
    """Tuning the base never alarms and never names; a random name is right about once in as many as there are."""
    assert score_case(answer("null"), refit_only())["alarm"] is False
    assert score_case(BACKLASH, refit_only())["detected"] is False
    rng, names = np.random.default_rng(0), ["backlash", *"abcdefghi"]
    right = sum(score_case(BACKLASH, random_name(BACKLASH, names, rng))["named_right"] for _ in range(1000))
    assert right == pytest.approx(100, abs=4 * math.sqrt(90))


def test_the_score_ranking_takes_the_largest_statistic():
    """The order of the ranking does not count, and entries without a statistic are passed over."""
    ranking = (Claim("dte"), Claim("coulomb", score=3.0), Claim("backlash", ("r_knee",), score=8.0))
    verdict = score_ranking(Verdict("nothing_missing", (), ranking))
    assert verdict is not None
    assert score_case(BACKLASH, verdict)["exact"] is True
    assert score_ranking(refit_only()) is None


def test_a_verdict_file_reads_back(tmp_path):
    """Joints may be a name or a list; a trunk's effect in one joint is the link's; an efficiency becomes a ratio.

    1/0.8 - 1 = 0.25, and the interval [0.75, 0.85] becomes [0.176, 0.333].
    """
    path = tmp_path / "verdict.yaml"
    effects = [
        {"name": "payload", "joints": "r_ank_roll", "size": 0.05, "unit": "kg", "interval": [0.04, 0.06]},
        {"name": "dte", "joints": list(LEG_JOINTS), "size": 0.8, "parameter": "backward_efficiency",
         "interval": [0.75, 0.85], "confidence": 0.7},
        {"name": "stribeck", "size": 0.1, "parameter": "stribeck_velocity"},
    ]  # fmt: skip
    path.write_text(yaml.safe_dump({"verdict": "named", "effects": effects, "ranking": effects[:1]}))
    verdict = read_verdict(path)
    assert verdict.claims[0] == Claim("link_mass", ("r_ank_roll",), 0.05, (0.04, 0.06))
    assert verdict.claims[1].joints == ()
    assert verdict.claims[1].size == pytest.approx(0.25)
    assert verdict.claims[1].interval == pytest.approx((1 / 0.85 - 1, 1 / 0.75 - 1))
    assert verdict.claims[2].size is None
    assert len(verdict.ranking) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("verdict: maybe", "write `verdict:` with one of"),
        ("verdict: named", "`effects` is empty"),
        ("verdict: named\neffects: [{joints: []}]", "has no name"),
        ("verdict: named\neffects: [{name: dte, confidence: 80}]", "not within 0 and 1"),
        ("verdict: named\neffects: [{name: dte, size: 1, interval: 3}]", "not \\[low, high\\]"),
        ("verdict: [", "not valid YAML"),
    ],
)
def test_a_wrong_verdict_file_is_refused(tmp_path, text, message):
    """Each refusal names the file and what is wrong."""
    path = tmp_path / "verdict.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"verdict.yaml.*{message}"):
        read_verdict(path)


def test_the_oracle_sets_the_scale_of_the_gap():
    """Position 10 -> 4 where the oracle reaches 2, current untouched by both: (0.6 + 0) / (0.8 + 0) = 0.75."""
    gap = {"joint/position": {"before": 10.0, "after": 4.0}, "joint/current": {"before": 1.0, "after": 1.0}}
    best = {"joint/position": {"before": 10.0, "after": 2.0}, "joint/current": {"before": 1.0, "after": 1.0}}
    assert oracle_closure(gap, best) == pytest.approx(0.75)
    assert oracle_closure(best, best) == pytest.approx(1.0)
    assert oracle_closure(gap, {"joint/position": {"before": 10.0, "after": 9.95}}) is None


def test_a_median_carries_an_interval():
    """Of 1 to 9 the middle is 5; the interval holds it and is not a point. Nothing gives nothing."""
    found = median([float(value) for value in range(1, 10)])
    assert found is not None
    assert found["value"] == 5.0
    assert found["low"] < 5.0 < found["high"]
    assert median([]) is None


def test_cases_of_the_whole_robot_are_counted_apart():
    """An answer without a robot is of a leg."""
    rows = [score_case(answer("null"), Verdict("nothing_missing"))]
    rows += [score_case({**answer("null"), "robot": "op3"}, Verdict("unknown"))]
    legs, whole = by_robot(rows)
    assert [row["alarm"] for row in legs] == [False]
    assert [row["alarm"] for row in whole] == [True]
