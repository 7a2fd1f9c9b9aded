"""The linear algebra of the screen and of refits, on a linear engine whose answers are known."""

import dataclasses
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from op3.diagnose.backward import left_out, with_findings
from op3.diagnose.coordinates import Coordinate, Coordinates, base_coordinates, with_chain
from op3.diagnose.fitting import Fit, bounded_step
from op3.diagnose.hypotheses import hypotheses
from op3.diagnose.motion import HALF_WIDTH, VELOCITY_LAG, kernels
from op3.diagnose.ridges import CURVE, delayed, exchanged, redrawn
from op3.diagnose.screen import Projector, Screened, _score
from op3.diagnose.shortlist import confusable, hides_another, promising, shortlist, stands_alone, worth_a_round
from op3.diagnose.verdict import Finding
from op3.servo import Estimate, ServoLaw, catalogue, effect_class
from op3.sim import load_model
from op3.sim.inputs import expand_parameters
from op3.stand_in.hidden import KINDS, SEVERITIES

WINDOWS, RESIDUALS = 40, 30


@pytest.fixture
def linear():
    """A base of two columns, and residuals that hold half of a third one and some noise."""
    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(WINDOWS, RESIDUALS, 2)).astype(np.float32)
    column = rng.normal(size=(WINDOWS, RESIDUALS)) + 2.0 * jacobian[..., 0]
    residual = -0.5 * (column - 2.0 * jacobian[..., 0]) + 0.1 * rng.normal(size=column.shape)
    entries = tuple(Coordinate(name, None, -9.0, 9.0, 0.0, 0.0) for name in ("torque_constant", "armature"))
    base = Fit(
        Coordinates(load_model("paper"), ("a",), entries), np.zeros(2), 1.0, residual.astype(np.float32), jacobian
    )
    is_fit = np.arange(WINDOWS) < 25
    return base, column, is_fit


def test_projection_is_orthogonal_to_the_base(linear):
    """What is left of a column on the fitted windows has nothing in common with any column of the base."""
    base, column, is_fit = linear
    left, _ = Projector(base, is_fit).split(column[None])
    np.testing.assert_allclose(left @ base.jacobian[is_fit].reshape(-1, 2), 0.0, atol=1e-6 * np.abs(left).sum())


def test_screen_finds_share_and_gain(linear):
    """Half the secant is in the data: the share is a half, and nearly all of the unseen residual is explained."""
    base, column, is_fit = linear
    known = SimpleNamespace(name="x", neutral=0.0, low=-1.0, least=-1.0, most=1.0)
    hypothesis = SimpleNamespace(
        secants=({"x": 0.1},),
        effect=SimpleNamespace(parameters=(known,)),
        model=SimpleNamespace(value=lambda name: 0.0),
    )
    blocks = np.arange(is_fit.sum())
    projector = Projector(base, is_fit)
    fit, held = projector.split(column[None])
    found = _score(projector, column.astype(np.float32), fit[0], held[0], hypothesis, 0, blocks)
    assert found.share == pytest.approx(0.5, abs=0.02)
    assert found.gain > 0.9
    assert found.statistic > 10.0
    assert found.visibility < 1.0


def test_bounded_step_solves_least_squares_within_bounds():
    """Without active bounds it is the least-squares step, with them it stops there."""
    rng = np.random.default_rng(1)
    jacobian, truth = rng.normal(size=(50, 3)), np.array([0.3, -0.2, 0.1])
    products, gradient = jacobian.T @ jacobian, -jacobian.T @ jacobian @ truth
    wide = bounded_step(products, gradient, np.full(3, -1.0), np.full(3, 1.0))
    np.testing.assert_allclose(wide, truth, atol=1e-4)
    narrow = bounded_step(products, gradient, np.full(3, -0.1), np.full(3, 0.1))
    assert np.abs(narrow).max() <= 0.1 + 1e-9


