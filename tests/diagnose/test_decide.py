"""The decision on synthetic numbers."""

import dataclasses

import numpy as np
import pytest
from contenders import BLOCKS, contender

from op3.diagnose.decide import decide
from op3.diagnose.evidence import Contender, Own, evidence, pick_shares, signed_ranks
from op3.diagnose.thresholds import FURTHER_Z, SMALLEST_T, SMALLEST_Z, UNDECIDED


def test_nothing_missing_where_all_gains_are_small(control, rng):
    """Effects that explain two percent are what cases without a missing effect give."""
    decision = decide([contender("backlash@3", 0.02), contender("dte", 0.01, seed=1)], control, rng)
    assert decision.verdict == "nothing_missing"


def test_clear_winner_is_named(control, rng):
    """One that explains five times what the next does wins every resample."""
    decision = decide([contender("dte", 0.06, seed=1), contender("backlash@3", 0.3)], control, rng)
    assert decision.verdict == "named"
    assert decision.candidates == (1,)
    assert decision.shares[1] > 0.99


@pytest.mark.parametrize(
    ("label", "size", "doubted"),
    [
        ("stribeck@3", 1.0, True),
        ("stribeck", 1.0, False),
        ("coulomb@3", 1.0, False),
        ("latency", 0.0014, True),
        ("latency", 0.003, False),
    ],
)
def test_names_that_are_seldom_right_are_stated_with_less(control, rng, label, size, doubted):
    """A law of a make in one joint, and a delay as short as any lag, however clearly they win."""
    one = dataclasses.replace(contender(label, 0.3), size=size, smallest=0.001)
    decision = decide([one, contender("viscous@1", 0.05, seed=1)], control, rng)
    assert (decision.verdict, decision.candidates) == ("named", (0,))
    assert decision.shares[0] == (UNDECIDED if doubted else 1.0)


def test_a_name_that_is_beaten_by_an_implausible_one_is_stated_with_less(control, rng):
    """It is named, as the other one would need an impossible size; in another joint that says nothing."""
    named = contender("coulomb@3", 0.3, noise=0.0)
    for place, gain, confidence in (("3", 0.4, UNDECIDED), ("2", 0.4, 1.0), ("3", 0.31, 1.0)):
        beyond = contender(f"position_friction@{place}", gain, seed=1, noise=0.0)
        beyond = dataclasses.replace(beyond, implausible=True)
        decision = decide([named, beyond], control, rng)
        assert (decision.verdict, decision.candidates) == ("named", (0,))
        assert decision.shares[0] == confidence


def test_equals_are_ambiguous(control, rng):
    """Two that explain the same, each better in other seconds, are both candidates."""
    pair = [contender("dte", 0.2, noise=0.1), contender("load_friction", 0.2, seed=1, noise=0.1)]
    decision = decide(pair, control, rng)
    assert decision.verdict == "ambiguous"
    assert set(decision.candidates) == {0, 1}


def test_look_alikes_need_more_certainty(control, rng):
    """Of one alias class, a second that explains nearly as much is a candidate too; one of a third is not."""
    first = contender("encoder_offset@1", 0.30, noise=0.15)
    for gain, verdict in ((0.26, "ambiguous"), (0.10, "named")):
        second = dataclasses.replace(contender("link_com@2", gain, seed=1, noise=0.15), alias_class=first.alias_class)
        assert decide([first, second], control, rng).verdict == verdict


@pytest.mark.parametrize(
    ("shared", "size", "named"),
    [
        ("lugre", 1.0, "lugre"),
        ("lugre", 0.01, "lugre@1"),  # too small to matter
        ("stribeck", 1.0, "lugre@1"),  # another effect does not stand for it
    ],
)
def test_a_fault_that_counts_speaks_for_the_same_effect_in_all_joints(control, rng, shared, size, named):
    """In all joints it explains more, in uneven seconds, and wins most resamples; by itself it would be nothing."""
    gained = np.full(BLOCKS, -0.04)
    gained[:6] = 1.6
    whole = dataclasses.replace(contender(shared, 0.12, size=size), losses=control - gained)
    fault = contender("lugre@1", 0.11, seed=1)
    assert decide([whole], control, rng).verdict == "nothing_missing"
    decision = decide([whole, fault], control, rng)
    assert [whole, fault][decision.candidates[0]].label == named


