"""Whether an effect counts: that it is large enough, explains enough, and does so in more than a few seconds."""

from collections.abc import Sequence

import numpy as np

from op3.diagnose.evidence import Contender, Own, cosine, evidence, signed_ranks, statistic_of
from op3.diagnose.gaps import closed, large_gap, stands_out
from op3.diagnose.thresholds import (
    ALONG_THE_LIMB,
    ANOTHER,
    BEHIND,
    BEHIND_GAIN,
    BESIDE_GAIN,
    BESIDE_SHARED_GAIN,
    BESIDE_Z,
    BEYOND_DOUBT,
    CLEAR_GAIN,
    CLEAR_T,
    CLEAR_TRIMMED,
    CONTACTS,
    DOUBLY_CHECKED,
    EXPLAINED_CONTACT,
    FIRM,
    FIRM_GAIN,
    FIRM_OWN_T,
    FIRM_OWN_Z,
    FIRM_TRIMMED,
    FURTHER_Z,
    LATER_GAIN,
    LATER_TRIMMED,
    LATER_Z,
    LIMITED,
    LIMITED_GAIN,
    OCCASIONAL,
    OWN_CHECKED,
    OWN_CLEAR,
    OWN_CLEAR_Z,
    OWN_GAIN,
    OWN_T,
    OWN_TOTAL_T,
    OWN_Z,
    RESIDUE,
    SHARED_RESIDUE,
    SHARED_ROOM,
    SMALLEST_GAIN,
    SMALLEST_T,
    SMALLEST_Z,
    TRIMMED,
    TRIMMED_GAIN,
)


def counts(contender: Contender, control: np.ndarray, found: Sequence[Contender], leads: bool) -> bool:
    """Whether a contender is large enough, explains enough, and does so in more than a few blocks.

    Args:
        contender: which.
        control: losses without it, ``[block]``.
        found: the leaders of earlier rounds. Behind them the ranks must reach `FURTHER_Z`, but of `OCCASIONAL`, of
            what explains `OWN_CLEAR` of its joint, and of what is not of friction and shows there.
        leads: whether it explains most; a further effect that does may explain less than is usual.
    """
    statistic, trimmed = evidence(contender, control)
    score = signed_ranks(control - contender.losses)
    explained, least = contender.explained, min(contender.gain, contender.fit_gain)
    further = bool(found)
    ranks = FURTHER_Z if explained >= SMALLEST_GAIN else SMALLEST_Z
    occasional = contender.effect in OCCASIONAL and explained >= SMALLEST_GAIN
    own = contender.own
    at_home = own is not None and min(own.gain, own.fit_gain) >= OWN_CLEAR and shows_at_home(own)
    at_home |= further and _firm_at_home(contender)
    seldom = further and score < ranks and not occasional and not at_home
    if not contender.large or seldom:
        return False
    if _left_over(contender, found):
        return False
    steady = least >= SMALLEST_GAIN and score >= SMALLEST_Z
    usual = least > 0.25 * SMALLEST_GAIN and explained >= SMALLEST_GAIN and (statistic >= SMALLEST_T or steady)
    clear = least >= 0.5 * CLEAR_GAIN and explained >= CLEAR_GAIN and statistic >= CLEAR_T
    small = explained >= LATER_GAIN and statistic >= SMALLEST_T and trimmed >= LATER_TRIMMED
    small &= least >= 0.5 * LATER_GAIN
    small |= least >= LATER_GAIN and score >= LATER_Z
    small &= contender.joints is not None or not found or _room(found[-1].left)
    limited = contender.effect in LIMITED and contender.joints is None and explained >= LIMITED_GAIN
    limited &= least >= 0.5 * LIMITED_GAIN and statistic >= CLEAR_T
    firm = contender.effect in FIRM and not further and not contender.implausible
    firm &= least >= FIRM_GAIN and trimmed >= FIRM_TRIMMED and statistic >= SMALLEST_T and score >= FURTHER_Z
    common = ((usual or limited) and trimmed >= TRIMMED_GAIN) or (clear and trimmed >= CLEAR_TRIMMED) or firm
    return common or (further and leads and small) or _counts_at_home(contender, control, further)