def test_kernels_reproduce_a_cubic():
    """The local cubic gives position, velocity and acceleration of a cubic exactly, its velocity read late."""
    period = 0.008
    t = np.arange(-HALF_WIDTH, HALF_WIDTH + 1) * period
    coefficients = np.array([0.4, -2.0, 30.0, 200.0])

    def position(time: np.ndarray) -> np.ndarray:
        return coefficients @ np.stack([np.ones_like(time), time, time**2 / 2, time**3 / 6])

    def velocity(time: np.ndarray) -> np.ndarray:
        return coefficients[1:] @ np.stack([np.ones_like(time), time, time**2 / 2])

    weights = kernels(period)
    found = weights[:, 0] @ position(t) + weights[:, 1] @ velocity(t - VELOCITY_LAG)
    np.testing.assert_allclose(found, coefficients[:3], rtol=1e-6)


def test_coordinates_move_what_they_name():
    """Shared values replace, amounts add, scales multiply; nothing else moves, nor leaves what physics allows."""
    model = load_model("paper")
    joints = ("a", "b")
    entries = (
        Coordinate("coulomb_friction", None, 0.0, 1.0, 0.1, 0.1),
        Coordinate("coulomb_friction", (1,), -1.0, 1.0, 0.0, 0.0, kind="add"),
        Coordinate("coulomb_friction", (0,), -1.0, 1.0, 0.0, 0.0, kind="scale"),
    )
    values = Coordinates(model, joints, entries).values(np.array([[0.2, 0.05, 0.5], [0.1, -0.9, 0.0]]))
    assert list(values) == ["coulomb_friction"]
    np.testing.assert_allclose(values["coulomb_friction"].numpy(), [[0.3, 0.25], [0.1, 0.0]])


def test_base_of_a_held_robot_leaves_out_what_cannot_be_seen():
    """On the stand neither the trunk's mass nor, with current control, the forward efficiency is refitted."""
    names = {
        e.parameter for e in base_coordinates(with_chain(load_model("paper")), ("a", "b"), fixed_base=True).entries
    }
    assert "base_mass_offset" not in names
    assert "forward_efficiency" not in names
    assert {"torque_constant", "backward_efficiency", "velocity_time_constant", "bristle_compliance"} <= names


def test_joint_that_stands_out_of_the_spread_is_suspected():
    """A fault draws its own joint's spread to one bound and the others' to the other; equal joints raise none."""
    coordinates = base_coordinates(load_model("paper"), ("a", "b", "c", "d"), fixed_base=True)
    point = coordinates.start.copy()
    assert coordinates.suspects(point) == []
    for i, entry in enumerate(coordinates.entries):
        if entry.parameter == "coulomb_friction" and entry.kind == "scale":
            point[i] = 0.06 if entry.joints == (2,) else -0.06
    ((effect, joint, apart),) = coordinates.suspects(point)
    assert (effect, joint) == ("coulomb", 2)
    assert apart == pytest.approx(4.0)


def test_zeros_of_current_sensors_are_each_joints_own():
    """The base gives every joint one, so that one of all alike would only let each go further."""
    joints = ("a", "b", "c")
    places = {
        h.joints
        for h in hypotheses(with_chain(load_model("paper")), joints, fixed_base=True)
        if h.effect.name == "current_offset"
    }
    assert places == {(0,), (1,), (2,)}
    (alone,) = (
        h
        for h in hypotheses(with_chain(load_model("paper")), ("a",), fixed_base=True)
        if h.effect.name == "current_offset"
    )
    assert alone.joints is None


@pytest.mark.parametrize(("name", "share"), [("coulomb_friction", 0.06), ("torque_constant", 0.04)])
def test_a_spread_at_its_bounds_is_still_a_spread(name, share):
    """A fault that was not named yet pulls its joint to one end and the others to the other."""
    joints = ("a", "b", "c", "d")
    usual = load_model("paper").value(name)
    own = {joint: usual * (1.0 + (share if joint == "c" else -share)) for joint in joints}
    model = load_model("paper").with_values({name: Estimate(usual, joints=own)})
    entries = base_coordinates(model, joints, fixed_base=True).entries
    assert [e.joints for e in entries if e.parameter == name and e.kind == "value"] == [(0, 1, 2, 3)]
    # once it was named it is the joint's own
    entries = base_coordinates(model, joints, fixed_base=True, named=[(name, 2)]).entries
    assert [e.joints for e in entries if e.parameter == name and e.kind == "value"] == [(0, 1, 3), (2,)]