def test_what_explains_more_in_the_same_place_counts_too(control, rng):
    """Uneven seconds spoil the statistics of the best; beside a look-alike that counts it is a candidate, alone not."""
    uneven = contender("current_offset@1", 0.09, noise=0.28)
    uneven = dataclasses.replace(uneven, losses=uneven.losses - uneven.losses.mean() + 0.91, alias_class="bias")
    clean = dataclasses.replace(contender("cable_spring@1", 0.07, seed=1), alias_class="bias")
    assert 2.0 < evidence(uneven, control)[0] < 3.0
    assert decide([uneven], control, rng).verdict == "nothing_missing"
    assert 0 in decide([uneven, clean], control, rng).candidates
    elsewhere = dataclasses.replace(clean, joints=(2,))
    assert 0 not in decide([uneven, elsewhere], control, rng).candidates


def test_what_does_harm_to_unseen_runs_is_no_candidate(control, rng):
    """An effect that learns the fitted runs by heart does not push aside what explains a little of all of them."""
    learned = dataclasses.replace(contender("stribeck@1", 0.12, noise=0.2), gain=-0.05, fit_gain=0.28)
    honest = contender("cable_spring@1", 0.07, seed=1)
    assert learned.losses.sum() < honest.losses.sum()
    decision = decide([learned, honest], control, rng)
    assert 0 not in decision.candidates
    # nor, behind another effect, one whose gains are those of a few seconds
    few = np.full(BLOCKS, 1.005)
    few[:6] = 0.0
    few = dataclasses.replace(contender("stribeck@1", 0.12), losses=few)
    found = [dataclasses.replace(contender("latency", 0.5, seed=3), gain=0.5)]
    assert 0 in decide([few, honest], control, rng).candidates
    assert 0 not in decide([few, honest], control, rng, found=found).candidates


@pytest.mark.parametrize("contenders", [0, 1, 2])
def test_a_large_gap_is_never_nothing(contenders, control, rng):
    """Where residual velocities are nine times the noise in all joints something is missing, whatever the names do."""
    small = contender("dte", 0.01)
    picked = [
        contender("cable_spring@1", 0.07, seed=1),
        dataclasses.replace(contender("viscous@2", 0.09, seed=2), size=1e-4),  # wins all resamples, and does not count
    ]
    given = ([], [small], picked)[contenders]
    assert decide(given, control, rng, left=np.full(6, 9.0)).verdict == "unknown"
    assert decide(given, control, rng, left=np.full(6, 1.0)).verdict == "nothing_missing"


def test_size_that_does_not_matter_is_not_named(control, rng):
    """However well it explains, an effect of a tenth of the smallest size that matters is passed over."""
    decision = decide([contender("dte", 0.3, size=0.01)], control, rng)
    assert decision.verdict == "nothing_missing"


def test_black_box_that_explains_much_more_is_unknown(control, rng):
    """Where a black box explains half and the catalogue a twentieth, the cause is not in the catalogue."""
    assert decide([contender("dte", 0.05)], control, rng, ceiling=0.5).verdict == "unknown"
    assert decide([contender("dte", 0.01)], control, rng, ceiling=0.5).verdict == "unknown"
    assert decide([contender("dte", 0.40)], control, rng, ceiling=0.5).verdict == "named"


def test_gain_of_a_few_odd_seconds_is_not_a_name(control, rng):
    """A tenth of the residual explained, all of it in three seconds: t is below two, and nothing is named."""
    odd = contender("compliance@4", 0.10)
    losses = np.ones(BLOCKS)
    losses[:3] -= 2.0
    decision = decide([dataclasses.replace(odd, losses=losses)], control, rng)
    assert decision.verdict == "nothing_missing"


