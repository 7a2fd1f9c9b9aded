"""What several rounds of a diagnosis add up to."""

import dataclasses
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from op3.diagnose import Diagnosis, WindowResiduals, planned_suite, split_logs
from op3.diagnose import settle as settling
from op3.diagnose.coordinates import base_coordinates, with_chain
from op3.diagnose.evidence import Contender, Own
from op3.diagnose.fitting import Fit, linearise, polish, refit
from op3.diagnose.hypotheses import hypotheses
from op3.diagnose.refits import _leaders
from op3.diagnose.screen import Screened
from op3.diagnose.settle import Candidate, as_in, merged, settle
from op3.diagnose.verdict import Finding, Verdict
from op3.robot import leg_suite
from op3.servo import Estimate, effect_class
from op3.sim import load_model


def finding(name: str, joint: str, size: float, more: float, confidence: float = 1.0) -> Finding:
    return Finding(name, (joint,), False, size, "", (size, size), confidence, {"number": more}, 0.1, "number")


def test_an_effect_is_told_once_in_its_place():
    """What a later round finds of an effect is the whole of it; to what the model had before, both are added."""
    paper = load_model("paper")
    found = [
        finding("viscous", "a", 0.09, 0.09, 0.99),
        finding("lugre", "a", 0.018, 0.018),
        finding("viscous", "b", 0.05, 0.05),
        finding("viscous", "a", 0.10, 0.01, 0.9),
        finding("lugre", "a", 0.019, 0.019),
    ]
    rounds = merged(paper, [[Candidate(one, cast(Any, None), paper)] for one in found])
    told = [candidates[0].finding for candidates in rounds]
    assert [(one.name, *one.joints) for one in told] == [("viscous", "b"), ("viscous", "a"), ("lugre", "a")]
    assert [one.size for one in told] == [0.05, 0.10, 0.019]
    assert [one.parameters["number"] for one in told] == [0.05, pytest.approx(0.10), 0.019]
    assert told[1].confidence == 0.99


def test_numbers_are_those_of_the_last_model():
    """A latency that was found before a filter has, beside it, the size of the refit with both; its width is kept."""
    given = load_model("paper_without_latency")
    final = load_model("paper").with_values({"command_latency": 0.006})
    found = Finding("latency", ("a", "b"), True, 0.004, "s", (0.003, 0.005), 1.0, {"command_latency": 0.004}, 0.5,
                    "command_latency")  # fmt: skip
    told = as_in(given, final, found, ("a", "b"))
    assert (told.size, told.parameters["command_latency"]) == (0.006, 0.006)
    assert told.interval == pytest.approx((0.005, 0.007))
    assert as_in(final, final, found, ("a", "b")) == found


@pytest.mark.parametrize(
    ("verdict", "instead", "text"),
    [
        ("named", ("", ""), "The model lacks one in a, 1 (1 to 1) and two in b, 1 (1 to 1)."),
        ("ambiguous", ("", "one"), "The model lacks one in a, 1 (1 to 1), or two in b, 1 (1 to 1); these logs do not"),
        (
            "ambiguous",
            ("", "one", ""),
            "one in a, 1 (1 to 1), or two in b, 1 (1 to 1); besides, three in c, 1 (1 to 1);",
        ),
        (
            "ambiguous",
            ("", "", "two"),
            "lacks one in a, 1 (1 to 1); besides, two in b, 1 (1 to 1), or three in c, 1 (1",
        ),
    ],
)
def test_a_sentence_tells_alternatives_from_what_comes_on_top(verdict, instead, text):
    """What stands for another effect is joined by or, what is found on top is set apart."""
    paper = load_model("paper")
    effects = tuple(
        Finding(name, (joint,), False, 1.0, "-", (1.0, 1.0), 1.0, {}, 0.1, instead_of=other)
        for name, joint, other in zip(("one", "two", "three"), "abc", instead, strict=False)
    )
    said = Verdict(verdict, effects, "", paper, paper)
    assert text in said.sentence
    assert [entry.get("instead_of", "") for entry in said.plain()["effects"]] == list(instead)


