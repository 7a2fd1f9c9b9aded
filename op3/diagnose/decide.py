"""The decision: named, ambiguous, unknown or nothing missing. All thresholds stand here."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

SMALLEST_GAIN = 0.05
"""Share of the residual (mean of fitted and choosing runs) that an effect must explain to count. Six empty development
legs gave up to 0.04 beyond the other two rules below."""

DOUBLY_CHECKED = 0.08
"""What explains less than this counts only if free runs do not speak against it. On an empty leg an asymmetry of
friction explained 0.05 of windows, and free runs were worse with it; a true zero error of an encoder that they did not
bear either explained 0.09."""

BEYOND_DOUBT = 4.9
"""Statistic of the gain and score of its ranks, both, from which on free runs are not asked. A true quadratic drag that
explained 0.07 had 5.0 and 5.2; on 24 empty legs the smaller of the two was 4.8 once, of static friction that explained
0.03 and so did not count, and else 3.7 at most."""

OWN_CLEAR, OWN_CLEAR_Z = 0.35, 2.0
"""Share of its joint's residual, in fitted and choosing runs, from which on the fault of a joint needs only this of the
ranks; between `OWN_GAIN` and this the score falls linearly from `OWN_Z`. A terminal resistance acts where a servo is at
its voltage, and elsewhere not at all. Beside a sagging supply it explained 0.64 and 0.44 of its joint."""

OWN_CHECKED = 0.25
"""What explains less of its own joint than this, and of all joints less than `SMALLEST_GAIN`, counts only if free runs
of that joint do not speak against it either. With twenty joints one may look faulty by chance: an elbow of an empty
robot had 0.15."""

SMALLEST_T = 3.0
"""Gain over its standard error, seconds being independent, that an effect must reach. A few odd windows give a large
gain with a t of 1 to 2; empty development legs reached 2.9 at a gain of 0.04."""

SMALLEST_Z = 3.0
"""Standard score of the gains' signed ranks that will do in place of t, if both the fitted and the choosing runs gain
`SMALLEST_GAIN`: a few windows with large residuals spoil the t of an effect that helps nearly everywhere. A true zero
error of a current sensor had 3.8 at a t of 1.3; the leaders of two empty legs had 1.8 and 2.0."""

CLEAR_GAIN, CLEAR_T, CLEAR_TRIMMED = 0.15, 2.0, 0.08
"""Gain of an effect that may count at a smaller t, if it is not that of a few seconds and the choosing runs show half
of it. Of two strong effects hidden together the first gave a gain of 0.17 at a t of 2.3, because in some seconds the
other one makes the model wrong. The largest gain in six empty legs was 0.09."""

LATER_GAIN, LATER_TRIMMED = 0.02, 0.01
"""Gain of a further effect that counts where t and the score of the ranks both reach their thresholds: one of a single
joint, beside one of all, has a small share of what is left. A true asymmetry of friction in one joint had 4.4 and 5.1
at a gain of 0.024, beside a lag of the current loop. Where nothing further was hidden the smaller of the two reached
2.5 in 23 development legs, at a gain of up to 0.11. Of an effect of all joints this holds only where these have `ROOM`:
five robots without static friction seemed to have some behind the one effect that was hidden (0.02 to 0.04, t of 3.6 to
4.9), while all that was left was 0.9 to 1.1 times the noise; a true one behind bristles explained 0.03 of 2.3 times."""

RESIDUE = 0.05
"""Share of what an earlier effect explained that a further one must explain where the catalogue says that they may be
confused: no law is quite the robot's, and what is left of one looks like its confounders. Of a false mass of a link,
which explained 0.83, an encoder's zero seemed to be left (0.03)."""

SHARED_RESIDUE = 0.03
"""The same of any two effects that all joints share: what one leaves in all joints, another seems to explain. Behind a
strong latency (0.92, 0.96) load_friction seemed to explain 0.023 and 0.004 of what that did; in true pairs of shared
effects the second had at least 0.057."""

BEHIND, BEHIND_GAIN = {"current_lag": "latency"}, 0.06
"""Effects of all joints that another stands for where they are not in the model, and the share of what that one leaves,
in fitted and choosing runs, from which on they are no residue of its law: behind strong latencies that were hidden with
a lag of the current loop, and explained 0.93 and 0.98, the lag explained 0.61 and 0.34 of the rest. Behind seven that
were hidden alone it explained less than 0.03."""

