"""What to distrust in a base, and what is unusual in it.

Numbers at a bound, basins that the logs like alike and directions that they do not tell are said with the verdict; so
is a number of the chain of measurement that is far from what is usual.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from op3.common.plain_names import words
from op3.diagnose.base import ELSEWHERE, Baseline, base_numbers, gap_of, settle
from op3.diagnose.coordinates import CHAIN, SPREAD_LIMIT, Coordinate, Coordinates
from op3.diagnose.judge import evidence
from op3.diagnose.judge_settings import SETTINGS, Settings
from op3.diagnose.reduction import Reduction
from op3.servo import RobotModel
from op3.servo.conditions import split_name

SAME_OPTIMUM, APART = 20.0, 0.15
"""Bases apart by less in minus two log evidence, and by more of a shared number's range, are two optima."""

UNTOLD = 0.8
"""Share of its prior standard deviation that a shared number keeps if the logs do not tell it."""


def at_bound(base: Baseline) -> list[Coordinate]:
    """Shared numbers that logs exercise and that ended where their range does, but not what physics allows."""
    result, known, unexercised = [], base.coordinates.model.parameters(), set(unidentifiable(base))
    for entry, value in zip(base.coordinates.entries, base.point, strict=True):
        one, low, high = known[split_name(entry.parameter)[0]], value <= entry.low, value >= entry.high
        natural = entry.low == one.least if low else entry.high == one.most
        shared = entry.joints is None and entry.kind == "value" and entry.parameter not in unexercised
        if shared and (low or high) and not natural:
            result.append(entry)
    return result


def opened(base: Baseline, numbers: Sequence[Coordinate]) -> Coordinates:
    """The base's numbers, some of them with three times their range, as far as physics allows."""
    known = base.coordinates.model.parameters()

    def wider(entry: Coordinate) -> Coordinate:
        limits, span = known[split_name(entry.parameter)[0]], entry.high - entry.low
        low, high = max(entry.low - span, limits.least), min(entry.high + span, limits.most)
        return replace(entry, low=low, high=high, deviation=3 * entry.deviation)

    entries = tuple(wider(entry) if entry in numbers else entry for entry in base.coordinates.entries)
    return replace(base.coordinates, entries=entries)


def doubts(base: Baseline) -> tuple[str, ...]:
    """Shared numbers that ended at a bound, and other starts that ended as well elsewhere."""
    result, known = [], base.coordinates.model.parameters()
    for entry in at_bound(base):
        value = base.point[base.coordinates.entries.index(entry)]
        end = "lower" if value - entry.low < entry.high - value else "upper"
        unit = known[split_name(entry.parameter)[0]].unit
        result.append(f"{words(entry.parameter)} hit its {end} bound ({value:.3g} {unit})".replace(" -)", ")"))
    for end in base.others:
        if -end.gain < SAME_OPTIMUM and (far := far_apart(base.coordinates, end.point, base.point)):
            apart = f"-2 log evidence differs by {-end.gain:.1f}"
            result.append(f"another start fits as well ({apart}) with other values of {', '.join(map(words, far))}")
    return tuple(result)


def far_apart(coordinates: Coordinates, one: np.ndarray, other: np.ndarray) -> list[str]:
    """Shared numbers in which two points differ by more than `APART`."""
    far = np.abs(one - other) > APART * (coordinates.high - coordinates.low)
    return [entry.parameter for entry, is_far in zip(coordinates.entries, far, strict=True) if entry.shared and is_far]


def unidentifiable(base: Baseline) -> list[str]:
    """Shared numbers that do something, of which the logs say little more than their priors."""
    kept = np.sqrt(np.diag(base.fit.covariance)) / base.coordinates.deviation * base.linear.base.any((1, 2, 3))
    both = zip(base.coordinates.entries, kept, strict=True)
    return [entry.parameter for entry, share in both if entry.joints is None and share > UNTOLD]


@dataclass(frozen=True)
class Unusual:
    """How far from what is usual a number of the chain of measurement is.

    Attributes:
        number: of the base's coordinate.
        log_odds: against its being usual, or what the given model says.
        deviation: standard deviation of what the logs say of it.
        held: the coordinate within what is usual: a prior alone gives way to the logs.
    """

    number: int
    log_odds: float
    deviation: float
    held: Coordinate


def unusual(given: RobotModel, base: Baseline) -> list[Unusual]:
    """How far each number that all share of the chain is from what is usual, or from what the given model says.

    They are judged by the base alone, as candidates of many joints, each there a little, imitate them together.
    """
    numbers, variance = base_numbers(base.coordinates, base.point), np.diag(base.fit.covariance)
    prior = 1.0 / numbers.deviation**2
    # of the rows alone, all else integrated out: exp(linear a - curvature a^2 / 2)
    linear, curvature = base.fit.mean / variance - prior * numbers.mean, np.maximum(1.0 / variance - prior, 1e-12)
    known, found, point = given.parameters(), [], base.point
    for i, entry in enumerate(base.coordinates.entries):
        if entry.parameter not in CHAIN or entry.joints is not None:
            continue
        name, chain = entry.parameter, CHAIN[entry.parameter]
        expected, spread = given.value(name) if name in known else chain.value, chain.spread
        if name not in known and chain.none is not None:
            expected, spread = 0.0, chain.none
        usual, low, high = np.array(expected - point[i]), entry.low - point[i], entry.high - point[i]
        slab = evidence(linear[i], curvature[i], usual, np.array(chain.most / 2), low, high)
        spike = evidence(linear[i], curvature[i], usual, np.array(spread))
        reach = SPREAD_LIMIT * spread
        ends = max(entry.low, expected - reach), min(entry.high, expected + reach)
        held = replace(entry, low=ends[0], high=ends[1], prior=expected, deviation=spread)
        found.append(Unusual(i, float(slab - spike), float(curvature[i] ** -0.5), held))
    return found


def freed(
    reduction: Reduction, base: Baseline, number: int, held: Coordinate, settings: Settings = SETTINGS
) -> tuple[Baseline, Baseline]:
    """The base with a number free, and the base in which it is what is usual, all else fitted anew.

    Where joints stick a fit may end with a number that some others might have been instead: bases in which it is held
    begin where the base is and with what is usual, and one in which it is free where the better of these ends.
    """
    entries, point = list(base.coordinates.entries), base.point.copy()
    entries[number], point[number] = held, held.prior
    coordinates = replace(base.coordinates, entries=tuple(entries))

    def better(one: Baseline, within: Coordinates, start: np.ndarray) -> Baseline:
        other = settle(reduction, within, start, settings, ELSEWHERE, one.fit.state)
        return other if gap_of(reduction, one, other, settings) > 0 else one

    here = settle(reduction, coordinates, base.point, settings, ELSEWHERE, base.fit.state)
    usual = better(here, coordinates, point)
    return better(base, base.coordinates, usual.point), usual
