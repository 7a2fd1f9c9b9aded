"""The decision: named, ambiguous, unknown or nothing missing."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from op3.diagnose.evidence import Contender, Own, difference_interval, evidence, pick_shares, signed_ranks, statistic_of
from op3.diagnose.thresholds import (
    ALIKE_SHARE,
    ALONG_THE_LIMB,
    ANOTHER,
    BEHIND,
    BEHIND_GAIN,
    BESIDE_GAIN,
    BESIDE_SHARED_GAIN,
    BESIDE_Z,
    BEYOND_DOUBT,
    CEILING,
    CLEAR_GAIN,
    CLEAR_T,
    CLEAR_TRIMMED,
    CONCENTRATED,
    CONTACTS,
    DOUBLY_CHECKED,
    EXPLAINED,
    EXPLAINED_CONTACT,
    FIRM,
    FIRM_GAIN,
    FIRM_TRIMMED,
    FURTHER_Z,
    LARGE_GAP,
    LATER_GAIN,
    LATER_TRIMMED,
    LATER_Z,
    LIMITED,
    LIMITED_GAIN,
    LOOK_ALIKE,
    MOST_CANDIDATES,
    NAMED_SHARE,
    OCCASIONAL,
    OF_A_MAKE,
    OUTSTANDING,
    OWN_CHECKED,
    OWN_CLEAR,
    OWN_CLEAR_Z,
    OWN_GAIN,
    OWN_T,
    OWN_TOTAL_T,
    OWN_Z,
    PARSIMONY,
    PARSIMONY_T,
    PARSIMONY_Z,
    PICKED,
    PREFERRED,
    RESIDUE,
    RIVAL,
    ROOM,
    SHARED_RESIDUE,
    SHARED_ROOM,
    SHORT,
    SMALLEST_GAIN,
    SMALLEST_T,
    SMALLEST_Z,
    STANDING,
    SURELY_ALIKE,
    TRIMMED,
    TRIMMED_GAIN,
    UNDECIDED,
)

BEATEN = np.float64(1e12)
"""Loss in place of that of a contender that is out of the question."""


@dataclass(frozen=True)
class Decision:
    """What follows from the contenders.

    Attributes:
        verdict: ``named``, ``ambiguous``, ``unknown`` or ``nothing_missing``.
        candidates: numbers of the contenders that the verdict is about, best first; where one joint makes the verdict
            unknown, the best that counts: another effect may explain the rest of it.
        shares: share of resamples that each contender wins, ``[contender]``.
        reason: one sentence.
    """

    verdict: str
    candidates: tuple[int, ...]
    shares: np.ndarray
    reason: str


def decide(
    contenders: Sequence[Contender],
    control: np.ndarray,
    rng: np.random.Generator,
    *,
    ceiling: float | None = None,
    left: np.ndarray | None = None,
    found: Sequence[Contender] = (),
) -> Decision:
    """Weigh contenders against each other and against nothing.

    Args:
        contenders: after their refits.
        control: losses of the no-op control per block: the base refitted with the same effort, ``[block]``.
        rng: of the resampling.
        ceiling: share of the residual that a black box of one joint explains on the choosing runs, see
            `local_ceiling`; None if not known.
        left: residual velocity of each joint under the control, see `Contender`; None if not known.
        found: the leaders of earlier rounds.
    """
    left = _but_contacts(left, found)
    order = sorted(range(len(contenders)), key=lambda i: float(contenders[i].losses.sum()))
    counted = [i for i in order if _counts(contenders[i], control, found, i == order[0]) or _meets(contenders[i], left)]
    beside = [i for i in order if i not in counted and _as_well(contenders, i, counted, control, found)]
    counting = _within_bounds(contenders, [i for i in order if i in counted or i in beside], control)
    beaten = {*counted, *beside} - set(counting)
    losses = [BEATEN if i in beaten else c.losses for i, c in enumerate(contenders)]
    shares = pick_shares(np.stack(np.broadcast_arrays(*losses)), rng) if contenders else np.zeros(0)
    gap = _unexplained(contenders, counting, order, ceiling, left)
    if gap:
        begun = [i for i in counting[:1] if stands_out(left) is not None and not contenders[i].implausible]
        return Decision("unknown", tuple(begun), shares, gap)
    if not counting:
        if not contenders:
            return _nothing("no effect of the catalogue can be seen in these logs", shares, left)
        best = contenders[order[0]]
        # what is missing may not count as long as the rest is missing
        begun = order[:1] if _begins(best, control) else []
        said = f"the best of the catalogue, {best.label}, explains {max(best.gain, 0):.1%}"
        return _nothing(said, shares, left, begun)
    best = _in_all_joints(contenders, _simplest(contenders, counting, control), control, shares, found)
    others = [i for i in counting if i != best and not _more_than(contenders[i], contenders[best], control)]
    alone = _credited(shares, contenders, best, [i for i in order if i != best])[best]
    passed = [i for i in counting if i != best and i not in others and shares[i] > alone]
    shares = _credited(shares, contenders, best, others)
    rivals = _rivals(contenders, best, others, control, shares, rng)
    if passed:
        shares[best] = min(shares[best], PREFERRED)
    if not rivals and _doubtful(contenders, best):
        shares[best] = min(shares[best], UNDECIDED)
    if not rivals and _rivals(contenders, best, others, control, shares, rng, SURELY_ALIKE):
        shares[best] = min(shares[best], UNDECIDED)
    if best in beside and not rivals:  # it alone would not have been named
        rivals = [i for i in counting if i in counted][:1]
    if not rivals and shares[best] < PICKED and contenders[best].explained < CLEAR_GAIN:
        said = f"the best that counts, {contenders[best].label}, explains {contenders[best].gain:.1%}"
        return _nothing(f"{said}, and {shares[best]:.0%} of resamples agree", shares, left)
    if not rivals:
        return Decision("named", (best,), shares, _what_it_explains(contenders[best]))
    members = (best, *rivals)[:MOST_CANDIDATES]
    said = ", ".join(f"{contenders[i].label} {max(contenders[i].explained, 0.0):.0%}" for i in members)
    return Decision(
        "ambiguous", members, shares, f"resamples of these logs do not decide between what explains: {said}"
    )


def large_gap(left: np.ndarray | None) -> float:
    """What is left in most joints, in standard deviations of a reading, if that is too much for nothing; else 0."""
    usual = float(np.median(left)) if left is not None and left.size else 0.0
    return usual if usual > LARGE_GAP else 0.0


def _but_contacts(left: np.ndarray | None, found: Sequence[Contender]) -> np.ndarray | None:
    """What is left in each joint; of one in which contacts were found, whose rattling stays, what is left in most."""
    at = [joint for one in found if one.effect in CONTACTS for joint in one.joints or ()]
    if left is None or not left.size or not at:
        return left
    result = left.copy()
    result[at] = np.median(left)
    return result


def leaves_a_joint(leaders: Sequence[Contender]) -> bool:
    """Whether what was found leaves more in one joint than in others; impacts in their own joint do.

    Args:
        leaders: of every round; what the last leaves counts.
    """
    left = leaders[-1].left
    if not left.size or left.max() <= max(ROOM, STANDING * float(np.median(left))):
        return False
    return not any(one.effect in CONTACTS and one.joints == (int(left.argmax()),) for one in leaders)


def shown_by_windows(one: Contender) -> float:
    """The larger of the shares of all joints' residual and of its own joint's that speak for a name by themselves."""
    own = 0.0 if one.own is None else one.own.gain
    return max(one.explained, own if own >= OWN_CHECKED or one.explained >= SMALLEST_GAIN else 0.0)


def worth_a_candidate(one: Contender) -> bool:
    """Whether an effect of logs that are too few or too poor for a name explains enough to be told as a candidate."""
    return one.large and not one.implausible and min(one.gain, one.fit_gain) >= CLEAR_GAIN


def better_beside(one: Own, alone: bool = True) -> bool:
    """Whether an effect explains more of some joints than what was found does.

    Args:
        one: what it explains there, where the control is what was found.
        alone: whether it is a fault of one joint.
    """
    least = BESIDE_GAIN if alone else BESIDE_SHARED_GAIN
    gain = min(one.gain, one.fit_gain)
    return gain >= OWN_CLEAR or (gain >= least and signed_ranks(one.gained) >= BESIDE_Z)


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
    if not shared or not known or _confused(one, leader) or one.implausible:
        return False
    enough = one.explained >= (_cosine(one, leader) ** 2 + ANOTHER) * leader.explained
    return enough and _counts(one, control, found, False)


def _nothing(said: str, shares: np.ndarray, left: np.ndarray | None, begun: Sequence[int] = ()) -> Decision:
    """That nothing is missing; where much is, that it is unknown."""
    usual = large_gap(left)
    if usual:
        return Decision(
            "unknown", tuple(begun), shares, f"residual velocities are {usual:.1f} times the noise, and {said}"
        )
    return Decision("nothing_missing", (), shares, said)


def weigh(contenders: Sequence[Contender], control: np.ndarray, rng: np.random.Generator) -> tuple[int, list[int]]:
    """The best of contenders that all count, and those that the data do not tell from it.

    Args:
        contenders: at least one.
        control: losses without any of them, ``[block]``.
        rng: of the resampling.
    """
    order = sorted(range(len(contenders)), key=lambda i: float(contenders[i].losses.sum()))
    shares = pick_shares(np.stack([c.losses for c in contenders]), rng)
    return order[0], _rivals(contenders, order[0], order[1:], control, shares, rng)


def _simplest(contenders: Sequence[Contender], counting: Sequence[int], control: np.ndarray) -> int:
    """The best of those that count, or one with fewer numbers that explains nearly as much in the same joints."""
    best = counting[0]
    for i in counting[1:]:
        if contenders[i].numbers < contenders[best].numbers and _more_than(contenders[best], contenders[i], control):
            best = i
    return best


def _in_all_joints(
    contenders: Sequence[Contender],
    best: int,
    control: np.ndarray,
    shares: np.ndarray,
    found: Sequence[Contender],
) -> int:
    """The same effect in all joints, if it wins more of the resamples than the fault that counts, else the best.

    That the effect is there is known then, so it need not reach the t or the ranks of one that is not, but for acting
    in more than a few seconds. Bristles in all joints explained 0.16 and 0.04 with a t of 1.2, those of one joint alone
    0.06 and 0.10, and counted.
    """
    fault = contenders[best]
    if fault.joints is None:
        return best
    for i, one in enumerate(contenders):
        if one.effect != fault.effect or one.joints is not None or shares[i] <= shares[best]:
            continue
        if _matters(one, control, found):
            return i
    return best


def _doubtful(contenders: Sequence[Contender], best: int) -> bool:
    """Whether a name wins the resamples and is to be doubted all the same.

    A law that servos of a make share is, where it would be that of one joint; so is a delay no longer than the lag that
    any chain of measurement may have; and so is what another effect of the same joints explains more of, with a size
    that is not plausible: friction that depends on the angle was called Coulomb friction, as its worst angle had not
    been seen.
    """
    one = contenders[best]
    if one.joints is not None and len(one.joints) == 1 and one.effect in OF_A_MAKE:
        return True
    if abs(one.size) < SHORT.get(one.effect, 0.0):
        return True
    beyond = [c for c in contenders if c.implausible and c.joints == one.joints and c.effect != one.effect]
    return any(float(c.losses.sum()) < float(one.losses.sum()) for c in beyond)


def _more_than(one: Contender, other: Contender, control: np.ndarray) -> bool:
    """Whether one is the other with more numbers, and these explain little."""
    gained = float((control - one.losses).sum())
    further = other.losses - one.losses
    alike = one.joints == other.joints and _look_alike(one, other)
    little = further.sum() < PARSIMONY * gained
    sure = statistic_of(further) >= PARSIMONY_T and signed_ranks(further) >= PARSIMONY_Z
    return one.numbers > other.numbers and alike and little and not sure


def _credited(shares: np.ndarray, contenders: Sequence[Contender], best: int, others: Sequence[int]) -> np.ndarray:
    """Shares of resamples, those of the best in another form, and of what it was preferred to, counted for it."""
    result = shares.copy()
    winner = contenders[best]
    for i, one in enumerate(contenders):
        form = one.effect == winner.effect and one.joints == winner.joints
        alike = one.joints == winner.joints and one.numbers > winner.numbers and _look_alike(one, winner)
        if i != best and (form or (alike and i not in others)):
            result[best] += result[i]
            result[i] = 0.0
    return result


def local_ceiling(gain: float, by_joint: np.ndarray) -> float | None:
    """What a black box explains in one joint; None where no joint stands out.

    Args:
        gain: of all joints' torques together.
        by_joint: of each alone, ``[joint]``.
    """
    largest = float(by_joint.max()) if by_joint.size else 0.0
    return largest if largest > 0 and largest >= CONCENTRATED * gain else None


def stands_out(left: np.ndarray | None) -> int | None:
    """The joint in which something is missing whatever the catalogue says; None if there is none."""
    if left is None or not left.size or left.max() <= max(LARGE_GAP, OUTSTANDING * float(np.median(left))):
        return None
    return int(left.argmax())


def unresolved(named: Sequence[Contender]) -> bool:
    """Whether what several rounds have named leaves a gap as large as `LARGE_GAP`; of impacts in its joint it may.

    That the joint stands out no longer is not enough: names that are not the right ones bend all others as well.

    Args:
        named: the leader of every round; what the last leaves counts.
    """
    left = named[-1].left if named else np.zeros(0)
    if not left.size or left.max() <= LARGE_GAP:
        return False
    return not any(one.effect in CONTACTS and one.joints == (int(left.argmax()),) for one in named)


def contradicted(named: Sequence[Contender], joint: int | None) -> bool:
    """Whether the joint in which a later round finds something unknown is the one of a fault that was named.

    A hard stop was taken for friction by load, which explained half of it and left 37 times the noise. Impacts, whose
    rattling stays, are no such fault.

    Args:
        named: the leader of every round.
        joint: that stands out beside them, see `stands_out`; None if none does.
    """
    return joint is not None and any(one.joints == (joint,) and one.effect not in CONTACTS for one in named)


def _closed(contender: Contender, left: np.ndarray, joint: int) -> float:
    """Share of a joint's gap, beyond what is usual in others, that a contender explains."""
    usual = float(np.median(left))
    return float((left[joint] ** 2 - contender.left[joint] ** 2) / (left[joint] ** 2 - usual**2))