def as_well(
    contenders: Sequence[Contender],
    number: int,
    counted: Sequence[int],
    control: np.ndarray,
    found: Sequence[Contender],
) -> bool:
    """Whether a contender explains more than the best that counts, in the same joints.

    That something is there is known then, and which it is must not hang on a threshold: a sensor's zero explained most,
    with a t of 2.8 and ranks of 2.2, and three that look like it counted.
    """
    one = contenders[number]
    if not counted or one.joints is None or one.joints != contenders[counted[0]].joints:
        return False
    more = float(one.losses.sum()) < float(contenders[counted[0]].losses.sum())
    return more and evidence(one, control)[0] >= CLEAR_T and matters(one, control, found)


def matters(one: Contender, control: np.ndarray, found: Sequence[Contender]) -> bool:
    """Whether an effect is large, plausible and no residue, and explains enough in more than a few seconds."""
    if one.implausible or not one.large or _left_over(one, found):
        return False
    if found and signed_ranks(control - one.losses) < SMALLEST_Z:
        return False
    enough = min(one.gain, one.fit_gain) > 0.25 * SMALLEST_GAIN and one.explained >= SMALLEST_GAIN
    return enough and evidence(one, control)[1] >= TRIMMED_GAIN


def begins(contender: Contender, control: np.ndarray) -> bool:
    """Whether an effect that does not count may be a part of what is missing, so that the rest is looked for beside it.

    Two strong effects hide each other: a lag of friction explained 0.12 with a t of 2.7, the static friction that was
    hidden with it 0.05.
    """
    statistic, trimmed = evidence(contender, control)
    large = contender.large and not contender.implausible
    return large and contender.explained >= DOUBLY_CHECKED and statistic >= CLEAR_T and trimmed >= TRIMMED_GAIN


def beyond_doubt(contender: Contender, control: np.ndarray) -> bool:
    """Whether seconds and ranks leave no doubt of a contender, see `BEYOND_DOUBT`."""
    return min(evidence(contender, control)[0], signed_ranks(control - contender.losses)) >= BEYOND_DOUBT


def _counts_at_home(contender: Contender, control: np.ndarray, further: bool) -> bool:
    """Whether a fault of one joint explains enough of this joint's residuals at no other's cost."""
    own = contender.own
    if own is None or evidence(contender, control)[0] < OWN_TOTAL_T:
        return False
    return shows_at_home(own) or (further and _firm_at_home(contender))


def _firm_at_home(contender: Contender) -> bool:
    """Whether what is not of friction explains enough of its joint's residuals: with the usual t, and fewer ranks."""
    own, firm = contender.own, contender.effect in FIRM and not contender.implausible
    return firm and own is not None and shows_at_home(own, FIRM_OWN_T, FIRM_OWN_Z)


def shows_at_home(own: Own, statistic: float = OWN_T, most_ranks: float = OWN_Z) -> bool:
    """Whether a fault of one joint explains enough of this joint's residuals, nearly everywhere.

    Args:
        own: what it explains there.
        statistic: that it must reach.
        most_ranks: score that its ranks must reach if it explains `OWN_GAIN`.
    """
    if min(own.gain, own.fit_gain) < OWN_GAIN:
        return False
    trimmed = float(np.sort(own.gained)[:-TRIMMED].sum() / own.control.sum())
    # the more it explains, the fewer seconds it need act in
    ranks = float(np.interp(min(own.gain, own.fit_gain), (OWN_GAIN, OWN_CLEAR), (most_ranks, OWN_CLEAR_Z)))
    return trimmed >= TRIMMED_GAIN and statistic_of(own.gained) >= statistic and signed_ranks(own.gained) >= ranks