def test_a_large_gain_may_be_unsteady(control, rng):
    """A sixth of the residual counts though some seconds contradict it; a twelfth does not, nor what a few give."""
    unsteady = np.where(np.arange(BLOCKS) % 3 == 0, -1.0, 1.0)
    for gain, verdict in ((0.17, "named"), (0.08, "nothing_missing")):
        losses = 1.0 - gain * unsteady / unsteady.mean()
        one = dataclasses.replace(contender("lugre", gain), losses=losses)
        assert 2.0 < evidence(one, control)[0] < 3.0
        assert decide([one], control, rng).verdict == verdict
    few = np.ones(BLOCKS)
    few[:5] -= 2.0
    assert (
        decide([dataclasses.replace(contender("lugre", 0.17), losses=few)], control, rng).verdict == "nothing_missing"
    )


def test_an_effect_that_helps_nearly_everywhere_counts(control, rng):
    """A few seconds with large residuals make the sum uncertain; the signed ranks tell that most seconds gained."""
    base, losses = np.ones(BLOCKS), np.full(BLOCKS, 0.8)
    base[:4], losses[:4] = 25.0, [15.0, 33.0, 14.0, 22.0]
    gained = base - losses
    assert gained.sum() / np.sqrt(np.square(gained).sum()) < 2.0
    one = dataclasses.replace(contender("current_offset", 0.15), losses=losses)
    assert signed_ranks(gained) > 3.0
    assert decide([one], base, rng).verdict == "named"
    only_fitted = dataclasses.replace(one, gain=0.03, fit_gain=0.27)
    assert decide([only_fitted], base, rng).verdict == "nothing_missing"


def test_gap_of_one_joint_that_no_effect_closes_is_unknown(control, rng):
    """A joint whose residual is five times that of the others: unknown, unless the best effect brings it down."""
    left = np.array([2.0, 2.0, 10.0, 2.0])
    for after, verdict in ((9.5, "unknown"), (2.5, "named")):
        best = dataclasses.replace(contender("viscous@2", 0.3), left=np.array([2.0, 2.0, after, 2.0]))
        assert decide([best], control, rng, left=left).verdict == verdict
    assert decide([], control, rng, left=left).verdict == "unknown"


@pytest.mark.parametrize(("left", "verdict"), [(9.0, "unknown"), (3.0, "nothing_missing")])
def test_a_large_gap_in_all_joints_is_never_taken_for_nothing(control, rng, left, verdict):
    """Where much is left everywhere something is missing, though no joint stands out and no effect explains it."""
    decision = decide([contender("dte", 0.01)], control, rng, left=np.full(6, left))
    assert (decision.verdict, decision.candidates) == (verdict, ())


@pytest.mark.parametrize(("gain", "size", "begun"), [(0.12, 0.1, (0,)), (0.05, 0.1, ()), (0.12, 0.0, ())])
def test_a_large_gap_is_begun_with_what_explains_a_part_of_it(control, rng, gain, size, begun):
    """Two strong effects hide each other; what may be one of them goes along to the next round."""
    losses = np.full(BLOCKS, 1.0 + 0.5 * gain)  # uneven: too little for a name
    losses[::4] -= 6.0 * gain
    part = dataclasses.replace(contender("lugre", gain, size=size), losses=losses)
    decision = decide([part], control, rng, left=np.full(6, 5.0))
    assert (decision.verdict, decision.candidates) == ("unknown", begun)


def test_a_name_that_few_resamples_pick_is_not_stated(control, rng):
    """Behind one that needs no size, a small effect wins few resamples; a large one is stated all the same."""
    for gain, verdict in ((0.09, "nothing_missing"), (0.3, "named")):
        better = contender("load_friction", gain + 0.05, size=0.0)
        decision = decide([better, contender("stribeck@5", gain, seed=1)], control, rng)
        assert decision.shares[1] < 0.3
        assert decision.verdict == verdict