def test_the_ranking_begins_with_what_was_named():
    """An effect that a later round has found stands before what the first round thought best, and no entry is lost."""
    paper = load_model("paper")
    found = tuple(Finding(n, (j,), False, 1.0, "-", (1.0, 1.0), 1.0, {}, 0.1) for n, j in (("two", "b"), ("new", "c")))
    considered = [{"name": n, "joints": [j], "gain": 0.1} for n, j in (("one", "a"), ("two", "a"), ("two", "b"))]
    ranking = Verdict("named", found, "", paper, paper, details={"ranking": considered}).plain()["ranking"]
    assert [(r["name"], r["joints"]) for r in ranking] == [
        ("two", ["b"]),
        ("new", ["c"]),
        ("one", ["a"]),
        ("two", ["a"]),
    ]
    assert ranking[0]["gain"] == 0.1


EFFECTS = {"cogging": "cogging_amplitude", "cable_spring": "cable_stiffness", "quadratic_drag": "quadratic_drag"}


def test_a_verdict_tells_what_the_base_has_taken_upon_itself():
    """Of the chain of measurement: the value, what is expected of it, and how far they are apart."""
    base = with_chain(load_model("paper")).with_values(
        {"velocity_time_constant": 0.005, "current_offset": Estimate(0.0, joints={"r_knee": -0.006})}
    )
    told = {one["name"]: one for one in Verdict("nothing_missing", (), "", base, base).plain()["measurement_chain"]}
    assert told["velocity_time_constant"] == {
        "name": "velocity_time_constant",
        "found": 0.005,
        "expected": 0.002,
        "unit": "s",
        "deviations": 5.0,
    }
    assert (told["current_offset"]["found"], told["current_offset"]["deviations"]) == (-0.006, -2.0)
    assert abs(told["bristle_compliance"]["deviations"]) < 0.1


def candidate(name: str) -> Candidate:
    """An effect of joint a, on in its model."""
    number = EFFECTS[name]
    model = load_model("paper").with_effect(effect_class(name)(), {number: Estimate(0.0, joints={"a": 0.01})})
    found = Finding(name, ("a",), False, 0.01, "", (0.0, 0.02), 0.7, {number: 0.01}, 0.1, number)
    contender = Contender(name, name, (0,), "", 0.1, 0.1, np.zeros(8), 0.01, 0.001, False)
    return Candidate(found, contender, model)


def refittable(model, found) -> Any:
    """Stands for what a base refits of a model."""
    return SimpleNamespace(model=model, start=None, coordinates=SimpleNamespace(model=model), point=None)


@pytest.mark.parametrize(
    ("left", "expected"),
    [
        # what each model leaves in every second: with both, without the first, with the rival in place of the first
        ({"both": 1.0, "without": 2.0, "rival": 1.5}, [("cogging", ""), ("quadratic_drag", "")]),
        ({"both": 1.5, "without": 2.0, "rival": 1.0}, [("cable_spring", ""), ("quadratic_drag", "")]),
        # the same rival of half the smallest size that matters: it is the base that explains
        ({"both": 1.5, "without": 2.0, "rival": 1.0, "size": 0.0005}, [("cogging", ""), ("quadratic_drag", "")]),
        ({"both": 1.0, "without": 1.001, "rival": 1.0}, [("quadratic_drag", "")]),
        # little of all comes back without the first, but all of that in its joint, a fiftieth of the whole
        ({"both": 1.0, "without": 1.005, "rival": 1.1, "home": True}, [("cogging", ""), ("quadratic_drag", "")]),
    ],
)
def test_earlier_names_are_weighed_beside_later_ones(monkeypatch, left, expected):
    """Found first, it stays, gives way to what it could not be told from, or goes; what is named stands for itself."""
    first, rival, second = (candidate(name) for name in EFFECTS)
    home = 0.02  # share of joint a
    final = first.model.with_effect(effect_class("quadratic_drag")(), {"quadratic_drag": 0.01})
    second = Candidate(second.finding, second.contender, final)

    def kind(model) -> str:
        return (
            "rival"
            if "cable_spring" in model.effect_names
            else "both"
            if "cogging" in model.effect_names
            else "without"
        )

    def refitted(moved, point):
        smaller = kind(moved.model) == "rival" and "size" in left
        return moved.model.with_values({"cable_stiffness": left["size"]}) if smaller else moved.model

    freed = []

    def free(model, found):
        freed.append((kind(model), {one.name for one in found}))
        return refittable(model, found)

    monkeypatch.setattr(settling, "fit_base", lambda engine, moved, **_: moved)
    monkeypatch.setattr(settling, "with_point", refitted)

    def squares(engine, reference, models) -> np.ndarray:
        """Whole squares in joint a and others; where said, all that a model leaves more is in joint a."""
        rows = [
            [1.0 - home, home] if left.get("home") else [left[kind(m)] * (1.0 - home), left[kind(m)] * home]
            for m in models
        ]
        result = np.array([[one] * 8 for one in rows])
        if left.get("home"):
            result[..., 1] += np.array([left[kind(m)] - 1.0 for m in models])[:, None]
        return result[..., [1, 0]]

    monkeypatch.setattr(settling, "_squares", squares)
    rounds = [[first, rival], [second, rival]]
    engine = cast(Any, SimpleNamespace(joints=("a", "b", "c")))
    told = settle(engine, load_model("paper"), rounds, np.random.default_rng(0), cast(Any, free))
    assert [(one.name, one.instead_of) for one in told.effects][: len(expected)] == expected
    assert told.superfluous == (() if expected[0][0] != "quadratic_drag" else ("cogging",))
    # a fault that is asked for is free where it is in the model, or its joint would have it as a number of the base
    assert freed == [
        ("both", {"cogging", "quadratic_drag"}),
        ("without", {"quadratic_drag"}),
        ("rival", {"cable_spring", "quadratic_drag"}),
    ]