@pytest.mark.parametrize(
    ("name", "gain", "fit_gain", "worth"),
    [
        ("cogging", 0.09, 0.07, True),
        ("cogging", 0.03, 0.03, False),
        ("cogging", 0.12, 0.02, False),
        ("velocity_filter", 0.08, 0.08, False),  # which the base has
        ("velocity_filter", 0.15, 0.15, True),
    ],
)
def test_refits_follow_a_promising_screen(name, gain, fit_gain, worth):
    """In fitted and in choosing runs, and more of what the base has already."""
    joints = None if name == "velocity_filter" else (1,)
    every = hypotheses(load_model("paper"), ("a", "b"), fixed_base=True)
    (hypothesis,) = (h for h in every if h.effect.name == name and h.joints == joints)
    one = Screened(hypothesis, 0, 1.0, gain, fit_gain, 9.0, 1.0, 1.0, np.zeros(1))
    assert promising([one]) is worth
    assert not promising([dataclasses.replace(one, visibility=0.01)])
    assert not promising([])


def test_named_fault_of_one_joint_stays_in_its_joint():
    """In the next round a faulty joint keeps its own value, and the gap of one joint does not spread to others."""
    joints = ("a", "b", "c")
    model = load_model("paper").with_effect(effect_class("backlash")())
    own = {"coulomb_friction": {"b": 0.2}, "backlash_half_gap": {"b": 0.003}}
    for name, values in own.items():
        rest = 0.1 if name == "coulomb_friction" else 0.0
        model = model.with_values({name: Estimate(rest, joints={j: values.get(j, rest) for j in joints})})
    entries = base_coordinates(model, joints, fixed_base=True).entries
    places = {n: [e.joints for e in entries if e.parameter == n and e.kind == "value"] for n in own}
    assert places == {"coulomb_friction": [(0, 2), (1,)], "backlash_half_gap": [(1,)]}


def test_findings_add_up_in_a_model():
    """What was found is switched on in its joint; what was found beside a parameter of the base is added to it."""
    joints = ("a", "b")
    given = load_model("paper")

    def finding(name: str, parameter: str, value: float) -> Finding:
        return Finding(name, ("b",), False, value, "", (value, value), 1.0, {parameter: value}, 0.1, parameter)

    found = [finding("coulomb", "coulomb_friction", 0.05), finding("encoder_offset", "encoder_offset", 0.02)]
    like = given.with_effect(effect_class("encoder_offset")())
    whole = with_findings(given, found, like, joints)
    values = whole.tensors(joints)
    now = given.value("coulomb_friction")
    np.testing.assert_allclose(values["coulomb_friction"].numpy(), [[now, now + 0.05]])
    np.testing.assert_allclose(values["encoder_offset"].numpy(), [[0.0, 0.02]])
    for finding_out, name in zip(found, ("coulomb_friction", "encoder_offset"), strict=True):
        rest = left_out(given, finding_out, whole, joints)
        assert name not in rest.parameters() or np.ptp(rest.tensors(joints)[name].numpy()) < 1e-12


def test_one_of_two_joints_with_an_effect_is_left_out():
    """Where the same effect was found in two joints, the other keeps it; without the last one it is off."""
    joints, given = ("a", "b", "c"), load_model("paper")
    found = [Finding("cogging", (joint,), False, size, "N m", (size, size), 1.0, {"cogging_amplitude": size,
             "cogging_periods": 20.0, "cogging_phase": 0.3}, 0.1, "cogging_amplitude")
             for joint, size in (("a", 0.02), ("b", 0.05))]  # fmt: skip
    like = given.with_effect(effect_class("cogging")(), {})
    both = with_findings(given, found, like, joints)
    one = left_out(given, found[0], both, joints)
    assert one.tensors(joints)["cogging_amplitude"][0].tolist() == [0.0, 0.05, 0.0]
    assert "cogging" not in left_out(given, found[1], one, joints).effect_names