def test_size_beyond_what_is_plausible_is_not_a_name(control, rng):
    """An effect that explains much but only at the bound of its range is unknown."""
    assert decide([dataclasses.replace(contender("dte", 0.3), implausible=True)], control, rng).verdict == "unknown"


@pytest.mark.parametrize(
    ("ahead", "verdict", "least", "most"),
    [(0.02, "ambiguous", 0.5, 0.9), (0.04, "named", UNDECIDED, UNDECIDED), (0.1, "named", 0.99, 1.0)],
)
def test_a_look_alike_that_wins_few_resamples_makes_a_name_less_sure(control, rng, ahead, verdict, least, most):
    """One that wins a tenth is a candidate beside it, one that wins a few hundredths lowers its confidence."""
    first = contender("encoder_offset@1", 0.30)
    noise = np.random.default_rng(3).normal(size=BLOCKS)
    losses = first.losses + ahead + 0.16 * (noise - noise.mean())
    second = dataclasses.replace(contender("link_com@2", 0.3 - ahead), alias_class=first.alias_class, losses=losses)
    decision = decide([first, second], control, rng)
    assert decision.verdict == verdict
    assert decision.candidates[0] == 0
    assert least <= decision.shares[0] <= most


def test_contacts_that_were_found_hide_nothing_elsewhere(control, rng):
    """What a loose gear leaves in its joint does not make a further name unknown; what stands out elsewhere does."""
    left = np.array([1.0, 1.1, 5.0, 1.0, 1.2, 1.0])
    found = [dataclasses.replace(contender("backlash@2", 0.4), left=left)]
    further = dataclasses.replace(contender("position_friction@0", 0.2), left=left)
    assert decide([further], control, rng, left=left, found=found).verdict == "named"
    further = dataclasses.replace(further, left=np.roll(left, 1))
    assert decide([further], control, rng, left=further.left, found=found).verdict == "unknown"


def test_look_alikes_by_cosine_are_candidates(control, rng):
    """Effects of different classes whose secants point the same way are both candidates; else the better is named."""
    first = dataclasses.replace(contender("link_com@1", 0.30, noise=0.15), direction=np.array([1.0, 0.0]))
    for direction, verdict in (([0.9, 0.436], "ambiguous"), ([0.0, 1.0], "named")):
        second = contender("encoder_offset@2", 0.26, seed=1, noise=0.15)
        second = dataclasses.replace(second, direction=np.array(direction))
        assert decide([first, second], control, rng).verdict == verdict


@pytest.mark.parametrize(
    ("further", "uneven", "name", "share"),
    [
        (0.015, 0.1, "coulomb@1", 0.7),
        (0.015, 0.01, "position_friction@1", 1.0),  # a twentieth, but nearly everywhere
        (0.15, 0.1, "position_friction@1", 1.0),
    ],
)
def test_fewer_numbers_are_preferred(control, rng, further, uneven, name, share):
    """Two numbers that explain a twentieth more than one alike do not win unless they do so in nearly every second.

    Where the resamples prefer the two, the one is not quite sure.
    """
    plain = dataclasses.replace(contender("coulomb@1", 0.30), joints=(1,), direction=np.array([1.0, 0.0]))
    noise = np.random.default_rng(5).normal(size=BLOCKS)
    richer = dataclasses.replace(
        contender("position_friction@1", 0.3 + further),
        losses=plain.losses - further - uneven * (noise - noise.mean()),
        numbers=2,
        direction=np.array([0.95, 0.31]),
    )
    decision = decide([richer, plain], control, rng)
    assert decision.verdict == "named"
    assert [richer, plain][decision.candidates[0]].label == name
    assert decision.shares[decision.candidates[0]] == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize(("known", "preferred"), [(("coulomb",), "coulomb@1"), ((), "position_friction@1")])