def test_a_fault_may_be_needed_in_its_joint_alone():
    """What brings back a fifth of its joint is needed, however little of all that is."""
    own, without = np.full((8, 3), 1.0), np.full((8, 3), 1.0)
    without[:, 0] = 1.25
    assert settling._at_home(own, without, (0,))
    assert not settling._at_home(own, without, (1,))
    assert not settling._at_home(own, without, None)


@pytest.mark.parametrize(("rivals", "confidence"), [(True, 0.7), (False, 1.0)])
def test_what_takes_the_place_of_a_look_alike_is_no_surer(monkeypatch, rivals, confidence):
    """An effect that could not be told from the first, and has made it superfluous, is not stated with certainty."""
    first, second, third = (candidate(name) for name in EFFECTS)
    final = first.model.with_effect(effect_class("cable_spring")(), {"cable_stiffness": 0.01})
    second = Candidate(dataclasses.replace(second.finding, confidence=1.0), second.contender, final)
    monkeypatch.setattr(settling, "fit_base", lambda engine, moved, **_: moved)
    monkeypatch.setattr(settling, "with_point", lambda moved, point: moved.model)
    monkeypatch.setattr(settling, "_squares", lambda engine, reference, models: np.ones((len(models), 8, 3)))
    engine = cast(Any, SimpleNamespace(joints=("a", "b", "c")))
    rounds = [[first, second if rivals else third], [second]]
    told = settle(engine, load_model("paper"), rounds, np.random.default_rng(0), cast(Any, refittable))
    assert [(one.name, one.confidence) for one in told.effects] == [("cable_spring", confidence)]
    assert told.superfluous == ("cogging",)