def test_a_reading_that_stands_out_is_suspected():
    """A sensor's zero at the bound of what every chain of measurement has a little of is looked into as a fault."""
    joints = ("r_hip_yaw", "r_hip_roll", "r_hip_pitch", "r_knee", "r_ank_pitch", "r_ank_roll")
    coordinates = base_coordinates(with_chain(load_model("paper")), joints, fixed_base=True)
    point = coordinates.start
    assert coordinates.suspects(point) == []
    places = [i for i, entry in enumerate(coordinates.entries) if entry.parameter == "current_offset"]
    point[places[3]] = -0.012
    (suspect,) = coordinates.suspects(point)
    assert suspect[:2] == ("current_offset", 3)


def test_what_was_named_is_no_longer_near_what_every_chain_has():
    """In the next round a named part of the measurement chain starts where it was found, and may stay there."""
    joints = ("a", "b")
    before = {e.name: e for e in base_coordinates(with_chain(load_model("paper")), joints, fixed_base=True).entries}
    model = with_chain(load_model("paper")).with_values(
        {
            "bristle_compliance": Estimate(0.0181),
            "current_offset": Estimate(0.0, joints={"a": 0.0, "b": 0.04}),
        }
    )
    after = {e.name: e for e in base_coordinates(model, joints, fixed_base=True).entries}
    assert list(before) == list(after)
    assert before["bristle_compliance"].high < 0.01
    found = after["bristle_compliance"]
    assert found.start == found.prior == pytest.approx(0.0181)
    assert found.high > 0.03
    assert found.deviation > 0.01
    assert after["current_offset[0]"] == before["current_offset[0]"]
    assert after["current_offset[1]"].start == pytest.approx(0.04)


@pytest.mark.parametrize("name", sorted(set(KINDS) & set(catalogue())))
def test_strong_faults_are_plausible(name):
    """A fault five times as large as the smallest that matters lies well inside what a hypothesis may find."""
    if KINDS[name].outsider or name == "dte":  # the size of the gear's loss is told by another number
        pytest.skip("told in another unit")
    joints = ("r_hip_yaw", "r_hip_roll", "r_hip_pitch", "r_knee", "r_ank_pitch", "r_ank_roll")
    model = with_chain(load_model("coulomb_viscous"))
    base = base_coordinates(model, joints, fixed_base=True)
    strong = 1.2 * KINDS[name].size * SEVERITIES["strong"]
    own = [h for h in hypotheses(model, joints, fixed_base=True) if h.effect.name == name]
    assert own or name in model.effect_names  # which a base refits
    for hypothesis in own:
        for secant in hypothesis.secants:
            entries = hypothesis.coordinates(base, secant, 1.0)[0].entries[len(base) :]
            for entry in entries:
                assert entry.parameter != hypothesis.effect.size or entry.high > 1.1 * strong


def test_a_named_fault_beyond_the_catalogues_range_keeps_its_size():
    """A joint with more friction than sound servos have is refitted about what was found, not cut to their range."""
    joints = ("a", "b", "c")
    known = load_model("paper").parameters()["viscous_friction"]
    much = 1.2 * known.high
    model = load_model("paper").with_values(
        {"viscous_friction": Estimate(0.08, joints={"a": 0.08, "b": much, "c": 0.08})}
    )
    entries = base_coordinates(model, joints, fixed_base=True).entries
    own = {e.joints: e for e in entries if e.parameter == "viscous_friction" and e.kind == "value"}
    assert own[(1,)].start == pytest.approx(much)
    assert own[(1,)].low < much < 0.5 * own[(1,)].high
    assert own[(0, 2)].high == known.high


@pytest.mark.parametrize("name", ["paper", "paper_without_latency", "coulomb_viscous"])
def test_no_fit_asks_for_more_than_an_effect_can_do(name):
    """At either end of every hypothesis, beside a base at either of its ends, the law takes all parameters."""
    joints = ("r_knee", "r_ank_pitch")
    base = base_coordinates(with_chain(load_model(name)), joints, fixed_base=True)
    asked = 0
    for hypothesis in hypotheses(base.model, joints, fixed_base=True):
        for secant in hypothesis.secants:
            both, _ = hypothesis.coordinates(base, secant, 1.0)
            law = ServoLaw(both.model.effects, 0.001, 0.008, joints)
            for end in (both.low, both.high):
                law.set_parameters(expand_parameters(both.model, joints, both.values(end[None]), 1))
                asked += 1
    assert asked > 100


