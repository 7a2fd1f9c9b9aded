"""The decision: named, ambiguous, unknown or nothing missing. All thresholds stand here."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SMALLEST_GAIN = 0.06
"""Share of the residual of the choosing runs that an effect must explain to count: above what cases without a missing
effect give."""

SMALLEST_SIZE = 0.7
"""Size below which an effect does not matter, as a share of the catalogue's smallest."""

RIVAL = 0.6
"""A rival that explains this share of what the best explains, and cannot be told from it, is a candidate too."""

NAMED_SHARE = 0.8
"""Share of bootstrap resamples that the best must win to be named alone."""

ALIKE_SHARE = 0.99
"""The same where the next best is of the same alias class, which explains nearly the same."""

RESAMPLES = 1000
"""Bootstrap resamples over blocks of a second."""

EXPLAINED = 0.3
"""Share of what a black box explains that a catalogue effect must explain; below it the verdict is unknown."""

CEILING = 0.10
"""Share of the residual torque that a black box must explain on the choosing runs for something to be missing."""

MOST_CANDIDATES = 3
"""Candidates that an ambiguous verdict lists."""


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


@dataclass(frozen=True)
class Decision:
    """What follows from the contenders.

    Attributes:
        verdict: ``named``, ``ambiguous``, ``unknown`` or ``nothing_missing``.
        candidates: numbers of the contenders that the verdict is about, best first.
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
) -> Decision:
    """Weigh contenders against each other and against nothing.

    Args:
        contenders: after their refits.
        control: losses of the no-op control per block: the base refitted with the same effort, ``[block]``.
        rng: of the resampling.
        ceiling: share of the residual torque that a black box explains on the choosing runs; None if not known.
    """
    if not contenders:
        return Decision("nothing_missing", (), np.zeros(0), "no effect of the catalogue can be seen in these logs")
    order = sorted(range(len(contenders)), key=lambda i: float(contenders[i].losses.sum()))
    shares = pick_shares(np.stack([c.losses for c in contenders]), rng)
    sound = [i for i in order if _counts(contenders[i], control, rng)]
    if not sound:
        if ceiling is not None and ceiling > CEILING:
            return Decision(
                "unknown",
                tuple(order[:1]),
                shares,
                f"a black box explains {ceiling:.0%} of the residual torque, no effect of the catalogue as much as"
                f" {SMALLEST_GAIN:.0%} of the residual",
            )
        best = contenders[order[0]]
        return Decision(
            "nothing_missing", (), shares, f"the best of the catalogue, {best.label}, explains {max(best.gain, 0):.1%}"
        )
    best = sound[0]
    if ceiling is not None and ceiling > CEILING and _explained(contenders[best]) < EXPLAINED * ceiling:
        return Decision(
            "unknown",
            (best,),
            shares,
            f"a black box explains {ceiling:.0%} of the residual torque, the best of the catalogue,"
            f" {contenders[best].label}, {_explained(contenders[best]):.0%} of the residual",
        )
    rivals = _rivals(contenders, best, sound[1:], control, shares, rng)
    if not rivals:
        return Decision("named", (best,), shares, f"it explains {contenders[best].gain:.0%} of the residual")
    members = (best, *rivals)[:MOST_CANDIDATES]
    return Decision("ambiguous", members, shares, "these explain the residual about equally well")


def _counts(contender: Contender, control: np.ndarray, rng: np.random.Generator) -> bool:
    """Whether a contender is large enough, explains enough, and does so in more than a few blocks."""
    low, _ = difference_interval(contender.losses, control, rng)
    large = abs(contender.size) >= SMALLEST_SIZE * contender.smallest
    return (
        large
        and low > 0
        and min(contender.gain, contender.fit_gain) > 0.25 * SMALLEST_GAIN
        and (0.5 * (contender.gain + contender.fit_gain) >= SMALLEST_GAIN)
    )


def _explained(contender: Contender) -> float:
    return 0.5 * (contender.gain + contender.fit_gain)


def _rivals(contenders, best, others, control, shares, rng) -> list[int]:
    """Contenders that the data do not tell from the best."""
    rivals = []
    winner = contenders[best]
    gained = float((control - winner.losses).sum())
    for i in others:
        other = contenders[i]
        if other.effect == winner.effect and other.joints != winner.joints and shares[best] > 0.5:
            continue  # the same effect in another place is a matter of joints, not of names
        low, _ = difference_interval(winner.losses, other.losses, rng)
        close = float((control - other.losses).sum()) > RIVAL * gained
        # look-alikes differ by little more than what any model gets wrong: more certainty is asked for
        alike = bool(winner.alias_class) and other.alias_class == winner.alias_class and other.effect != winner.effect
        alike &= bool(shares[best] < ALIKE_SHARE)
        if close and (alike or (low <= 0 and shares[best] < NAMED_SHARE)):
            rivals.append(i)
    return rivals