@pytest.mark.parametrize(("surely", "ends"), [(False, True), (True, False)])
def test_a_round_without_signs_ends_with_its_screen(monkeypatch, surely, ends):
    """Nothing that is foreseen, nothing that is refitted; other signs carry a round through."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    diagnosis = Diagnosis(load_model("paper"), split_logs(planned_suite(load_model("paper"), runs)))
    monkeypatch.setattr(diagnosis, "screen", lambda base: [])
    monkeypatch.setattr(diagnosis, "refit_base", lambda model, fitted: diagnosis.linearised())
    verdict = diagnosis._round(load_model("paper"), first=False, surely=surely)
    assert (verdict is None) is ends


@pytest.mark.parametrize(
    ("number", "confidence", "other", "own_joint", "expected"),
    [
        (1, 0.9, (4, 1.0), 0.0, False),  # a fault that explains nothing
        (1, 0.9, (4, 0.8), 0.0, True),  # one that explains a fifth of its joint, of which the leader explains nothing
        (1, 0.9, (4, 0.8), 0.8, False),  # as much as the leader does
        (1, 0.7, (4, 1.0), 0.0, True),  # a leader that is not sure
        (2, 0.9, (4, 1.0), 0.0, True),  # two that could not be told apart
    ],
)
def test_another_round_follows_what_refits_have_shown(monkeypatch, number, confidence, other, own_joint, expected):
    """Whatever the screen foresees: where something is undecided, or where a refit beats the leader elsewhere."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:3]
    diagnosis = Diagnosis(load_model("paper"), split_logs(planned_suite(load_model("paper"), runs)))
    engine = cast(WindowResiduals, diagnosis.engine)
    base = base_coordinates(load_model("paper"), engine.joints, fixed_base=True)
    shape = (len(engine.windows), engine.ticks + 1, len(engine.joints), len(engine.channels))
    rng = np.random.default_rng(0)
    noise = rng.normal(size=shape)

    def fit(share: float, joint: int) -> Fit:
        residual = noise.copy()
        residual[:, :, joint] *= np.sqrt(share)
        return Fit(base, base.start, 1.0, residual.reshape(len(residual), -1))

    every = hypotheses(load_model("paper"), engine.joints, fixed_base=True)
    faults = {h.joints: h for h in every if h.effect.name == "asymmetric_friction" and h.joints is not None}
    leader = candidate("cogging")
    leader = replace(leader, finding=replace(leader.finding, confidence=confidence))
    joint, share = other
    engine.prepare(load_model("paper"))
    diagnosis.refitted = [
        cast(Any, SimpleNamespace(fit=fit(own_joint or 1.0, joint), contender=leader.contender, hypothesis=faults[0,])),
        cast(
            Any,
            SimpleNamespace(
                fit=fit(share, joint),
                contender=replace(leader.contender, joints=(joint,)),
                hypothesis=faults[joint,],
            ),
        ),
    ]
    diagnosis._candidates = [[leader] * number]
    assert diagnosis._signs_of_more([leader] * number) is expected
    # whatever refits say: a joint that stands out, and losses that show beside the leader alone
    if not expected:
        diagnosis._lossless = True
        monkeypatch.setattr(diagnosis, "loses_after_all", lambda fit: fit is diagnosis.refitted[0].fit)
        assert diagnosis._signs_of_more([leader])
        diagnosis._lossless = False
        apart = replace(leader.contender, left=np.array([1.0, 1.0, 1.0, 1.0, 1.0, 3.0]))
        diagnosis._candidates = [[replace(leader, contender=apart)]]
        diagnosis.refitted = [cast(Any, SimpleNamespace(**{**vars(diagnosis.refitted[0]), "contender": apart}))]
        assert diagnosis._signs_of_more(diagnosis._candidates[0])


def test_an_effect_of_all_joints_asks_for_a_round_where_the_leader_does_not_act():
    """A lag that explains a tenth of the other joints beside a spring of one; not what it explains of that one."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:3]
    diagnosis = Diagnosis(load_model("paper"), split_logs(planned_suite(load_model("paper"), runs)))
    engine = cast(WindowResiduals, diagnosis.engine)
    engine.prepare(load_model("paper"))
    base = base_coordinates(load_model("paper"), engine.joints, fixed_base=True)
    shape = (len(engine.windows), engine.ticks + 1, len(engine.joints), len(engine.channels))
    noise = np.random.default_rng(0).normal(size=shape)
    every = hypotheses(load_model("paper"), engine.joints, fixed_base=True)
    lag = next(h for h in every if h.effect.name == "current_lag" and h.joints is None)
    leader = replace(candidate("cogging").contender, joints=(2,))
    for joints, expected in (([0, 1, 3, 4, 5], True), ([2], False)):
        residual = noise.copy()
        residual[:, :, joints] *= np.sqrt(0.9)
        other = Fit(base, base.start, 1.0, residual.reshape(len(residual), -1))
        unmoved = Fit(base, base.start, 1.0, noise.reshape(len(noise), -1))
        refitted = cast(Any, SimpleNamespace(fit=other, hypothesis=lag))
        assert diagnosis.refits.beats(refitted, leader, unmoved) is expected
        assert not diagnosis.refits.beats(refitted, replace(leader, joints=None), unmoved)


@pytest.mark.parametrize(
    ("gain", "at_home", "vetoed", "sure", "expected"),
    [
        (0.05, 0.05, True, False, "nothing_missing"),
        (0.05, 0.05, False, False, "named"),
        (0.12, 0.12, True, False, "named"),
        # a fault of one joint, whose share of all residuals is small
        (0.03, 0.30, True, False, "named"),
        (0.03, 0.19, True, False, "nothing_missing"),
        (0.06, 0.19, True, False, "named"),
        # what shows in nearly every second
        (0.05, 0.05, True, True, "named"),
    ],
)
def test_small_effects_need_free_runs_that_agree(monkeypatch, gain, at_home, vetoed, sure, expected):
    """What windows show little of and free runs veto is taken for nothing, and the gap is that of the base again."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    diagnosis = Diagnosis(load_model("paper"), split_logs(planned_suite(load_model("paper"), runs)))
    one = candidate("cogging")
    own = Own(at_home, at_home, np.ones(8), np.zeros(8))
    known = replace(one.contender, gain=gain, fit_gain=gain, own=own)
    diagnosis._candidates = [[replace(one, contender=known, sure=sure)]]
    shown: list[Verdict] = []
    monkeypatch.setattr(diagnosis, "_shown", lambda verdict: shown.append(verdict) or verdict)
    paper = load_model("paper")
    verdict = diagnosis._doubly_checked(Verdict("named", (one.finding,), "", one.model, paper, vetoed=vetoed))
    assert verdict.verdict == expected
    assert bool(verdict.effects) == (expected == "named")
    assert [v.model is paper for v in shown] == ([] if expected == "named" else [True])


