"""Where a baseline fit ends, how a late velocity is compared, and what a verdict says."""

import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import yaml

from op3.diagnose.base import (
    Baseline,
    LocalOptimum,
    damped_steps,
    evidence_gain,
    gauss_newton,
    refitted_in_bounds,
    unfitted,
    within_sound_spread,
)
from op3.diagnose.candidates import all_candidates
from op3.diagnose.coordinates import (
    base_coordinates,
    other_forms,
    with_chain,
    with_robot_spread,
    with_sound_spread,
    with_student_spread,
)
from op3.diagnose.doubts import chain_deviations, doubts, free_and_expected
from op3.diagnose.findings import Search
from op3.diagnose.held_out import Gain
from op3.diagnose.judge import CoefficientPriors, Posterior, Variances
from op3.diagnose.judge_settings import Settings
from op3.diagnose.linearisation import Linearisation
from op3.diagnose.naming import NamedEffect, Rival, ScoredRefit, best_refit, probability_shares
from op3.diagnose.reduction import Reduction
from op3.diagnose.relevance import Relevance
from op3.diagnose.show import show
from op3.diagnose.split import LogSplit
from op3.diagnose.starts import search, with_best_gear, with_servo_factors
from op3.diagnose.verdict import Alternative, Finding, JointGap, Verdict
from op3.motions import leg_suite
from op3.replay.planned import planned_suite
from op3.replay.windows import WindowResiduals
from op3.rollout import Rollout
from op3.servo import Estimate, effect_class
from op3.servo.effects import Backlash, DirectionalEfficiency, LoadFriction
from op3.sim import load_model
from tests.op3_table import LEG_JOINTS


@pytest.fixture(scope="module")
def truth():
    return load_model("paper").with_values({"coulomb_friction": 0.2})