def _meets(contender: Contender, left: np.ndarray | None) -> bool:
    """Whether a contender with contacts explains the joint that stands out as well as such effects can."""
    joint = stands_out(left)
    if joint is None or contender.effect not in CONTACTS or contender.joints != (joint,):
        return False
    assert left is not None
    large = contender.large and contender.explained >= SMALLEST_GAIN
    return large and _closed(contender, left, joint) >= EXPLAINED_CONTACT


def _what_it_explains(contender: Contender) -> str:
    own = contender.own
    if own is None or contender.gain >= SMALLEST_GAIN:
        return f"it explains {contender.gain:.0%} of the residual"
    return f"it explains {own.gain:.0%} of the residual of its joint"


def _within_bounds(contenders: Sequence[Contender], counting: list[int], control: np.ndarray) -> list[int]:
    """Those that count without what needs an implausible size, if they explain nearly as much; else only those."""
    plausible = [i for i in counting if not contenders[i].implausible]
    beyond = [i for i in counting if contenders[i].implausible]
    if not plausible or not beyond:
        return counting
    gained = [float((control - contenders[i].losses).sum()) for i in (plausible[0], beyond[0])]
    return plausible if gained[0] > RIVAL * gained[1] else beyond


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
    if _confused(one, other):
        return RESIDUE
    return SHARED_RESIDUE if shared else 0.0