def screened(name: str, joint: int | None, gain: float, score: float) -> Screened:
    """One secant of an effect, in a direction of its own."""
    effect = SimpleNamespace(name=name, alias_class="")
    joints = None if joint is None else (joint,)
    hypothesis = cast(Any, SimpleNamespace(effect=effect, joints=joints, secants=({},)))
    direction = np.random.default_rng([*name.encode(), 9 if joint is None else joint]).normal(size=500)
    return Screened(hypothesis, 0, 1.0, gain, gain, score, 1.0, 1.0, direction / np.linalg.norm(direction))


def test_the_highest_scores_are_refitted_whatever_they_promise():
    """An effect that the base gave way to promises less than nothing; the four highest scores are refitted still."""
    leaders = [screened("cogging", joint, 0.1 - 0.01 * joint, 3.0) for joint in range(6)]
    shared = [screened("dte", None, 0.001, 1.0), screened("lugre", None, 0.0005, 1.0)]
    masses = [screened("link_mass", joint, -3.0 - joint, 15.0 + joint) for joint in range(6)]
    rest = [screened("viscous", joint, 0.001, 2.0) for joint in range(6)]
    picked = shortlist([*rest, *masses, *shared, *leaders])
    assert picked == [*leaders, *shared, *masses[:1:-1]]
    lag = screened("current_lag", None, -1.0, 0.5)  # what a base stands for promises nothing where the base is
    assert shortlist([*rest, *masses, *shared, *leaders, lag]) == [*picked, lag]


def replace_joint(one: Screened, joint: int) -> Any:
    """The same hypothesis in another joint."""
    return SimpleNamespace(effect=one.hypothesis.effect, joints=(joint,), secants=({},))


def test_an_axis_that_fits_is_refitted_whatever_other_runs_foresee():
    """Of a fault's secants the one that explains most of the fitted runs is refitted too."""
    leaders = [screened("cogging", joint, 0.1 - 0.01 * joint, 3.0) for joint in range(6)]
    scored = [screened("viscous", joint, -1.0, 9.0) for joint in (0, 1, 2, 3)]
    axis = replace(screened("link_com", 5, 0.0, 1.0), gain=-0.2, fit_gain=0.04)
    other = replace(axis, secant=1, gain=0.002, fit_gain=0.0)
    faint = replace(screened("link_com", 1, 0.0, 1.0), gain=-0.2, fit_gain=0.005)
    everywhere = replace(screened("viscous", None, 0.0, 1.0), gain=-0.2, fit_gain=0.05)
    assert shortlist([*leaders, *scored, other, faint, axis, everywhere])[-1] is axis
    assert faint not in shortlist([*leaders, *scored, other, faint, axis, everywhere])


def test_a_joint_with_most_of_the_loss_is_asked_by_its_fitted_runs():
    """A secant that promises much of the fitted runs and less than nothing of the others is refitted in that joint."""
    leaders = [screened("cogging", joint, 0.1 - 0.01 * joint, 3.0) for joint in range(6)]
    spring = replace(screened("cable_spring", 4, 0.0, 1.0), gain=-0.5, fit_gain=0.2)
    elsewhere = replace(screened("cable_spring", 2, 0.0, 1.0), gain=-0.5, fit_gain=0.2)
    scored = [screened("viscous", joint, -1.0, 9.0) for joint in (0, 1, 2, 3)]
    # what explains more of the fitted runs elsewhere is refitted before
    ahead = [replace(elsewhere, hypothesis=replace_joint(elsewhere, joint), fit_gain=0.3) for joint in (0, 1, 2)]
    every = [*leaders, *scored, *ahead, elsewhere, spring]
    assert stands_alone(np.array([[1.0, 1.0, 1.0, 1.0, 4.0, 1.0]])) == 4
    assert stands_alone(np.array([[1.0, 1.0, 1.0, 1.0, 2.0, 1.0]])) is None
    assert stands_alone(np.array([[3.0]])) is None
    assert spring not in shortlist(every)
    assert shortlist(every, home=4) == [*shortlist(every), spring]