LATER_Z = 4.0
"""Score of the ranks that will do in place of t for a further effect if fitted and choosing runs both gain
`LATER_GAIN`. A true asymmetry of friction had 4.5 at a t of 1.4, beside a sensor's zero in another joint; where nothing
further was hidden it reached 3.0."""

OWN_GAIN, OWN_T, OWN_Z, OWN_TOTAL_T = 0.08, 2.0, 4.0, 1.0
"""What a fault of one joint may explain instead, of the residuals of this joint alone, in fitted and choosing runs, if
the whole has not become worse: the other joints' residuals, which it leaves as they are, hide it. A true asymmetry of
friction that explained 0.03 of all explained 0.19 of its joint's (t 3.9, score of the ranks 5.5), a friction that
depends on the angle 0.19 (2.3, 4.5). On five empty legs the leaders explained at most 0.01 in both (score 2.6)."""

FURTHER_Z = 2.5
"""Score of the ranks that a further effect must reach in any case, if it explains `SMALLEST_GAIN`; of one that explains
less `SMALLEST_Z` is asked. Behind the one effect that was hidden in 17 legs, what explained that much had t of 1.7 at
most."""

OCCASIONAL = ("packet_drop",)
"""Effects that act in few seconds, each of which tells by itself: behind others too they need not reach a score of the
ranks if they explain `SMALLEST_GAIN`. Lost packets beside a lag of the current loop explained 0.28 of what that left
with a t of 3.4, the ranks 1.7."""

LIMITED, LIMITED_GAIN = ("voltage_sag",), 0.06
"""Effects of all joints that act only where servos are at their voltage, so that t and ranks over all seconds tell
little, and the share of the residual from which on they count at a t of `CLEAR_T`, fitted and choosing runs each having
half of it. Moderate sags that were hidden explained 0.07 to 0.12; where none was, 0.05 at most in some hundred legs,
and 0.013 in 36 sound ones."""

FIRM = (
    *("encoder_offset", "encoder_nonlinearity", "link_mass", "link_com", "link_inertia", "payload", "com_offset"),
    *("cable_spring", "current_offset", "torque_constant", "terminal_resistance", "voltage_sag", "latency"),
    *("current_lag", "velocity_filter", "packet_drop"),
)
"""Effects that are not of friction. What a law of friction gets wrong, as every law does, looks like other friction:
static friction explained 0.02 and 0.03 of an empty leg, with a t of 4.1. It does not look like these."""

FIRM_GAIN, FIRM_TRIMMED = 0.016, 0.01
"""Share of the residual that such an effect must explain, in fitted and choosing runs each, if t and the score of its
ranks both reach their thresholds. Zero errors of encoders, a centre of mass and non-linear encoders that were hidden
explained 0.02 to 0.04 at a t of 3.1 to 3.3 (ranks 2.6 to 3.5); on 36 empty legs none of these effects explained more
than 0.010 in both at a t above 2."""

TRIMMED = 3
"""Seconds with the largest gain that are left out for the next rule."""

TRIMMED_GAIN = 0.02
"""Share of the residual that must still be explained without them: an effect acts in more than a few seconds."""

LARGE_GAP = 4.0
"""Residual velocity of a joint, in standard deviations of a reading (root mean square over windows of 0.2 s), beyond
which something is missing whatever the catalogue says, if the joint also stands out by `OUTSTANDING`. In five
development legs joints in which nothing was hidden had 0.8 to 2.9, one with a strong sticky patch 5.4."""

OUTSTANDING = 2.5
"""How many times the median of all joints that is: model errors are shared by joints of one make. Empty development
legs gave up to 1.7, strong outsiders 4 and more."""

ROOM = 2.0
"""Residual velocity, in standard deviations of a reading, up to which a joint leaves no room for a further effect."""

STANDING = 1.8
"""How many times the median of all joints the residual velocity of one is that leaves room for a further effect. Where
one effect was hidden the leader left up to 1.5 times, impacts aside; beside a cable's spring that was hidden too, 2.0
to 3."""

