"""What could be missing: places, neutral columns, priors."""

from math import pi, remainder

import numpy as np
import pytest

from op3.diagnose.base import gauss_newton
from op3.diagnose.candidates import all_candidates, log_priors, mirror_pairs, secant_counts
from op3.diagnose.coordinates import CHAIN, base_coordinates, other_forms, with_chain
from op3.diagnose.judge_settings import SETTINGS
from op3.diagnose.reduction import Reduction
from op3.diagnose.verdict import separating
from op3.motions import leg_suite
from op3.replay.planned import planned_suite
from op3.replay.windows import WindowResiduals
from op3.servo import catalogue
from op3.servo.effect import parameter
from op3.sim import load_model
from tests.op3_table import LEG_JOINTS

EVERY = [True] * len(LEG_JOINTS)


@pytest.fixture(scope="module")
def reduction() -> Reduction:
    """Ten windows of a leg, simulated by the model itself."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:2]
    return Reduction(WindowResiduals(planned_suite(load_model("paper"), runs), windows=10))


def test_every_place_of_a_leg_and_no_number_of_the_base():
    """Effects of single joints in each, laws of all joints once; what the base fits is no candidate for all."""
    found = all_candidates(with_chain(load_model("paper")), LEG_JOINTS, EVERY, {})
    places = {(one.effect.name, one.joints) for one in found}
    assert {("backlash", (j,)) for j in range(6)} < places
    assert ("quadratic_drag", None) in places
    for shared in ("coulomb", "dte", "latency", "velocity_filter", "torque_constant", "current_offset"):
        assert (shared, None) not in places
    assert not any(one.effect.name in ("payload", "imu_mount", "ground_tilt", "position_servo") for one in found)


def test_mirror_pairs_are_places_and_still_joints_are_none():
    """Each pair once; a joint that is still, or has no partner, is in none."""
    joints = ("l_a", "l_b", "neck", "r_a", "r_b")
    mirror = {"l_a": ("r_a", 1), "r_a": ("l_a", 1), "l_b": ("r_b", -1), "r_b": ("l_b", -1)}
    assert mirror_pairs(joints, [True] * 5, mirror) == [(0, 3), (1, 4)]
    assert mirror_pairs(joints, [True, True, True, True, False], mirror) == [(0, 3)]


def test_a_neutral_secant_is_a_column_of_zeros(reduction):
    """At none of an effect nothing changes, bit for bit, whichever effect it is."""
    model = with_chain(load_model("paper"))
    base, sound = model.tensors(LEG_JOINTS), reduction.engine.errors(model)
    for one in {c.effect.name: c for c in all_candidates(model, LEG_JOINTS, EVERY, {})}.values():
        start = one.model.tensors(LEG_JOINTS) | base
        assert (one.effect.name in model.effect_names) <= all(
            parameter(name).neutral is not None for name in one.secant
        )
        error = reduction.engine.errors(one.model, one.applied(start, share=0.0))
        if not one.model.stiff:  # elastic elements are started from the data, and begin as they would end
            np.testing.assert_array_equal(error, sound)


def test_columns_stay_in_the_limb(reduction):
    """A change in one joint moves that joint's column most; one of all joints is the sum of theirs to a tenth."""
    model = with_chain(load_model("paper"))
    coordinates = base_coordinates(model, LEG_JOINTS)
    linear = gauss_newton(reduction, coordinates, coordinates.start, steps=0).linear
    found = [c for c in all_candidates(model, LEG_JOINTS, EVERY, {}) if c.effect.name == "quadratic_drag"]
    columns = {
        one.joints: np.stack([column[j] for j in range(len(LEG_JOINTS))])
        for one, column in zip(found, reduction.columns(linear, found), strict=True)
    }
    knee = LEG_JOINTS.index("r_knee")
    own = np.square(columns[(knee,)]).sum((1, 2))
    assert own.argmax() == list(reduction.joint_indices).index(knee)
    whole = columns.pop(None)
    assert np.square(sum(columns.values()) - whole).sum() < 0.1 * np.square(whole).sum()


def test_pairs_are_sums_of_their_joints():
    """Each of two parts, one in each joint, where an axis turns the other way with angles at their mirror image."""
    mirror = {"r_knee": ("r_ank_pitch", -1), "r_ank_pitch": ("r_knee", -1)}
    found = all_candidates(with_chain(load_model("paper")), LEG_JOINTS, EVERY, mirror)
    by_key = {one.key: one for one in found}
    pairs = [one for one in found if one.scope == "pair"]
    assert pairs
    for pair in pairs:
        parts = [by_key[key] for key in pair.components]
        assert [part.joints for part in parts] == [(j,) for j in pair.joints or ()]
        first, second = (part.secant for part in parts)
        for name in pair.secant:
            turned = parameter(name).mirrored
            image = remainder(second[name] + first[name], 2 * pi) if turned else second[name] - first[name]
            assert image == pytest.approx(0.0, abs=1e-12)
        values = pair.switched_on(load_model("paper"), LEG_JOINTS).tensors(LEG_JOINTS)
        for part in parts:
            alone = part.switched_on(load_model("paper"), LEG_JOINTS).tensors(LEG_JOINTS)
            assert all(values[name][0, list(part.joints)] == alone[name][0, list(part.joints)] for name in pair.secant)


def test_places_and_secants_share_one_prior():
    """All hypotheses of a scope together have the scope's prior, for laws of one number."""
    found = all_candidates(with_chain(load_model("paper")), LEG_JOINTS, EVERY, {})
    priors = np.exp(log_priors(found)) / secant_counts(found)
    for name in ("quadratic_drag", "cable_spring"):
        mine = [i for i, one in enumerate(found) if one.effect.name == name and one.scope == "joint"]
        extra = 0.5 ** (sum(p.neutral is not None for p in catalogue()[name].parameters) - 1)
        assert priors[mine].sum() == pytest.approx(0.35 * extra)


def test_plausible_sizes_stay_within_physics():
    """Losses are not negative, efficiencies not above one, and a slab has room within its ends."""
    base = with_chain(load_model("paper_without_dte"))
    for one in all_candidates(base, LEG_JOINTS, EVERY, {}):
        low, high, slab = one.size_range(base, SETTINGS)
        assert low <= 0.0 <= high
        assert slab > 0
        if one.effect.name == "dte":
            assert (high - low) * abs(one.secant["backward_efficiency"]) <= 1.0


def test_the_chain_is_on_and_per_joint_where_joints_differ():
    """Zeros of current sensors are each joint's own, lags are shared, and a servo's own loop has no current loop."""
    model = with_chain(load_model("paper"))
    entries = base_coordinates(model, LEG_JOINTS).entries
    count = {name: sum(entry.parameter == name for entry in entries) for name in CHAIN}
    assert count["current_offset"] == 6
    assert count["velocity_time_constant"] == count["command_latency"] == 1
    assert "current_lag" not in with_chain(load_model("xl330_m1")).effect_names


def test_forms_of_a_law_are_all_there():
    """Two of DTE times three of static friction, less the one that is given."""
    assert len(other_forms(load_model("paper"))) == 5


def test_experiments_are_said_once():
    """Of two names of one experiment."""
    assert separating(["dte", "dte"]) == separating(["dte"])