@pytest.mark.parametrize(
    ("name", "share", "everywhere", "worth"),
    [
        ("cogging", 0.04, True, True),
        ("cogging", 0.01, True, False),
        ("cogging", 0.10, False, False),  # of one second
        ("cogging", 0.30, False, True),
        ("velocity_filter", 0.08, True, False),  # which the base has, and has not quite reached
        ("velocity_filter", 0.16, True, True),
    ],
)
def test_another_round_follows_where_the_screen_foresees_a_gain(name, share, everywhere, worth):
    """A secant that points along what the leader leaves, in many seconds or far, and no other."""
    rng = np.random.default_rng(3)
    shape = (20, 30)
    direction = rng.normal(size=shape)
    if not everywhere:
        direction[1:] = 0.0
    direction /= np.linalg.norm(direction)
    rest = rng.normal(size=shape)
    rest -= (rest * direction).sum() * direction
    rest /= np.linalg.norm(rest)
    residual = 7.0 * (np.sqrt(share) * direction + np.sqrt(1.0 - share) * rest)
    joints = None if name == "velocity_filter" else (1,)
    (hypothesis,) = (
        h
        for h in hypotheses(load_model("paper"), ("a", "b"), fixed_base=True)
        if h.effect.name == name and h.joints == joints
    )
    one = Screened(hypothesis, 0, 1.0, 0.1, 0.1, 9.0, 1.0, 1.0, direction.reshape(-1))
    assert worth_a_round([one], residual, np.arange(20)) is worth
    assert not worth_a_round([dataclasses.replace(one, visibility=0.01)], residual, np.arange(20))


def test_what_is_taken_for_the_leader_is_refitted_in_its_place():
    """Confounders by the catalogue, said of either, in the leader's joint, the most promising first; nothing twice."""
    names = ("encoder_nonlinearity", "encoder_offset", "link_com", "cable_spring", "current_offset", "viscous")
    found = {
        (h.effect.name, h.joints): Screened(h, 0, 1.0, gain, gain, 1.0, 1.0, 1.0, np.zeros(1))
        for gain, name in zip((0.1, -0.3, 0.03, 0.02, 0.01, 0.05), names, strict=True)
        for h in hypotheses(load_model("paper"), ("a", "b"), fixed_base=True)
        if h.effect.name == name
    }
    leader, known = found["encoder_nonlinearity", (1,)], found["link_com", (1,)]
    added = confusable(leader, list(found.values()), [leader, known])
    assert {one.hypothesis.joints for one in added} == {(1,)}
    told = [one.hypothesis.effect.name for one in added]
    assert "encoder_offset" in told
    assert "viscous" not in told
    assert "link_com" not in told
    assert told[0] == "cable_spring"


def test_look_alikes_are_refitted_along_what_the_fitted_runs_prefer():
    """Of the axes along which a centre of mass may be off, the one that the other runs are foreseen to dislike most."""
    model, joints = load_model("paper"), ("a", "b")
    leader, moved = (
        next(h for h in hypotheses(model, joints, fixed_base=True) if h.effect.name == name and h.joints == (1,))
        for name in ("encoder_offset", "link_com")
    )
    first = Screened(leader, 0, 1.0, 0.1, 0.1, 9.0, 1.0, 1.0, np.zeros(1))
    axes = [Screened(moved, k, 1.0, -0.1 * k, 0.02 * k, 1.0, 1.0, 1.0, np.zeros(1)) for k in range(3)]
    assert confusable(first, [first, *axes], [first]) == [axes[2]]


@pytest.mark.parametrize(("gain", "further"), [(0.05, True), (0.03, False), (0.01, False)])
def test_static_friction_is_refitted_over_several_ranges_of_speed(gain, further):
    """Those in which the screen gives it much of what the best has; an amount that differs is no other range."""
    model, joints = load_model("paper_without_stribeck"), ("a", "b")
    static = next(
        h
        for h in hypotheses(model, joints, fixed_base=True)
        if h.effect.name == "stribeck" and h.joints is None and len(h.secants) > 2
    )
    best, other, small = (
        Screened(static, k, 1.0, one, one, 1.0, 1.0, 1.0, np.zeros(1)) for k, one in enumerate((0.1, gain, 0.001))
    )
    assert shortlist([best, other, small]) == ([best, other] if further else [best])
    assert shortlist([best, dataclasses.replace(other, visibility=0.01)]) == [best]
    soft = next(h for h in hypotheses(model, joints, fixed_base=True) if h.effect.name == "lugre" and h.joints is None)
    amounts = [Screened(soft, k, 1.0, 0.1, 0.1, 1.0, 1.0, 1.0, np.zeros(1)) for k in range(2)]
    assert shortlist(amounts) == amounts[:1]