def test_a_base_is_gone_on_with_until_it_no_longer_moves():
    """From values of another robot it goes on; where it has come to rest it stays as it is."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    diagnosis = Diagnosis(load_model("paper"), split_logs(planned_suite(load_model("paper_without_dte"), runs)))
    engine = diagnosis.engine
    coordinates = base_coordinates(load_model("paper"), engine.joints, fixed_base=True)
    begun = linearise(engine, coordinates, coordinates.start)
    onward = polish(engine, begun, refit(engine, begun, coordinates, begun.point))
    settled = diagnosis._settled(begun)
    assert onward.loss < 0.9 * begun.loss
    assert np.abs(settled.point - coordinates.start).max() > 0.01
    assert diagnosis._settled(settled) is settled


@pytest.mark.parametrize(
    ("size", "loss", "moves"), [(0.0001, 0.9, True), (0.0001, 0.97, False), (0.01, 0.5, False), (-0.0001, 0.9, True)]
)
def test_a_better_place_of_the_base_is_taken(size, loss, moves):
    """Where an effect of no size comes with a loss a twentieth lower, the base goes there; else it stays."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    diagnosis = Diagnosis(load_model("paper"), split_logs(planned_suite(load_model("paper"), runs)))
    coordinates = base_coordinates(load_model("paper"), diagnosis.engine.joints, fixed_base=True)
    point = coordinates.start
    base = Fit(coordinates, point, 1.0, np.zeros((1, 1)))
    place = [entry.parameter for entry in coordinates.entries].index("coulomb_friction")
    elsewhere = point.copy()
    elsewhere[place] += 0.01
    other = Fit(coordinates, np.append(elsewhere, size), loss, np.zeros((1, 1)))
    contender = replace(candidate("cogging").contender, size=size, smallest=0.005)
    diagnosis.refitted = [cast(Any, SimpleNamespace(fit=other, contender=contender))]
    found = diagnosis._better_base(base, [base])
    assert (found is not None) == moves
    control = replace(base, point=elsewhere, loss=loss)  # or a control that started elsewhere has found the place
    diagnosis.refitted = []
    assert (diagnosis._better_base(base, [base, control]) is not None) == (loss < 0.95)
    if found is not None:
        start = coordinates.model.value("coulomb_friction")
        assert found.value("coulomb_friction") == pytest.approx(start + 0.01)