def _confused(one: Contender, other: Contender) -> bool:
    """Whether two effects, in these joints, may be taken for each other; an effect and the rest of itself are one."""
    same_class = bool(one.alias_class) and one.alias_class == other.alias_class
    alike = same_class or one.effect in other.confounders or other.effect in one.confounders
    apart = one.joints is not None and other.joints is not None and not set(one.joints) & set(other.joints)
    apart &= one.alias_class != ALONG_THE_LIMB
    return alike and not apart and (one.effect, one.joints) != (other.effect, other.joints)


def _counts(contender: Contender, control: np.ndarray, found: Sequence[Contender], leads: bool) -> bool:
    """Whether a contender is large enough, explains enough, and does so in more than a few blocks.

    Args:
        contender: which.
        control: losses without it, ``[block]``.
        found: the leaders of earlier rounds. Behind them the ranks must reach `FURTHER_Z`, but of `OCCASIONAL` and of
            what explains `OWN_CLEAR` of its joint.
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


def _room(left: np.ndarray) -> bool:
    """Whether most joints leave room for a further effect; where that is not known they may."""
    return not left.size or float(np.median(left)) > SHARED_ROOM


def beyond_doubt(contender: Contender, control: np.ndarray) -> bool:
    """Whether seconds and ranks leave no doubt of a contender, see `BEYOND_DOUBT`."""
    return min(evidence(contender, control)[0], signed_ranks(control - contender.losses)) >= BEYOND_DOUBT


def _as_well(
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
    return more and evidence(one, control)[0] >= CLEAR_T and _matters(one, control, found)


def _matters(one: Contender, control: np.ndarray, found: Sequence[Contender]) -> bool:
    """Whether an effect is large, plausible and no residue, and explains enough in more than a few seconds."""
    if one.implausible or not one.large or _left_over(one, found):
        return False
    if found and signed_ranks(control - one.losses) < SMALLEST_Z:
        return False
    enough = min(one.gain, one.fit_gain) > 0.25 * SMALLEST_GAIN and one.explained >= SMALLEST_GAIN
    return enough and evidence(one, control)[1] >= TRIMMED_GAIN


def _begins(contender: Contender, control: np.ndarray) -> bool:
    """Whether an effect that does not count may be a part of what is missing, so that the rest is looked for beside it.

    Two strong effects hide each other: a lag of friction explained 0.12 with a t of 2.7, the static friction that was
    hidden with it 0.05.
    """
    statistic, trimmed = evidence(contender, control)
    large = contender.large and not contender.implausible
    return large and contender.explained >= DOUBLY_CHECKED and statistic >= CLEAR_T and trimmed >= TRIMMED_GAIN


def _counts_at_home(contender: Contender, control: np.ndarray, further: bool) -> bool:
    """Whether a fault of one joint explains enough of this joint's residuals at no other's cost."""
    own = contender.own
    if own is None or evidence(contender, control)[0] < OWN_TOTAL_T:
        return False
    return shows_at_home(own) or (further and _firm_at_home(contender))


def _firm_at_home(contender: Contender) -> bool:
    """Whether what is not of friction explains enough of its joint's residuals: with the usual t, and fewer ranks."""
    own, firm = contender.own, contender.effect in FIRM and not contender.implausible
    return firm and own is not None and shows_at_home(own, SMALLEST_T, FURTHER_Z)


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