BESIDE_GAIN, BESIDE_SHARED_GAIN, BESIDE_Z = 0.1, 0.03, 2.5
"""Share of a joint's residual under the leader by which another effect there has to be better, in fitted and choosing
runs, for a further round; the same of an effect of all joints in those that the leader does not act in; and the score
of the ranks. Where one effect was hidden in a joint, none of all joints was better in the others at all."""

ANOTHER = 0.4
"""Share of what the leader explains that an effect must explain, both of all joints, beyond the square of the cosine
between the two, which one effect gives another for nothing: then they are two, and a further round follows. A lag of
the current loop that was hidden beside one of friction explained 0.85 of what that did at a cosine of 0.24; where one
effect was hidden, others that were not its confounders explained 0.12 of it at most."""

ALONG_THE_LIMB = "gravity_phase"
"""Alias class of effects that act in the other joints of a limb as well: they are confused from joint to joint."""

SMALLEST_SIZE = 0.7
"""Size below which an effect does not matter, as a share of the catalogue's smallest."""

RIVAL = 0.6
"""A rival that explains this share of what the best explains, and cannot be told from it, is a candidate too."""

NAMED_SHARE = 0.8
"""Share of bootstrap resamples that the best must win to be named alone."""

ALIKE_SHARE = 0.9
"""The same where the next best is of the same alias class, which explains nearly the same. Of twelve leaders that won
this share in development cases eleven were right."""

SURELY_ALIKE = 0.99
"""The same for its confidence not to be cut to `UNDECIDED`."""

PICKED = 0.3
"""Share of resamples in which a name has to be the best to be stated, unless it explains `CLEAR_GAIN`."""

UNDECIDED = 0.7
"""Most confidence that a candidate of an ambiguous verdict has: resampling tells what noise can do, not what a law that
is a little wrong does to effects that look alike. A sensor's zero won 99 % against the asymmetric friction that was
hidden."""

PARSIMONY = 0.1
"""Share of what the best explains that a hypothesis with fewer numbers may fall short of it and still be preferred: a
further number explains some of what any law gets wrong."""

PARSIMONY_T, PARSIMONY_Z = 2.5, 3.0
"""Gain of the best over it in standard errors, and score of its ranks, at which it is not, however little more the best
explains: what a law gets wrong does not tell in nearly every second."""

PREFERRED = 0.7
"""Confidence at most in what was preferred so to another that counts and wins more of the resamples. A non-linear
encoder that was hidden behind a viscous joint was taken for a zero error, which has one number less and explained 0.097
for 0.103."""

BEATEN = np.float64(1e12)
"""Loss in place of that of a contender that is out of the question."""

RESAMPLES = 1000
"""Bootstrap resamples over blocks of a second."""

CONTACTS = ("backlash",)
"""Effects with free flight and impacts, in which small errors of the start grow: what the right one leaves is large as
well."""

EXPLAINED_CONTACT = 0.2
"""What such an effect must explain of the gap in the joint that stands out, in place of `EXPLAINED`; it then counts
without the t. A true backlash explained 0.46 where nothing else explained 0.02, one of a light foot, whose rattling is
soon a matter of chance, 0.25. Where an obstacle, a fixed frequency, or a chipped tooth was hidden, the best of all
effects explained 0.11 at most."""

EXPLAINED = 0.5
"""Share of the reducible gap, or of what a black box explains, that the best of the catalogue must explain; below it
the verdict is unknown."""

CEILING = 0.12
"""Share of the residual that a black box must explain on the choosing runs for something to be missing. On empty legs
it explains nothing on runs that it has not seen."""

CONCENTRATED = 0.6
"""Share of what the black box explains that one joint must carry: a law of friction that is a little wrong shows
in all joints. An empty development leg with little friction gave 0.39 (of 32 % explained), local outsiders 0.9."""

LOOK_ALIKE = 0.7
"""Cosine beyond which two effects look alike to the logs, so that a name needs more certainty."""

MOST_CANDIDATES = 3
"""Candidates that an ambiguous verdict lists."""


@dataclass(frozen=True, eq=False)
class Own:
    """What a hypothesis of one joint explains of this joint's residuals.

    Attributes:
        gain: share of the choosing runs' beyond the no-op control.
        fit_gain: the same of the fitted runs.
        control: sums of squares under the control, per block, ``[block]``.
        gained: control less hypothesis, ``[block]``.
    """

    gain: float
    fit_gain: float
    control: np.ndarray
    gained: np.ndarray