def test_fewer_numbers_are_preferred_of_confounders(control, rng, known, preferred):
    """What the catalogue says to be confused is alike, whatever the cosine to these logs; else the best is best."""
    plain = dataclasses.replace(contender("coulomb@1", 0.30), direction=np.array([1.0, 0.0]))
    uneven = np.random.default_rng(5).normal(size=BLOCKS)
    richer = dataclasses.replace(
        contender("position_friction@1", 0.305),
        losses=plain.losses - 0.005 - 0.03 * (uneven - uneven.mean()),
        numbers=2,
        direction=np.array([0.69, 0.72]),
        confounders=known,
    )
    decision = decide([richer, plain], control, rng)
    assert [richer, plain][decision.candidates[0]].label == preferred


def test_what_is_preferred_and_wins_is_as_sure_as_both(control, rng):
    """Fewer numbers that win most resamples are credited with those of the richer law."""
    plain = dataclasses.replace(contender("coulomb@1", 0.30, noise=0.1), joints=(1,), direction=np.array([1.0, 0.0]))
    richer = dataclasses.replace(plain, label="position_friction@1", effect="position_friction", numbers=2)
    noise = np.random.default_rng(5).normal(size=BLOCKS)
    richer = dataclasses.replace(richer, losses=plain.losses + 0.1 * (noise - noise.mean()) + 0.009)
    assert 0.5 < pick_shares(np.stack([plain.losses, richer.losses]), rng)[0] < 0.95
    assert decide([plain, richer], control, rng).shares[0] > 0.95


def test_another_form_in_all_joints_stands_for_nothing(control, rng):
    """An effect of all joints that counts is not replaced by another law of it that explains more in few seconds."""
    gained = np.full(BLOCKS, -0.002)
    gained[:3] = 2.0
    other = dataclasses.replace(contender("lugre", 0.1), losses=control - gained)
    assert decide([other, contender("lugre", 0.07)], control, rng).candidates == (1,)
    fault = contender("lugre@1", 0.09)
    assert [other, fault][decide([other, fault], control, rng).candidates[0]].label == "lugre@1"


def test_forms_of_one_effect_share_their_confidence(control, rng):
    """An effect in two forms, each the better in half of the resamples, is as sure as their sum."""
    forms = [contender("dte", 0.3, noise=0.1, seed=seed) for seed in (0, 1)]
    decision = decide([*forms, contender("backlash@3", 0.1, seed=2)], control, rng)
    assert decision.verdict == "named"
    assert decision.shares[decision.candidates[0]] > 0.99


def in_one_joint(effect: str, kind: str, after: float, gain: float = 0.07) -> Contender:
    """A fault of joint 3 that leaves so much there, and whose gain is that of a few seconds."""
    losses = np.ones(BLOCKS)
    losses[:2] -= 0.5 * gain * BLOCKS
    left = np.array([1.5, 1.2, 1.7, after, 1.4, 1.6])
    return Contender(f"{effect}@3", effect, (3,), kind, gain, gain, losses, 1.0, 0.1, False, left=left)


@pytest.mark.parametrize(
    ("effect", "kind", "after", "verdict"),
    [
        ("backlash", "transmission", 4.8, "named"),  # impacts: what is left is large with the right effect too
        ("backlash", "transmission", 5.8, "unknown"),
        ("cogging", "position", 4.8, "unknown"),
    ],
)
def test_contacts_may_leave_more_of_a_gap(control, rng, effect, kind, after, verdict):
    """Where one joint stands out, half of its gap is too little for a ripple and enough for a gap between teeth."""
    left = np.array([1.5, 1.2, 1.7, 6.3, 1.4, 1.6])
    assert decide([in_one_joint(effect, kind, after)], control, rng, left=left).verdict == verdict


def test_a_joint_that_stands_out_afterwards_is_unknown(control, rng):
    """A spring that explains three quarters of what a creeping element does is not the name of it, but a start."""
    left = np.array([2.5, 1.7, 11.5, 3.9, 2.0, 2.1])
    for after, verdict in ((5.8, "unknown"), (2.4, "named")):
        best = dataclasses.replace(contender("cable_spring@2", 0.5), left=np.where(left == 11.5, after, left))
        decision = decide([best], control, rng, left=left)
        assert (decision.verdict, decision.candidates) == (verdict, (0,))


