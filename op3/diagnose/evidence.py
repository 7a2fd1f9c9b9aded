"""What speaks for an effect: a contender after its refit, and statistics of what it explains."""

from dataclasses import dataclass, field

import numpy as np

from op3.diagnose.thresholds import RESAMPLES, SMALLEST_SIZE, TRIMMED


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
    def large(self) -> bool:
        """Whether it is large enough to matter."""
        return abs(self.size) >= SMALLEST_SIZE * self.smallest

    @property
    def explained(self) -> float:
        """Share of the residual that it explains, mean of choosing and fitted runs."""
        return 0.5 * (self.gain + self.fit_gain)


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


def evidence(contender: Contender, control: np.ndarray) -> tuple[float, float]:
    """Statistic of the gain over blocks, and the share still explained without the best `TRIMMED` blocks."""
    gained = control - contender.losses
    return statistic_of(gained), float(np.sort(gained)[:-TRIMMED].sum() / control.sum())


def statistic_of(gained: np.ndarray) -> float:
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


def cosine(one: Contender, other: Contender) -> float:
    """How alike two secants are beyond the base, without sign; 0 where they are not known."""
    if not one.direction.size or one.direction.shape != other.direction.shape:
        return 0.0
    return float(abs(one.direction @ other.direction))