@pytest.fixture(scope="module")
def logs(truth) -> list[Rollout]:
    """Two motions of a leg with more friction than the paper's model."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    return planned_suite(truth, runs)


def test_what_gets_better_is_said_by_channel(truth, logs):
    """Under the model that made the logs every channel is better, and the loss lower."""
    told = show(load_model("paper"), truth, LogSplit((), tuple(logs)))
    assert {gap["change"] for gap in told["gap"].values()} == {"better"}
    assert told["loss"]["after"] < told["loss"]["before"]


def test_a_late_reading_is_no_gap(truth, logs):
    """Velocities that come 16 ms late leave what they leave without being late."""
    late = []
    for log in logs:
        arrays = {key: log.array(key) for key in log.channels}
        arrays["joint", "velocity"] = np.roll(arrays["joint", "velocity"], 2, axis=0)
        late.append(Rollout.from_arrays(arrays, log.metadata))
    splits = [LogSplit((), tuple(some)) for some in (logs, late)]
    gaps = [show(truth, truth, split)["gap"]["joint/velocity"]["before"] for split in splits]
    assert gaps[1] < gaps[0] + 0.15


def test_a_filter_of_the_models_own_is_late_once(truth):
    """Logs of a model whose readings are filtered are predicted by it as they are, and worse without the filter."""
    filtered = with_chain(truth).with_values({"velocity_time_constant": 0.012})
    mine = planned_suite(filtered, [run for run in leg_suite(3, 2.5) if run.motion.name.startswith("multisine")][:1])
    told = show(filtered.with_values({"velocity_time_constant": 0.0}), filtered, LogSplit((), tuple(mine)))
    assert told["gap"]["joint/velocity"]["after"] < 0.03
    assert told["gap"]["joint/velocity"]["change"] == "better"


def test_servos_with_numbers_of_their_own_keep_one_in_common():
    """A model handed back has a torque constant for every joint: a base is fitted to a factor on them, and to how they
    differ, and what they have in common moves between these without changing the base."""
    own = {joint: 0.006 + 0.0001 * number for number, joint in enumerate(LEG_JOINTS)}
    sound = with_chain(load_model("paper"))
    for name, values in (("torque_constant", own), ("viscous_friction", {j: 5 * v for j, v in own.items()})):
        coordinates = base_coordinates(sound.with_values({name: Estimate(0.006, joints=values)}), LEG_JOINTS)
        mine = [i for i, entry in enumerate(coordinates.entries) if entry.parameter == name]
        assert [coordinates.entries[i].joints for i in mine] == [None, *((j,) for j in range(len(LEG_JOINTS)))]
        point = coordinates.start.copy()
        point[mine[1:]] = 0.1
        _, moved = with_robot_spread(coordinates, point, np.full(len(point), 0.005), Settings())
        assert moved[mine] == pytest.approx([0.1, *np.zeros(len(LEG_JOINTS))])
        before, after = (coordinates.values(one[None])[name] for one in (point, moved))
        assert after.numpy() == pytest.approx(before.numpy())


def test_a_number_at_its_bound_is_a_doubt_where_logs_exercise_it():
    """Of a shared number; one at the least that physics allows is none, and none that the logs do not move."""
    coordinates = base_coordinates(with_chain(load_model("paper")), LEG_JOINTS)
    point = coordinates.start.copy()
    at = [entry.parameter for entry in coordinates.entries].index("torque_constant")
    point[at] = coordinates.high[at]
    point[[entry.parameter for entry in coordinates.entries].index("viscous_friction")] = 0.0
    columns, certain = np.ones((len(point), 1, 1, 1)), SimpleNamespace(covariance=np.zeros((len(point), len(point))))
    base = Baseline(Linearisation(coordinates, point, (), (), np.zeros(0), columns), certain)  # type: ignore[arg-type]
    (doubt,) = doubts(base)
    assert doubt.startswith("torque constant hit its upper bound")
    other = point.copy()
    other[at] = coordinates.low[at]
    twice = Baseline(base.linear, certain, (LocalOptimum(coordinates, other, -3.0),))  # type: ignore[arg-type]
    assert "with other values of torque constant" in doubts(twice)[1]
    prior = SimpleNamespace(covariance=np.diag(coordinates.deviation**2))
    assert doubts(Baseline(base.linear, prior)) == ()  # type: ignore[arg-type]


def test_a_number_at_its_end_holds_back_no_other():
    """Of two numbers, one at its smallest value and pulled down: the other goes where it is best alone, 3 / 2."""
    numbers = CoefficientPriors(np.zeros(2), np.ones(2), lower=np.array([0.0, -9.0]), upper=np.array([9.0, 9.0]))
    precision, pull = np.array([[2.0, 1.9], [1.9, 2.0]]), np.array([-1.0, 3.0])
    fit = Posterior(np.linalg.solve(precision, pull), precision, 0.0, (), Variances(*np.zeros((3, 1))))
    assert damped_steps(fit, numbers)[0] == pytest.approx([0.0, 1.5])


def test_the_size_of_a_gap_is_found_from_less_than_half_of_it():
    """A knee's play of 16 mrad in all, from 6 mrad on, with columns of the base as they are without play: Gauss-Newton
    steps alone end at 7 mrad."""
    sound, gap = load_model("paper"), {"backlash_half_gap": Estimate(0.0, joints={"r_knee": 0.008})}
    loose = sound.with_effect(Backlash(), {**gap, "contact_stiffness": 300.0, "output_inertia": 0.0005})
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    reduction = Reduction(WindowResiduals(planned_suite(loose, runs), windows=18))
    base, joints = unfitted(reduction, sound), reduction.engine.joints
    place = "backlash", (joints.index("r_knee"),)
    one = next(each for each in all_candidates(base.model, joints, reduction.moving, {}) if each.hypothesis == place)
    own = one.coordinates(base.model, base.coordinates.entries, 0.003 / one.secant[one.size_parameter], Settings())
    coordinates = base.coordinates.extended(one.switched_on(base.model, joints), own)
    start = np.concatenate([base.point, coordinates.start[len(base.point) :]])
    assert start[len(base.point)] == pytest.approx(0.003)
    end = gauss_newton(reduction, coordinates, start, steps=2, reference=base.linear)
    assert end.point[len(base.point)] == pytest.approx(0.008, abs=0.001)


def test_servos_differ_as_most_of_the_robot_do():
    """Friction of five joints within 2 % about 10 % less, and 45 % more in the sixth: the shared number is that of the
    five, a spread of 4 % (of 15 % that any make may have) is left to all, and the base is the same."""
    coordinates = base_coordinates(with_chain(load_model("paper")), LEG_JOINTS)
    point = coordinates.start.copy()
    named = [(entry.parameter, entry.kind) for entry in coordinates.entries]
    own = [i for i, name in enumerate(named) if name == ("coulomb_friction", "scale")]
    point[own] = [-0.08, -0.12, -0.09, -0.11, -0.1, 0.45]
    spread, moved = with_robot_spread(coordinates, point, np.full(len(point), 0.005), Settings())
    assert spread.entries[own[0]].deviation < 0.05
    assert np.abs(moved[own[:5]]).max() < 0.03
    unidentifiable, _ = with_robot_spread(coordinates, coordinates.start, coordinates.deviation, Settings())
    assert unidentifiable.entries[own[0]].deviation == pytest.approx(coordinates.entries[own[0]].deviation)
    before, after = (coordinates.values(one[None])["coulomb_friction"] for one in (point, moved))
    assert after.numpy() == pytest.approx(before.numpy())


def test_a_servo_far_from_the_others_is_pulled_back_little():
    """Student's prior of 4 degrees of freedom, 20 standard deviations out, pulls like a normal one that is
    sqrt((4 + 400) / 5) times as wide; where it is expected like one a little narrower."""
    coordinates = with_student_spread(base_coordinates(with_chain(load_model("paper")), LEG_JOINTS), 4.0)
    i = next(i for i, entry in enumerate(coordinates.entries) if entry.per_servo)
    point, step = coordinates.prior.copy(), 1e-5
    assert coordinates.deviation_at(point)[i] == pytest.approx(coordinates.deviation[i] * np.sqrt(0.8))
    point[i] = 20 * coordinates.deviation[i]
    ends = np.stack([point, point])
    ends[:, i] += np.array([-step, step])
    low, high = coordinates.penalties(ends)
    wide = coordinates.deviation_at(point)[i]
    assert wide == pytest.approx(coordinates.deviation[i] * np.sqrt(404 / 5))
    assert (high - low) / (2 * step) == pytest.approx(2 * point[i] / wide**2, rel=1e-6)


def test_one_bad_servo_does_not_move_what_all_share(truth):
    """Four times the friction in a knee: the baseline fit finds it there, leaves the friction of all others, and then
    takes the knee as near to them as a sound one would be."""
    bad = truth.with_values({"coulomb_friction": Estimate(0.1, joints={"r_knee": 0.4})})
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    reduction = Reduction(WindowResiduals(planned_suite(bad, runs), windows=24))
    usual = base_coordinates(with_chain(load_model("paper")), LEG_JOINTS, reduction.moving)
    free = with_student_spread(usual, 4.0)
    base = gauss_newton(reduction, free, with_servo_factors(reduction, free, usual.start))
    base = gauss_newton(reduction, *with_robot_spread(free, base.point, base.deviations, Settings()))
    sound = within_sound_spread(reduction, base)
    friction = {"free": base, "sound": sound}
    found = {name: one.coordinates.values(one.point[None])["coulomb_friction"][0] for name, one in friction.items()}
    knee = LEG_JOINTS.index("r_knee")
    others = [j for j in range(len(LEG_JOINTS)) if j != knee]
    assert found["free"][knee] == pytest.approx(0.4, rel=0.1)
    assert found["sound"][others].numpy() == pytest.approx(0.1, rel=0.15)
    assert found["sound"][knee] < 0.16
    # all else follows what was taken back: fitted anew the base explains the logs better, still within its ranges
    followed = refitted_in_bounds(reduction, sound)
    assert not followed.clipped.any()
    assert evidence_gain(reduction, gauss_newton(reduction, sound.coordinates, sound.point, steps=0), followed) > 10.0


def test_the_search_finds_a_basin(logs):
    """Far from the numbers that made the logs, it leaves two thirds of what the given ones leave, at most."""
    reduction = Reduction(WindowResiduals(logs, windows=8))
    far = with_chain(load_model("paper").with_values({"coulomb_friction": 0.02, "torque_constant": 0.0075}))
    coordinates = base_coordinates(far, LEG_JOINTS, reduction.moving)
    found, point = search(reduction, coordinates, np.random.default_rng(0), [far, *other_forms(far)])
    errors = [reduction.errors_at(one, at[None]) for one, at in ((coordinates, coordinates.start), (found, point))]
    before, after = (np.log1p(np.square(np.concatenate(error, -1)).mean(2)).sum() for error in errors)
    assert after < 0.67 * before


def test_two_ends_of_a_base_are_compared_without_favour(truth, logs):
    """The numbers that made the logs win over given ones, by the same whichever of them is called the first."""
    reduction = Reduction(WindowResiduals(logs, windows=8))
    coordinates = base_coordinates(with_chain(load_model("paper")), LEG_JOINTS, reduction.moving)
    known = base_coordinates(with_chain(truth), LEG_JOINTS, reduction.moving).start
    right, wrong = (gauss_newton(reduction, coordinates, point, steps=0) for point in (known, coordinates.start))
    worse = evidence_gain(reduction, wrong, right)
    assert worse > 100.0
    assert evidence_gain(reduction, right, wrong) == pytest.approx(-worse)


GAIN = Gain(2.0, 0.6, 3.2, 12)


def verdict(**changes) -> Verdict:
    finding = Finding(
        "backlash", ("r_knee",), False, "backlash_half_gap", 0.004, "rad", (0.003, 0.005), 0.93, 11.0, GAIN
    )
    quiet = JointGap(0.01, 0.002, 0.001, 0.001, False, {"position": 0.1})
    model = load_model("paper")
    given = {"findings": (finding,), "joints": {"r_knee": quiet}, "doubts": (), "unidentifiable": (), "cannot_tell": ()}
    return Verdict(**{**given, "base": model, "model": model, **changes})


def test_a_verdict_is_findings_and_what_stays_unexplained():
    """Names, alternatives, an odd joint that silences no finding, and doubts first; all of it plain."""
    (finding,) = verdict().findings
    assert verdict().verdict == "named"
    assert verdict().sentence.startswith("The model does not include backlash in right knee")
    less = verdict(findings=(finding, dataclasses.replace(finding, effect="lugre", probability=0.6)))
    assert "probability 0.93; LuGre in right knee" in less.sentence
    ended = dataclasses.replace(finding, beyond=True)
    assert "at least 0.004 rad, end of the searched range" in ended.phrase
    rival = Alternative("compliance", ("r_knee",), False, 0.3)
    either = verdict(findings=(Finding(**{**vars(finding), "alternatives": (rival,)}),))
    assert either.verdict == "ambiguous"
    assert "or compliance in right knee" in either.sentence
    assert finding.separate_by == ""
    assert either.findings[0].separate_by
    odd = JointGap(0.01, 0.01, 0.001, 0.009, True, {"position": 0.8})
    beside = verdict(joints={"r_hip_yaw": odd})
    assert beside.verdict == "named"
    assert "explains the remaining torque of right hip yaw" in beside.sentence
    assert verdict(findings=(), joints={"r_hip_yaw": odd}).verdict == "unknown"
    assert verdict(findings=()).verdict == "nothing_missing"
    assert yaml.safe_load(yaml.safe_dump(beside.plain()))["findings"][0]["probability"] == 0.93


def test_a_delay_is_unusual_of_a_model_that_has_none(truth):
    """7.5 ms are near what the paper's model says, and much for one without; nothing else of the chain is told then. A
    base that is held to none is worse."""
    late = truth.with_values({"command_latency": 0.0075})
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    reduction = Reduction(WindowResiduals(planned_suite(late, runs), windows=24))
    base = unfitted(reduction, late)
    base = gauss_newton(reduction, base.coordinates, base.point)
    for given, told in (("paper", []), ("paper_without_latency", ["command_latency"])):
        found = chain_deviations(load_model(given), base)
        far = [one for one in found if one.log_odds > 6]
        assert [base.coordinates.entries[one.index].parameter for one in far] == told
        for one in far:
            free, usual = free_and_expected(reduction, base, one.index, one.expected)
            assert evidence_gain(reduction, usual, free) / 2 > 6
            assert usual.point[one.index] < 0.006 < free.point[one.index]


@pytest.mark.slow
def test_what_all_joints_share_is_told_though_the_base_takes_its_place():
    """Efficiency, torque constant and friction of the base imitate friction in proportion to the motors' torque until
    nothing that is linear tells it; refitted it is told, in all joints and in its size."""
    truth = load_model("paper").with_effect(LoadFriction(form="motor"), {"load_friction": 0.1})
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    reduction = Reduction(WindowResiduals(planned_suite(truth, runs), windows=24))
    base = unfitted(reduction, load_model("paper"))
    search_ = Search(reduction)
    first = search_.first(gauss_newton(reduction, base.coordinates, base.point))
    odds = first.judge.scores(first.fit)
    mine = [i for i, one in enumerate(first.candidates) if one.hypothesis == ("load_friction", None)]
    assert odds[mine].max() < 6 < odds.max()
    assert first.candidates[search_.shared(first)[0].index].hypothesis == ("load_friction", None)
    further = search_.further(first)
    assert further is not None
    assert [one.candidate.hypothesis for one in further.named] == [("load_friction", None)]
    assert further.base.point[-1] == pytest.approx(0.1, rel=0.3)
    assert further.named[0].log_odds > 20
    dropped = search_._without_others(further, (), 0)
    assert ("load_friction", None) in {one.hypothesis for one in search_._candidates(dropped)}


def test_in_a_bad_joint_effects_are_proposed_by_what_they_predict(truth, monkeypatch):
    """Friction of a joint four times the others': held to what is usual the base misses it, no column shows it, and it
    is the best of all effects in that joint at one of the sizes that are tried; none is proposed in sound joints."""
    bad = truth.with_values({"coulomb_friction": Estimate(0.1, joints={"r_knee": 0.4})})
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    search_ = Search(Reduction(WindowResiduals(planned_suite(bad, runs), windows=24)))
    base = unfitted(search_.reduction, truth.with_values({"coulomb_friction": 0.1}))
    knee, entries = (LEG_JOINTS.index("r_knee"),), base.coordinates.entries
    number = next(i for i, one in enumerate(entries) if one.parameter == "coulomb_friction" and one.joints == knee)
    outside = base.linear.point.copy()
    outside[number] = base.coordinates.high[number] + 2.0
    proposed = {}
    for name, point in (("sound", base.linear.point), ("bad", outside)):
        at = dataclasses.replace(base, linear=dataclasses.replace(base.linear, point=point))
        stage: Any = SimpleNamespace(base=at, candidates=search_._candidates(at), fit=at.fit)
        proposed[name] = [stage.candidates[one.index] for one in search_.in_clipped_joints(stage)]
    assert proposed["sound"] == []
    assert {one.joints for one in proposed["bad"]} == {knee}
    assert proposed["bad"][0].effect.name == "coulomb"


def refit(name: str, gains: list[float], log_odds: float, parameters: int = 1) -> ScoredRefit:
    """A refit with held-out log densities per run of one joint, over a model without it whose densities are 0."""
    density, candidate = np.array([gains]).T, cast(Any, SimpleNamespace(effect=effect_class(name)))
    coordinates = cast(Any, (None,) * parameters)
    gain = Gain.of(density, np.zeros_like(density))
    effect = NamedEffect(candidate, coordinates, log_odds, gain, Relevance({}, 0.0, 0.0, True))
    return ScoredRefit(effect, cast(Any, None), density)


def test_among_refits_with_equal_gains_the_most_evident_is_named():
    """Held-out gains of 4.0 and 3.9 a run in the same runs, within their errors: the one with more evidence is named
    and the other is its rival. A third gains in other runs, and a fourth too little; neither is a rival."""
    largest, evident = refit("compliance", [3.0, 5.0, 3.0, 5.0], 20.0), refit("backlash", [3.2, 4.6, 3.2, 4.6], 40.0)
    elsewhere, poor = refit("coulomb", [0.0, 0.0, 0.0, 9.9], 90.0), refit("stribeck", [1.0, 2.0, 1.0, 2.0], 95.0)
    best, rivals = best_refit([largest, evident, elsewhere, poor], np.zeros((4, 1)), Settings())
    assert best is evident
    assert [(rival.candidate, rival.log_odds) for rival in rivals] == [(largest.effect.candidate, 20.0)]


@pytest.mark.parametrize(("behind", "named"), [(3.0, "coulomb"), (8.0, "position_friction")])
def test_of_related_effects_with_equal_evidence_the_simpler_is_named(behind, named):
    """Friction that depends on the angle explains constant friction too: it is named if its evidence leads by more
    than an alarm of 6."""
    gains = [3.0, 5.0, 3.0, 5.0]
    several, simple = refit("position_friction", gains, 40.0, 3), refit("coulomb", gains, 40.0 - behind)
    best, (rival,) = best_refit([several, simple], np.zeros((4, 1)), Settings())
    assert best.effect.candidate.effect.name == named
    assert rival.log_odds == (-behind if best is simple else behind)


@pytest.mark.slow
def test_a_law_of_the_gear_is_tried_again_once_all_else_is_fitted():
    """Losses by the direction of motion, and a base that ended with losses by the torques: begun anew with each law it
    has the right one, and that stays when it is tried again."""
    model = load_model("paper").with_values({"backward_efficiency": 0.65})
    values = {known.name: model.estimate(known.name) for known in DirectionalEfficiency.parameters}
    truth = model.with_effect(DirectionalEfficiency(form="power"), values)
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    reduction = Reduction(WindowResiduals(planned_suite(truth, runs), windows=24))
    coordinates = base_coordinates(with_chain(model), LEG_JOINTS, reduction.moving)
    base = gauss_newton(reduction, coordinates, coordinates.start)
    thin = reduction.thinned(12)
    better, ends = with_best_gear(reduction, thin, base, [])
    assert repr(better.coordinates.model.effect("dte")) == repr(truth.effect("dte"))
    assert ends[0].gain > 10.0
    assert with_best_gear(reduction, thin, better, []) == (better, [])


def test_few_servos_may_differ_by_more_than_their_own_spread_says():
    """Three servos, whose spread is known with 3 + 4 degrees of freedom, may differ by 4.5 of its standard deviations
    (Student's quantile at 0.99865), twenty by 3.3; a normal distribution allows 3."""
    for joints, limit in ((LEG_JOINTS[:3], 4.53), ([f"joint_{i}" for i in range(20)], 3.34)):
        coordinates = base_coordinates(with_chain(load_model("paper")), joints)
        servo = next(e for e in with_sound_spread(coordinates, Settings()).entries if e.per_servo)
        assert servo.high / servo.deviation == pytest.approx(limit, abs=0.01)
        assert servo.tails == len(joints) + 4


def test_no_rival_has_more_of_a_probability_than_the_finding():
    """Equal in both respects, it has half; what speaks for the rival in one respect does not make up for the other."""
    even, settings = Gain(0.0, 1.0, 0.0, 8), Settings()
    rival = Rival(cast(Any, None), even, 0.0)
    assert probability_shares([rival], settings) == pytest.approx([0.5, 0.5])
    behind = [dataclasses.replace(rival, log_odds=-50.0), dataclasses.replace(rival, log_odds=settings.alarm)]
    assert probability_shares(behind, settings) == pytest.approx(
        np.array([1.0, 1.0, np.exp(-1.0)]) / (2 + np.exp(-1.0))
    )
    assert probability_shares([], settings) == pytest.approx([1.0])