def test_a_further_effect_may_be_smaller(control, rng):
    """Beside a name, two percent in nearly every second count; alone they do not, and a few seconds never do."""
    steady = contender("asymmetric_friction@1", 0.024, noise=0.02)
    earlier = [contender("dte", 0.3)]
    assert decide([steady], control, rng, found=earlier).verdict == "named"
    assert decide([steady], control, rng).verdict == "nothing_missing"
    few = in_one_joint("coulomb", "dry", 1.6, gain=0.024)
    assert decide([few], control, rng, found=earlier).verdict == "nothing_missing"


@pytest.mark.parametrize(
    ("label", "gain", "left", "verdict"),
    [
        ("stribeck", 0.03, 1.0, "nothing_missing"),
        ("stribeck", 0.03, 1.7, "named"),
        ("stribeck", 0.06, 1.0, "named"),
        ("stribeck@1", 0.03, 1.0, "named"),
    ],
)
def test_a_small_further_effect_of_all_joints_needs_room(control, rng, label, gain, left, verdict):
    """Where all that is left is noise, three percent of it in all joints are what a law gets wrong."""
    earlier = [dataclasses.replace(contender("viscous@2", 0.3), left=np.full(6, left))]
    assert decide([contender(label, gain)], control, rng, found=earlier).verdict == verdict


@pytest.mark.parametrize(("gained", "verdict"), [(0.2, "named"), (0.13, "nothing_missing")])
def test_a_further_effect_that_explains_enough_needs_less_of_the_ranks(control, rng, gained, verdict):
    """Of sixty seconds 28 gain: the ranks say 2.8 and t more than 3, of 7.7 % of the residual and of 4.5 %."""
    gains = np.where(np.arange(BLOCKS) % 15 < 7, gained, -0.03) + 1e-4 * rng.normal(size=BLOCKS)
    explained = float(gains.mean())
    further = dataclasses.replace(contender("coulomb@1", explained), gain=explained, losses=control - gains)
    assert FURTHER_Z < signed_ranks(gains) < SMALLEST_Z
    assert evidence(further, control)[0] > SMALLEST_T
    assert decide([further], control, rng, found=[contender("dte", 0.3)]).verdict == verdict


@pytest.mark.parametrize(("name", "verdict"), [("packet_drop", "named"), ("latency", "nothing_missing")])
def test_what_acts_in_few_seconds_may_be_a_further_effect(control, rng, name, verdict):
    """Of sixty seconds fourteen have gained much and the others lost a little: ranks tell little, and need not."""
    gained = np.full(BLOCKS, -0.02) + 0.01 * rng.normal(size=BLOCKS)
    gained[:14] += rng.uniform(0.6, 1.0, size=14)
    seldom = dataclasses.replace(contender(name, 0.2), losses=control - gained)
    assert signed_ranks(gained) < SMALLEST_Z
    assert decide([seldom], control, rng, found=[contender("current_lag", 0.3)]).verdict == verdict


@pytest.mark.parametrize(
    ("gain", "fit_gain", "seconds", "total", "verdict"),
    [
        (0.2, 0.2, BLOCKS, 0.03, "named"),
        (0.2, 0.01, BLOCKS, 0.03, "nothing_missing"),  # the choosing runs alone
        (0.2, 0.2, 2, 0.03, "nothing_missing"),  # in two seconds alone
        (0.2, 0.2, BLOCKS, -0.02, "nothing_missing"),  # at the cost of other joints
    ],
)
def test_a_fault_is_seen_in_its_own_joint(control, rng, gain, fit_gain, seconds, total, verdict):
    """What explains three percent of all may explain a fifth of its joint, and counts if it does so everywhere."""
    gained = np.zeros(BLOCKS)
    gained[:seconds] = 1.0 + 0.5 * np.random.default_rng(2).normal(size=seconds)
    own = Own(gain, fit_gain, np.full(BLOCKS, 5.0), gained)
    fault = dataclasses.replace(contender("asymmetric_friction@1", total), own=own)
    decision = decide([fault], control, rng)
    assert decision.verdict == verdict
    if verdict == "named":
        assert decision.reason == "it explains 20% of the residual of its joint"


