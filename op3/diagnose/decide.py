"""The decision: named, ambiguous, unknown or nothing missing."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from op3.diagnose.coordinates import chain_limit
from op3.diagnose.counting import as_well, begins, confused, counts, matters, meets
from op3.diagnose.evidence import Contender, cosine, difference_interval, pick_shares, signed_ranks, statistic_of
from op3.diagnose.gaps import but_contacts, closed, large_gap, stands_out
from op3.diagnose.thresholds import (
    ALIKE_SHARE,
    CEILING,
    CLEAR_GAIN,
    CONTACTS,
    EXPLAINED,
    EXPLAINED_CONTACT,
    LOOK_ALIKE,
    MOST_CANDIDATES,
    NAMED_SHARE,
    OF_A_MAKE,
    PARSIMONY,
    PARSIMONY_T,
    PARSIMONY_Z,
    PICKED,
    PREFERRED,
    RIVAL,
    SHORT,
    SMALLEST_GAIN,
    SURELY_ALIKE,
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
    left = but_contacts(left, found)
    order = sorted(range(len(contenders)), key=lambda i: float(contenders[i].losses.sum()))
    counted = [i for i in order if counts(contenders[i], control, found, i == order[0]) or meets(contenders[i], left)]
    beside = [i for i in order if i not in counted and as_well(contenders, i, counted, control, found)]
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
        begun = order[:1] if begins(best, control) else []
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
    if not rivals and _doubtful(contenders, best, control):
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
        if matters(one, control, found):
            return i
    return best


def _doubtful(contenders: Sequence[Contender], best: int, control: np.ndarray) -> bool:
    """Whether a name wins the resamples and is to be doubted all the same.

    A law that servos of a make share is, where it would be that of one joint; so is a delay no longer than the lag that
    any chain of measurement may have; and so is what another effect of the same joints explains a tenth more of, with
    a size that is not plausible: friction that depends on the angle was called Coulomb friction, as its worst angle
    had not been seen.
    """
    one = contenders[best]
    if one.joints is not None and len(one.joints) == 1 and one.effect in OF_A_MAKE:
        return True
    if one.effect in SHORT and abs(one.size) < chain_limit(SHORT[one.effect]):
        return True
    gained = float((control - one.losses).sum())
    beyond = [c for c in contenders if c.implausible and c.joints == one.joints and c.effect != one.effect]
    return any(float((one.losses - c.losses).sum()) > PARSIMONY * gained for c in beyond)


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
        share = closed(best, left, joint) if best is not None and counting else 0.0
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
        alike = (same or cosine(winner, other) > LOOK_ALIKE) and other.effect != winner.effect
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
    explained = other.own.gain + other.own.fit_gain
    return explained > 0 and one.own.gain + one.own.fit_gain < RIVAL * explained


def _look_alike(one: Contender, other: Contender) -> bool:
    """Whether two effects of the same joints look alike, to these logs or by the catalogue."""
    return cosine(one, other) > LOOK_ALIKE or confused(one, other)