def _unexplained(
    contenders: Sequence[Contender],
    counting: Sequence[int],
    order: Sequence[int],
    ceiling: float | None,
    left: np.ndarray | None,
) -> str:
    """Why something is missing that the catalogue does not explain; empty if there is no sign of it."""
    best = contenders[(counting or order)[0]] if contenders else None
    name = "nothing in the catalogue" if best is None else f"the best of the catalogue, {best.label},"
    joint = stands_out(left)
    if joint is not None and left is not None:
        usual = float(np.median(left))
        share = _closed(best, left, joint) if best is not None and counting else 0.0
        contact = best is not None and best.effect in CONTACTS and best.joints == (joint,)
        gap = f"residual velocities are {left[joint]:.1f} times the noise in one joint, {usual:.1f} in others"
        if share < (EXPLAINED_CONTACT if contact else EXPLAINED):
            return f"{gap}, and {name} explains {max(share, 0.0):.0%} of what is above it"
        if best is not None and not contact and stands_out(best.left) == joint:
            return f"{gap}, and {name} leaves {best.left[joint]:.1f} there"
    explained = best.explained if best is not None and counting else 0.0
    if ceiling is not None and ceiling > CEILING and explained < EXPLAINED * ceiling:
        return f"a black box explains {ceiling:.0%} of the residual, {name} explains {explained:.0%}"
    if counting and all(contenders[i].implausible for i in counting):
        return f"{name} would need a size beyond what is plausible"
    return ""