@pytest.mark.parametrize(
    ("effect", "bound", "verdict"),
    [
        ("link_com", False, "named"),
        ("link_com", True, "nothing_missing"),
        ("position_friction", False, "nothing_missing"),
    ],
)
def test_what_is_not_of_friction_needs_fewer_seconds_of_its_joint(control, rng, effect, bound, verdict):
    """Of sixty seconds half have gained, with a t above 3 and ranks of about 3, a tenth of their joint's residual."""
    numbers = np.random.default_rng(2)
    gained = np.where(np.arange(BLOCKS) < 28, 1.0, -0.05) * numbers.uniform(0.5, 1.5, size=BLOCKS)
    own = Own(0.12, 0.12, np.full(BLOCKS, 2.0), gained)
    losses = control - 0.02 * gained
    fault = dataclasses.replace(contender(f"{effect}@1", 0.01), own=own, losses=losses, implausible=bound)
    assert decide([fault], control, rng, found=[contender("link_mass@5", 0.1)]).verdict == verdict
    assert decide([fault], control, rng).verdict == "nothing_missing"


def test_a_rival_has_to_explain_its_joint_too(control, rng):
    """Two that look alike explain the same of all joints; of their own the one explains three times as much."""
    pair = [contender("terminal_resistance@4", 0.2, noise=0.15), contender("encoder_nonlinearity@4", 0.2, seed=1)]
    pair = [dataclasses.replace(one, direction=np.array([1.0, 0.0])) for one in pair]
    for share, verdict in ((0.17, "named"), (0.4, "ambiguous")):
        gains = (0.5, share) if pair[0].losses.sum() < pair[1].losses.sum() else (share, 0.5)
        owns = [Own(gain, gain, np.full(BLOCKS, 2.0), np.full(BLOCKS, gain)) for gain in gains]
        given = [dataclasses.replace(one, own=own) for one, own in zip(pair, owns, strict=True)]
        assert decide(given, control, rng).verdict == verdict


def test_what_a_law_leaves_is_no_further_effect(control, rng):
    """Behind a strong effect, a confounder that explains little of what that did is a matter of its law."""
    earlier = [contender("link_mass@5", 0.8)]
    small, large = (contender("encoder_offset@5", gain) for gain in (0.15, 0.4))
    for one, verdict in ((small, "nothing_missing"), (large, "named")):
        confused = dataclasses.replace(one, confounders=("link_mass",))
        assert decide([confused], control, rng, found=earlier).verdict == verdict
        assert decide([one], control, rng, found=earlier).verdict == "named"
    same = dataclasses.replace(contender("link_mass@5", 0.15), confounders=("link_mass",))
    assert decide([same], control, rng, found=earlier).verdict == "named"  # the rest of it, not another effect
    elsewhere = dataclasses.replace(contender("encoder_offset@1", 0.15), confounders=("link_mass",))
    assert decide([elsewhere], control, rng, found=earlier).verdict == "named"
    latency, friction = contender("latency", 0.9), contender("load_friction", 0.2)
    assert decide([friction], control, rng, found=[latency]).verdict == "nothing_missing"  # both in all joints
    assert decide([contender("load_friction@3", 0.2)], control, rng, found=[latency]).verdict == "named"
    limb = [dataclasses.replace(one, alias_class="gravity_phase") for one in (elsewhere, earlier[0])]
    assert decide(limb[:1], control, rng, found=limb[1:]).verdict == "nothing_missing"