def meets(contender: Contender, left: np.ndarray | None) -> bool:
    """Whether a contender with contacts explains the joint that stands out as well as such effects can."""
    joint = stands_out(left)
    if joint is None or contender.effect not in CONTACTS or contender.joints != (joint,):
        return False
    assert left is not None
    large = contender.large and contender.explained >= SMALLEST_GAIN
    return large and closed(contender, left, joint) >= EXPLAINED_CONTACT


def _left_over(contender: Contender, found: Sequence[Contender]) -> bool:
    """Whether a further effect is no more than what the law of an earlier one may have left.

    That is no large gap; what takes half of its squares away is more.
    """
    if found and large_gap(found[-1].left) and contender.left.size:
        before, after = (float(np.median(np.square(one.left))) for one in (found[-1], contender))
        if after < 0.5 * before:
            return False
    share, explained = 1.0, []  # of what the first round had to explain
    for one in found:
        explained.append(share * one.explained)
        share *= 1.0 - one.explained
    return any(
        share * contender.explained < _residue(one, contender) * gained
        for one, gained in zip(found, explained, strict=True)
    )


def _residue(one: Contender, other: Contender) -> float:
    """Share of what an earlier effect explained that may be left of it for another to explain."""
    shared = one.joints is None and other.joints is None and one.effect != other.effect
    if shared and BEHIND.get(other.effect) == one.effect and min(other.gain, other.fit_gain) >= BEHIND_GAIN:
        return 0.0
    if confused(one, other):
        return RESIDUE
    return SHARED_RESIDUE if shared else 0.0


def confused(one: Contender, other: Contender) -> bool:
    """Whether two effects, in these joints, may be taken for each other; an effect and the rest of itself are one."""
    same_class = bool(one.alias_class) and one.alias_class == other.alias_class
    alike = same_class or one.effect in other.confounders or other.effect in one.confounders
    apart = one.joints is not None and other.joints is not None and not set(one.joints) & set(other.joints)
    apart &= one.alias_class != ALONG_THE_LIMB
    return alike and not apart and (one.effect, one.joints) != (other.effect, other.joints)


def _room(left: np.ndarray) -> bool:
    """Whether most joints leave room for a further effect; where that is not known they may."""
    return not left.size or float(np.median(left)) > SHARED_ROOM


def of_another_kind(one: Contender, leader: Contender, control: np.ndarray, found: Sequence[Contender] = ()) -> bool:
    """Whether an effect of all joints counts beside a leader of all joints that it cannot be taken for.

    Args:
        one: which; where its direction is not known, it is taken for the leader.
        leader: what was found.
        control: losses without either, ``[block]``.
        found: the leaders of earlier rounds.
    """
    shared = one.joints is None and leader.joints is None and one.effect != leader.effect
    known = one.direction.size and one.direction.shape == leader.direction.shape
    if not shared or not known or confused(one, leader) or one.implausible:
        return False
    enough = one.explained >= (cosine(one, leader) ** 2 + ANOTHER) * leader.explained
    return enough and counts(one, control, found, False)


def better_beside(one: Own, alone: bool = True) -> bool:
    """Whether an effect explains more of some joints than what was found does.

    Args:
        one: what it explains there, where the control is what was found.
        alone: whether it is a fault of one joint.
    """
    least = BESIDE_GAIN if alone else BESIDE_SHARED_GAIN
    gain = min(one.gain, one.fit_gain)
    return gain >= OWN_CLEAR or (gain >= least and signed_ranks(one.gained) >= BESIDE_Z)


def shown_by_windows(one: Contender) -> float:
    """The larger of the shares of all joints' residual and of its own joint's that speak for a name by themselves."""
    own = 0.0 if one.own is None else one.own.gain
    return max(one.explained, own if own >= OWN_CHECKED or one.explained >= SMALLEST_GAIN else 0.0)


def worth_a_candidate(one: Contender) -> bool:
    """Whether an effect of logs that are too few or too poor for a name explains enough to be told as a candidate."""
    return one.large and not one.implausible and min(one.gain, one.fit_gain) >= CLEAR_GAIN