@dataclass(frozen=True, eq=False)
class Contender:
    """A hypothesis after its refit.

    Attributes:
        label: effect and joint.
        effect: name.
        joints: columns; None for all.
        alias_class: of the effect.
        gain: share of the residual of the choosing runs explained beyond the no-op control.
        fit_gain: the same of the fitted runs.
        losses: sum of squares per block of a second, ``[block]``, of all windows.
        size: of the effect, in its unit.
        smallest: the smallest that matters.
        implausible: whether the size ended at a bound.
        left: residual velocity of each joint that it leaves, in standard deviations of a reading, ``[joint]``; empty if
            the engine has none.
        direction: of its secant beyond the base, normalised; empty if not known.
        numbers: how many were fitted beside the base.
        own: what it explains in its own joint; None for all joints.
        confounders: effects that may be taken for it, by the catalogue.
    """

    label: str
    effect: str
    joints: tuple[int, ...] | None
    alias_class: str
    gain: float
    fit_gain: float
    losses: np.ndarray
    size: float
    smallest: float
    implausible: bool
    left: np.ndarray = field(default_factory=lambda: np.zeros(0))
    direction: np.ndarray = field(default_factory=lambda: np.zeros(0))
    numbers: int = 1
    own: Own | None = None
    confounders: tuple[str, ...] = ()

    @property
    def explained(self) -> float:
        """Share of the residual that it explains, mean of choosing and fitted runs."""
        return 0.5 * (self.gain + self.fit_gain)


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


def pick_shares(losses: np.ndarray, rng: np.random.Generator, resamples: int = RESAMPLES) -> np.ndarray:
    """How often each contender has the smallest loss when blocks are drawn anew.

    Args:
        losses: ``[contender, block]``.
        rng: of the resampling.
        resamples: how many.
    """
    blocks = losses.shape[1]
    weights = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), size=resamples)
    winners = (losses @ weights.T).argmin(0)
    return np.bincount(winners, minlength=len(losses)) / resamples


def difference_interval(
    better: np.ndarray, worse: np.ndarray, rng: np.random.Generator, level: float = 0.9, resamples: int = RESAMPLES
) -> tuple[float, float]:
    """Bootstrap interval of the difference of two losses over blocks, ``worse - better``."""
    difference = worse - better
    weights = rng.multinomial(len(difference), np.full(len(difference), 1.0 / len(difference)), size=resamples)
    low, high = np.quantile(weights @ difference, [0.5 - level / 2, 0.5 + level / 2])
    return float(low), float(high)


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
        begun = [i for i in counting[:1] if _stands_out(left) is not None and not contenders[i].implausible]
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
    large = abs(one.size) >= SMALLEST_SIZE * one.smallest and not one.implausible
    return large and min(one.gain, one.fit_gain) >= CLEAR_GAIN


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


def _more_than(one: Contender, other: Contender, control: np.ndarray) -> bool:
    """Whether one is the other with more numbers, and these explain little."""
    gained = float((control - one.losses).sum())
    further = other.losses - one.losses
    alike = one.joints == other.joints and _look_alike(one, other)
    little = further.sum() < PARSIMONY * gained
    sure = _statistic(further) >= PARSIMONY_T and signed_ranks(further) >= PARSIMONY_Z
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


def evidence(contender: Contender, control: np.ndarray) -> tuple[float, float]:
    """Statistic of the gain over blocks, and the share still explained without the best `TRIMMED` blocks."""
    gained = control - contender.losses
    return _statistic(gained), float(np.sort(gained)[:-TRIMMED].sum() / control.sum())


def _statistic(gained: np.ndarray) -> float:
    """A sum over blocks over its standard error, the blocks being independent."""
    return float(gained.sum()) / max(1e-12, float(np.sqrt(np.square(gained).sum())))


def signed_ranks(differences: np.ndarray) -> float:
    """Standard score of Wilcoxon's signed ranks, with mean ranks where differences are alike; zeros do not count."""
    differences = differences[differences != 0.0]
    count = len(differences)
    if not count:
        return 0.0
    _, place, alike = np.unique(np.abs(differences), return_inverse=True, return_counts=True)
    ranks = (np.cumsum(alike) - (alike - 1) / 2)[place]
    variance = count * (count + 1) * (2 * count + 1) / 24 - float((alike**3 - alike).sum()) / 48
    return (float(ranks[differences > 0].sum()) - count * (count + 1) / 4) / float(np.sqrt(variance))