@pytest.mark.parametrize(("alone", "gain"), [(0.9, 0.0), (0.99, 1.0 - 0.9 / 0.99)])
def test_what_the_base_does_alone_is_not_the_effects(monkeypatch, alone, gain):
    """Where the base has gone beside a hypothesis the control starts too; only what it cannot do there counts."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    diagnosis = Diagnosis(load_model("paper"), split_logs(planned_suite(load_model("paper"), runs)))
    engine = cast(Any, diagnosis.engine)
    engine.prepare(load_model("paper"))
    residual = np.ones((len(engine.windows), (engine.ticks + 1) * len(engine.joints) * len(engine.channels)))
    base = Fit(base_coordinates(load_model("paper"), engine.joints, fixed_base=True), np.zeros(0), 1.0, residual)
    base = replace(base, point=base.coordinates.start)
    starts = []

    def refit(engine, base, coordinates, start, anchor=None, shares=()):
        starts.append(start)
        loss = 0.9 if len(coordinates) > len(base.coordinates) else alone
        return Fit(coordinates, start + 0.001, loss, np.sqrt(loss) * residual)

    monkeypatch.setattr("op3.diagnose.refits.refit", refit)
    monkeypatch.setattr("op3.diagnose.refits.polish", lambda engine, base, fit: fit)
    hypothesis = next(
        h
        for h in hypotheses(load_model("paper"), engine.joints, fixed_base=True)
        if h.effect.name == "cogging" and h.joints == (3,)
    )
    picked = Screened(hypothesis, 0, 1.0, 0.1, 0.1, 9.0, 1.0, 1.0, residual[: engine.is_fit.sum()].ravel())
    controls, (refitted,) = diagnosis.refits.each(base, base, [picked], [])
    assert [control.loss for control in controls] == [1.0, alone]
    np.testing.assert_allclose(starts[1], starts[0][: len(base.point)] + 0.001)
    assert refitted.contender.gain == pytest.approx(gain, abs=1e-9)


def test_only_what_is_close_to_the_best_is_gone_on_with():
    """Refits that take off half of what the best does, four at most; none where even the best does next to nothing."""
    places = list("abcdef")
    assert _leaders([0.5, 0.8, 0.74, 0.99], 1.0, places) == [0, 2]
    assert _leaders([0.61, 0.62, 0.6, 0.63, 0.64, 0.65], 1.0, places) == [2, 0, 1, 3]
    assert _leaders([0.61, 0.62, 0.6, 0.63, 0.64, 0.65], 1.0, list("aaabbc")) == [2, 3, 5]
    assert _leaders([0.99, 0.985, 1.0], 1.0, places) == []
    assert _leaders([], 1.0, []) == []


def test_free_runs_have_no_say_in_packets_that_were_counted(monkeypatch):
    """A veto takes away what stands beside lost packets, not these; alone they cannot be vetoed."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    diagnosis = Diagnosis(load_model("paper"), split_logs(planned_suite(load_model("paper"), runs)))
    asked: list[float | None] = []
    joints: list[list[str]] = []

    def show(base, model, split, progress=None, known=None, faulty=()):
        joints.append(list(faulty))
        asked.append(model.value("drop_probability") if "packet_drop" in model.effect_names else None)
        return {"gap": {}, "loss": {}, "vetoed": True, "before": None}

    monkeypatch.setattr("op3.diagnose.diagnosis.show", show)
    monkeypatch.setattr("op3.diagnose.diagnosis.softened", lambda base, model, logs: [])
    paper = load_model("paper")
    lossy = paper.with_effect(effect_class("packet_drop")(), {"drop_probability": 0.02})
    beside = lossy.with_effect(effect_class("cogging")(), {"cogging_amplitude": 0.01})
    packets, other = finding("packet_drop", "a", 0.02, 0.02), finding("cogging", "a", 0.01, 0.01)
    alone = diagnosis._shown(Verdict("named", (packets,), "", lossy, paper))
    assert (alone.vetoed, alone.model.value("drop_probability")) == (False, 0.02)
    rival = diagnosis._shown(
        Verdict("ambiguous", (packets, replace(other, instead_of="packet_drop")), "", lossy, paper)
    )
    assert not rival.vetoed
    both = diagnosis._shown(Verdict("named", (packets, other), "", beside, paper))
    assert both.vetoed
    assert both.model.value("drop_probability") == 0.02
    assert "cogging" not in both.model.effect_names
    assert asked == [0.0, 0.0, 0.0]
    # the joints of single joints' effects that the model has, not those of their rivals
    assert joints == [["a"], ["a"], ["a", "a"]]