def test_what_differs_by_set_up_can_be_refitted():
    """Its numbers carry the condition in their names, which no catalogue has."""
    one = screened("encoder_offset", None, 0.1, 1.0)
    one.hypothesis.secants = ({"encoder_offset@length=1e-1": 0.01},)
    assert shortlist([one, replace(one, gain=0.09)]) == [one]


def test_behind_a_latency_a_lag_is_always_asked_for():
    """No screen foresees what a lag would explain beside a delay that stands for it; nothing else hides one so."""
    assert [name for name in catalogue() if hides_another(name)] == ["latency"]


def test_a_lag_starts_where_a_delay_has_become_one():
    """What the lag has, the delay has lost, within their bounds; where the base has no delay, nothing starts there."""
    delay = Coordinate("command_latency", None, 0.0, 0.016, 0.01, 0.01)
    friction = Coordinate("coulomb_friction", None, 0.0, 1.0, 0.1, 0.1)
    lag = Coordinate("current_time_constant", None, 0.0, 0.005, 0.001, 0.0, kind="add")
    model = load_model("paper")
    both = Coordinates(model, ("a",), (friction, delay, lag))
    starts = exchanged(both, np.array([0.1, 0.005]), "command_latency", (0.004, 0.006))
    np.testing.assert_allclose(starts, [[0.1, 0.001, 0.004], [0.1, 0.0, 0.005]])
    assert exchanged(Coordinates(model, ("a",), (friction, lag)), np.array([0.1]), "command_latency", (0.004,)) == []


def test_a_latency_starts_where_lags_are_as_expected():
    """A base that lags more than is expected gives its lags up for a latency; one that does not is left alone."""
    current = Coordinate("current_time_constant", None, 0.0, 0.005, 0.0005, 0.0005, 0.0003)
    velocity = Coordinate("velocity_time_constant", None, 0.0, 0.008, 0.002, 0.002, 0.0006)
    latency = Coordinate("command_latency", None, 0.0, 0.016, 0.0, 0.0, kind="add")
    both = Coordinates(load_model("paper"), ("a",), (velocity, current, latency))
    starts = delayed(both, np.array([0.004, 0.0006]), (0.004, 0.02))
    np.testing.assert_allclose(starts, [[0.002, 0.0005, 0.004], [0.002, 0.0005, 0.016]])
    assert delayed(both, np.array([0.0025, 0.0006])) == []


def test_a_drag_starts_where_the_curve_of_friction_stays():
    """Beside a drag of 0.012 a bent curve of friction is nearly what it was, at every speed that the robot had."""
    model, speeds = load_model("paper"), 4.0 * np.random.default_rng(1).normal(size=(500, 2)) ** 3
    friction = [Coordinate(name, None, 0.0, 1.0, 0.1, 0.1) for name in CURVE]
    drag = Coordinate("quadratic_drag", None, 0.0, 0.05, 0.0, 0.0, kind="add")
    bent = np.array([0.034, 0.22, 0.095, 0.125])
    both = Coordinates(model, ("a",), (*friction, drag))
    v = np.linspace(0.0, 4.0, 50)

    def torque(point):
        coulomb, excess, viscous, fade, drag = point
        return coulomb + excess * np.exp(-((v / fade) ** 2)) + viscous * v + drag * v**2

    (start,) = redrawn(both, bent, np.clip(speeds, -4.0, 4.0), (0.012,))
    before = torque([*bent, 0.0])
    assert start[-1] == 0.012
    assert np.abs(torque(start) - before).max() < 0.15 * before.max()
    assert start[2] < 0.7 * bent[2]
    assert redrawn(Coordinates(model, ("a",), (*friction[1:], drag)), bent[1:], speeds) == []
