"""Doubts about a baseline fit, and unusual parameters of the measurement chain.

A doubt is a parameter at a bound or another optimum with nearly the same evidence. Parameters that are not identifiable
from the logs are listed separately.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from op3.common.plain_names import words
from op3.diagnose.base import FEW_STEPS, Baseline, evidence_gain, gauss_newton, step_priors
from op3.diagnose.coordinates import CHAIN, SPREAD_LIMIT, Coordinate, Coordinates
from op3.diagnose.judge import evidence
from op3.diagnose.reduction import Reduction
from op3.servo import RobotModel
from op3.servo.conditions import split_name

EQUAL_EVIDENCE, DIFFERENT = 20.0, 0.15
"""Display: two optima are equally good below this difference in -2 log evidence, and differ above this difference in a
shared parameter, as a share of its range."""

UNIDENTIFIABLE = 0.8
"""Display: ratio of posterior to prior standard deviation above which a shared parameter is not identifiable."""


def at_bound(base: Baseline) -> list[Coordinate]:
    """Identifiable shared parameters that ended at a bound other than a physical limit."""
    result, parameters = [], base.coordinates.model.parameters()
    ignored = set(unidentifiable(base))
    for entry, value in zip(base.coordinates.entries, base.point, strict=True):
        p, low, high = parameters[split_name(entry.parameter)[0]], value <= entry.low, value >= entry.high
        physical = entry.low == p.least if low else entry.high == p.most
        shared = entry.joints is None and entry.kind == "value" and entry.parameter not in ignored
        if shared and (low or high) and not physical:
            result.append(entry)
    return result


def with_wider_bounds(base: Baseline, entries: Sequence[Coordinate]) -> Coordinates:
    """The baseline's coordinates, some of them with ranges three times as wide within the physical limits."""
    parameters = base.coordinates.model.parameters()

    def wider(entry: Coordinate) -> Coordinate:
        p, span = parameters[split_name(entry.parameter)[0]], entry.high - entry.low
        low, high = max(entry.low - span, p.least), min(entry.high + span, p.most)
        return replace(entry, low=low, high=high, deviation=3 * entry.deviation)

    widened = tuple(wider(entry) if entry in entries else entry for entry in base.coordinates.entries)
    return replace(base.coordinates, entries=widened)


def doubts(base: Baseline) -> tuple[str, ...]:
    """Sentences about shared parameters at a bound, and about other optima with nearly the same evidence."""
    result, parameters = [], base.coordinates.model.parameters()
    for entry in at_bound(base):
        value = base.point[base.coordinates.entries.index(entry)]
        end = "lower" if value - entry.low < entry.high - value else "upper"
        unit = parameters[split_name(entry.parameter)[0]].unit
        result.append(f"{words(entry.parameter)} hit its {end} bound ({value:.3g} {unit})".replace(" -)", ")"))
    for end in base.other_optima:
        if -end.gain < EQUAL_EVIDENCE and (far := different(base.coordinates, end.point, base.point)):
            change = f"-2 log evidence differs by {-end.gain:.1f}"
            result.append(f"another start fits as well ({change}) with other values of {', '.join(map(words, far))}")
    return tuple(result)


def different(coordinates: Coordinates, point: np.ndarray, other: np.ndarray) -> list[str]:
    """Shared parameters in which two points differ by more than `DIFFERENT`."""
    far = np.abs(point - other) > DIFFERENT * (coordinates.high - coordinates.low)
    return [entry.parameter for entry, is_far in zip(coordinates.entries, far, strict=True) if entry.shared and is_far]


def unidentifiable(base: Baseline) -> list[str]:
    """Shared parameters that influence the residual but have a posterior hardly narrower than the prior."""
    ratio = np.sqrt(np.diag(base.fit.covariance)) / base.coordinates.deviation * base.linear.jacobian.any((1, 2, 3))
    pairs = zip(base.coordinates.entries, ratio, strict=True)
    return [entry.parameter for entry, r in pairs if entry.joints is None and r > UNIDENTIFIABLE]


@dataclass(frozen=True)
class ChainDeviation:
    """Deviation of a parameter of the measurement chain from its expected value.

    Attributes:
        index: index of the baseline's coordinate.
        log_odds: log odds against the expected value.
        deviation: standard deviation of the value in the logs.
        expected: the coordinate with the bounds and the prior of the expected value.
    """

    index: int
    log_odds: float
    deviation: float
    expected: Coordinate


def chain_deviations(given: RobotModel, base: Baseline) -> list[ChainDeviation]:
    """Deviations of the chain's shared parameters from the given model's values, or from the usual ones.

    Computed without candidates, because many small candidates together can imitate such a parameter.
    """
    priors, variance = step_priors(base.coordinates, base.point), np.diag(base.fit.covariance)
    prior = 1.0 / priors.deviation**2
    # likelihood of the rows, all other parameters integrated out: exp(linear a - curvature a^2 / 2)
    linear, curvature = base.fit.mean / variance - prior * priors.mean, np.maximum(1.0 / variance - prior, 1e-12)
    parameters, result, point = given.parameters(), [], base.point
    for i, entry in enumerate(base.coordinates.entries):
        if entry.parameter not in CHAIN or entry.joints is not None:
            continue
        name, usual = entry.parameter, CHAIN[entry.parameter]
        value, spread = given.value(name) if name in parameters else usual.value, usual.spread
        if name not in parameters and usual.none is not None:
            value, spread = 0.0, usual.none
        step, low, high = np.array(value - point[i]), entry.low - point[i], entry.high - point[i]
        slab = evidence(linear[i], curvature[i], step, np.array(usual.most / 2), low, high)
        spike = evidence(linear[i], curvature[i], step, np.array(spread))
        reach = SPREAD_LIMIT * spread
        low, high = max(entry.low, value - reach), min(entry.high, value + reach)
        expected = replace(entry, low=low, high=high, prior=value, deviation=spread)
        result.append(ChainDeviation(i, float(slab - spike), float(curvature[i] ** -0.5), expected))
    return result


def free_and_expected(
    reduction: Reduction, base: Baseline, index: int, expected: Coordinate
) -> tuple[Baseline, Baseline]:
    """The baseline refitted with a free coordinate, and refitted with the coordinate near its expected value.

    If joints stick, other coordinates may have absorbed its influence. The constrained fit therefore starts from the
    baseline's point and from the expected value, and the free fit also from the better of these results.
    """
    entries, point = list(base.coordinates.entries), base.point.copy()
    entries[index], point[index] = expected, expected.prior
    coordinates = replace(base.coordinates, entries=tuple(entries))

    def better(fitted: Baseline, bounds: Coordinates, start: np.ndarray) -> Baseline:
        other = gauss_newton(reduction, bounds, start, FEW_STEPS, fitted.fit.variances)
        return other if evidence_gain(reduction, fitted, other) > 0 else fitted

    from_base = gauss_newton(reduction, coordinates, base.point, FEW_STEPS, base.fit.variances)
    near = better(from_base, coordinates, point)
    return better(base, base.coordinates, near.point), near