def _rivals(contenders, best, others, control, shares, rng, alike_share: float = ALIKE_SHARE) -> list[int]:
    """Contenders that the data do not tell from the best; look-alikes of one that wins less than `alike_share`."""
    rivals = []
    winner = contenders[best]
    gained = float((control - winner.losses).sum())
    for i in others:
        other = contenders[i]
        if other.effect == winner.effect and (other.joints == winner.joints or shares[best] > 0.5):
            continue  # the same effect in another form or place is a matter of joints, not of names
        low, _ = difference_interval(winner.losses, other.losses, rng)
        close = float((control - other.losses).sum()) > RIVAL * gained and not _less_at_home(other, winner)
        # look-alikes differ by little more than what any model gets wrong: more certainty is asked for
        same = bool(winner.alias_class) and other.alias_class == winner.alias_class
        alike = (same or _cosine(winner, other) > LOOK_ALIKE) and other.effect != winner.effect
        alike &= bool(shares[best] < alike_share)
        if close and (alike or (low <= 0 and shares[best] < NAMED_SHARE)):
            rivals.append(i)
    return rivals


def _less_at_home(one: Contender, other: Contender) -> bool:
    """Whether one explains much less than another of the residuals of the joint in which both sit.

    What it explains of other joints is what the base does there beside it.
    """
    if one.own is None or other.own is None or one.joints != other.joints:
        return False
    return one.own.gain + one.own.fit_gain < RIVAL * (other.own.gain + other.own.fit_gain)


def _look_alike(one: Contender, other: Contender) -> bool:
    """Whether two effects of the same joints look alike, to these logs or by the catalogue."""
    return _cosine(one, other) > LOOK_ALIKE or _confused(one, other)


def _cosine(one: Contender, other: Contender) -> float:
    """How alike two secants are beyond the base, without sign; 0 where they are not known."""
    if not one.direction.size or one.direction.shape != other.direction.shape:
        return 0.0
    return float(abs(one.direction @ other.direction))