def _stands_out(left: np.ndarray | None) -> int | None:
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


def _closed(contender: Contender, left: np.ndarray, joint: int) -> float:
    """Share of a joint's gap, beyond what is usual in others, that a contender explains."""
    usual = float(np.median(left))
    return float((left[joint] ** 2 - contender.left[joint] ** 2) / (left[joint] ** 2 - usual**2))


def _meets(contender: Contender, left: np.ndarray | None) -> bool:
    """Whether a contender with contacts explains the joint that stands out as well as such effects can."""
    joint = _stands_out(left)
    if joint is None or contender.effect not in CONTACTS or contender.joints != (joint,):
        return False
    assert left is not None
    large = abs(contender.size) >= SMALLEST_SIZE * contender.smallest and contender.explained >= SMALLEST_GAIN
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
    seldom = further and score < ranks and not occasional and not at_home
    if abs(contender.size) < SMALLEST_SIZE * contender.smallest or seldom:
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
    return common or (further and leads and small) or _counts_at_home(contender, control)


def _room(left: np.ndarray) -> bool:
    """Whether most joints leave room for a further effect; where that is not known they may."""
    return not left.size or float(np.median(left)) > ROOM


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
    if one.implausible or abs(one.size) < SMALLEST_SIZE * one.smallest or _left_over(one, found):
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
    large = abs(contender.size) >= SMALLEST_SIZE * contender.smallest and not contender.implausible
    return large and contender.explained >= DOUBLY_CHECKED and statistic >= CLEAR_T and trimmed >= TRIMMED_GAIN


def _counts_at_home(contender: Contender, control: np.ndarray) -> bool:
    """Whether a fault of one joint explains enough of this joint's residuals at no other's cost."""
    own = contender.own
    return own is not None and evidence(contender, control)[0] >= OWN_TOTAL_T and shows_at_home(own)


def shows_at_home(own: Own) -> bool:
    """Whether a fault of one joint explains enough of this joint's residuals, nearly everywhere."""
    if min(own.gain, own.fit_gain) < OWN_GAIN:
        return False
    trimmed = float(np.sort(own.gained)[:-TRIMMED].sum() / own.control.sum())
    # the more it explains, the fewer seconds it need act in
    ranks = float(np.interp(min(own.gain, own.fit_gain), (OWN_GAIN, OWN_CLEAR), (OWN_Z, OWN_CLEAR_Z)))
    return trimmed >= TRIMMED_GAIN and _statistic(own.gained) >= OWN_T and signed_ranks(own.gained) >= ranks


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
    joint = _stands_out(left)
    if joint is not None and left is not None:
        usual = float(np.median(left))
        share = _closed(best, left, joint) if best is not None and counting else 0.0
        contact = best is not None and best.effect in CONTACTS and best.joints == (joint,)
        gap = f"residual velocities are {left[joint]:.1f} times the noise in one joint, {usual:.1f} in others"
        if share < (EXPLAINED_CONTACT if contact else EXPLAINED):
            return f"{gap}, and {name} explains {max(share, 0.0):.0%} of what is above it"
        if best is not None and not contact and _stands_out(best.left) == joint:
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
        close = float((control - other.losses).sum()) > RIVAL * gained
        # look-alikes differ by little more than what any model gets wrong: more certainty is asked for
        same = bool(winner.alias_class) and other.alias_class == winner.alias_class
        alike = (same or _cosine(winner, other) > LOOK_ALIKE) and other.effect != winner.effect
        alike &= bool(shares[best] < alike_share)
        if close and (alike or (low <= 0 and shares[best] < NAMED_SHARE)):
            rivals.append(i)
    return rivals


def _look_alike(one: Contender, other: Contender) -> bool:
    """Whether two effects of the same joints look alike, to these logs or by the catalogue."""
    return _cosine(one, other) > LOOK_ALIKE or _confused(one, other)


def _cosine(one: Contender, other: Contender) -> float:
    """How alike two secants are beyond the base, without sign; 0 where they are not known."""
    if not one.direction.size or one.direction.shape != other.direction.shape:
        return 0.0
    return float(abs(one.direction @ other.direction))