@pytest.mark.parametrize(
    ("effect", "gain", "left", "after", "verdict"),
    [
        ("velocity_filter", 0.25, 6.0, 3.9, "named"),
        ("velocity_filter", 0.25, 6.0, 5.9, "nothing_missing"),
        ("velocity_filter", 0.25, 3.0, 1.0, "nothing_missing"),
        ("current_lag", 0.10, 3.0, 2.5, "named"),  # a latency stands for it, and leaves this much of it
        ("current_lag", 0.03, 3.0, 2.5, "nothing_missing"),
    ],
)
def test_a_large_gap_is_more_than_a_law_leaves(control, rng, effect, gain, left, after, verdict):
    """Behind a latency that leaves six times the noise in all joints, what closes much of that counts."""
    earlier = dataclasses.replace(contender("latency", 0.96), left=np.full(6, left))
    lag = dataclasses.replace(contender(effect, gain), confounders=("latency",), left=np.full(6, after))
    assert decide([lag], control, rng, found=[earlier]).verdict == verdict


def test_a_size_beyond_what_is_plausible_is_not_named(control, rng):
    """What ended at its bound gives way to one that explains nearly as much, and is unknown where none does."""
    at_bound = dataclasses.replace(contender("link_com@4", 0.5), implausible=True)
    near, far = contender("link_mass@5", 0.4, seed=1), contender("link_inertia@5", 0.1, seed=2)
    decision = decide([at_bound, near], control, rng)
    assert (decision.verdict, decision.candidates) == ("named", (1,))
    assert decision.shares.tolist() == [0.0, 1.0]
    assert decide([at_bound, far], control, rng).verdict == "unknown"


@pytest.mark.parametrize(
    ("effect", "gain", "counts"), [("voltage_sag", 0.08, True), ("voltage_sag", 0.05, False), ("dte", 0.08, False)]
)
def test_what_acts_at_the_voltage_alone_needs_few_seconds(control, rng, effect, gain, counts):
    """A sag in every eighth second, with as much won as lost in others: t and ranks are small, and it counts still."""
    gained = np.resize([2.6, -2.6], BLOCKS) * gain
    gained[::8] = 8.0 * gain
    gained[1::8][:4] *= -1.0  # as many up as down beside them
    gained = np.round(gained * 1024) / 1024  # so that equal ones stay equal
    one = dataclasses.replace(contender(effect, gain), losses=control - gained)
    statistic, trimmed = evidence(one, control)
    assert 2.0 < statistic < SMALLEST_T
    assert trimmed > 0.02
    assert signed_ranks(gained) < SMALLEST_Z
    assert (decide([one], control, rng).verdict == "named") == counts


@pytest.mark.parametrize(
    ("label", "gain", "fit_gain", "verdict"),
    [
        ("encoder_offset@1", 0.025, 0.025, "named"),
        ("latency", 0.02, 0.02, "named"),
        ("stribeck", 0.025, 0.025, "nothing_missing"),  # what a law of friction gets wrong looks like that
        ("encoder_offset@1", 0.01, 0.06, "nothing_missing"),  # of the fitted runs alone
        ("encoder_offset@1", 0.012, 0.012, "nothing_missing"),
    ],
)
def test_what_is_not_of_friction_counts_though_it_is_small(control, rng, label, gain, fit_gain, verdict):
    """A zero or a latency that explains 2 % in nearly every second is there; a friction that does may not be."""
    one = dataclasses.replace(contender(label, 0.5 * (gain + fit_gain), noise=0.01), gain=gain, fit_gain=fit_gain)
    assert min(evidence(one, control)[0], signed_ranks(control - one.losses)) > SMALLEST_T
    assert decide([one], control, rng).verdict == verdict


def test_what_is_small_needs_both_seconds_and_ranks(control, rng):
    """Explained in a few seconds, 3 % speak for nothing."""
    gained = np.full(BLOCKS, -0.01)
    gained[:4] = 0.6
    few = dataclasses.replace(contender("encoder_offset@1", 0.03), losses=control - gained)
    assert decide([few], control, rng).verdict == "nothing_missing"
