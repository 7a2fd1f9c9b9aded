"""What refits have found: sizes, intervals, and the models with them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from op3.diagnose.coordinates import CHAIN_FAULTS, FAULTS
from op3.diagnose.evidence import Contender
from op3.diagnose.fitting import Engine, Fit, intervals, with_point
from op3.diagnose.hypotheses import Hypothesis
from op3.diagnose.packets import LossHypothesis, LostPackets
from op3.diagnose.screen import Screened
from op3.diagnose.setups import SetupHypothesis
from op3.diagnose.verdict import Finding
from op3.servo import Estimate, RobotModel
from op3.servo.conditions import split_name
from op3.servo.effect import parameter

FORM_ERROR = 0.2
"""Standard deviation of a size, relative, from laws that are not quite the robot's: what separates sizes from
the truth on development legs. Leaving out seconds does not show it."""

COUNT_ERROR = 0.2
"""The same of a share of packets that was counted. In ten development legs it was 0.9 to 1.35 times the one that was
hidden, 1.16 times in the mean, and chance alone explains half of that."""

QUANTILE = 1.645
"""Of a 90 % interval."""


@dataclass(frozen=True, eq=False)
class Refitted:
    """A hypothesis after its refit.

    Attributes:
        hypothesis: which.
        screened: its best secant.
        fit: base and hypothesis.
        contender: its numbers for the decision.
    """

    hypothesis: Hypothesis
    screened: Screened
    fit: Fit
    contender: Contender


def finding_of(engine: Engine, given: RobotModel, refitted: Refitted, base: Fit, confidence: float) -> Finding:
    """What a refit has found, with its interval.

    Args:
        engine: gives joints and blocks.
        given: the model that was to be diagnosed; what it has is told as what was added.
        refitted: hypothesis and fit.
        base: beside which it was fitted.
        confidence: of the name.
    """
    hypothesis, fit = refitted.hypothesis, refitted.fit
    if isinstance(hypothesis, LossHypothesis) and hypothesis.found is not None:
        return _loss_finding(engine.joints, hypothesis, hypothesis.found, refitted, confidence)
    known = len(base.coordinates)
    half = intervals(engine, base, fit)
    if isinstance(hypothesis, SetupHypothesis):
        return _setup_finding(engine.joints, hypothesis, refitted, fit.point[known:], half, confidence)
    place = size_at(hypothesis, fit, base)
    entry = fit.coordinates.entries[place]
    values = {e.parameter: float(fit.point[known + i]) for i, e in enumerate(fit.coordinates.entries[known:])}
    # an effect that was off is told from its neutral value on; more of one that was on, as what was added
    absolute = hypothesis.effect.name not in given.effect_names
    start = hypothesis.model.value(entry.parameter) if absolute else 0.0
    if absolute:
        values = {
            e.parameter: v + (hypothesis.model.value(e.parameter) if e.kind == "add" else 0.0)
            for (_, v), e in zip(values.items(), fit.coordinates.entries[known:], strict=True)
        }
    size = apart(hypothesis, fit, start + float(fit.point[place]))
    width = float(np.hypot(half[place - known], FORM_ERROR * QUANTILE * (size - start)))
    limit = parameter(entry.parameter)
    low, high = (
        (max(limit.least, size - width), min(limit.most, size + width))
        if absolute
        else (
            size - width,
            size + width,
        )
    )
    joints = engine.joints
    return Finding(
        name=hypothesis.effect.name,
        joints=tuple(joints) if hypothesis.joints is None else tuple(joints[j] for j in hypothesis.joints),
        shared=hypothesis.joints is None,
        size=size,
        unit=limit.unit,
        interval=(low, high),
        confidence=confidence,
        parameters=values,
        gain=refitted.contender.gain,
        parameter=entry.parameter,
    )


def _loss_finding(
    joints: Sequence[str], hypothesis: LossHypothesis, found: LostPackets, refitted: Refitted, confidence: float
) -> Finding:
    """Lost packets, as they were counted, with what such counts are wrong by beyond chance."""
    name, form = hypothesis.effect.size, COUNT_ERROR * QUANTILE * found.share
    low, high = (abs(end - found.share) for end in found.interval())
    return Finding(
        name=hypothesis.effect.name,
        joints=tuple(joints),
        shared=True,
        size=found.share,
        unit=parameter(name).unit,
        interval=(
            max(0.0, found.share - float(np.hypot(low, form))),
            min(1.0, found.share + float(np.hypot(high, form))),
        ),
        confidence=confidence,
        parameters={name: found.share},
        gain=refitted.contender.gain,
        parameter=name,
    )


def _setup_finding(
    joints: Sequence[str],
    hypothesis: SetupHypothesis,
    refitted: Refitted,
    values: np.ndarray,
    half: np.ndarray,
    confidence: float,
) -> Finding:
    """What differs between set-ups, from a refit and half widths of its coordinates."""
    size, ends = float(np.ptp(values)), [int(values.argmin()), int(values.argmax())]
    width = float(np.hypot(np.linalg.norm(half[ends]), FORM_ERROR * QUANTILE * size))
    return setup_finding(joints, hypothesis, values, width, confidence, refitted.contender.gain)


def setup_finding(
    joints: Sequence[str],
    hypothesis: SetupHypothesis,
    values: np.ndarray,
    width: float,
    confidence: float,
    gain: float,
) -> Finding:
    """What differs between set-ups; its size is how far the largest and the smallest value are apart.

    Args:
        joints: names.
        hypothesis: which set-ups.
        values: one for each.
        width: half of the interval of the size.
        confidence: of the name.
        gain: share of the residual that it explains.
    """
    known, size = parameter(split_name(hypothesis.names[0])[0]), float(np.ptp(values))
    return Finding(
        name=hypothesis.effect.name,
        joints=tuple(joints),
        shared=True,
        size=size,
        unit=known.unit,
        interval=(max(0.0, size - width), size + width),
        confidence=confidence,
        parameters=dict(zip(hypothesis.names, values.tolist(), strict=True)),
        gain=gain,
        parameter=known.name,
        by=hypothesis.field,
    )


def size_at(hypothesis: Hypothesis, fit: Fit, base: Fit) -> int:
    """Which coordinate says how large the effect is: its size parameter, or the largest of those moved."""
    entries = fit.coordinates.entries[len(base.coordinates) :]
    names = [entry.parameter for entry in entries]
    if hypothesis.effect.size in names:
        return len(base.coordinates) + names.index(hypothesis.effect.size)
    return len(base.coordinates)


def smallest(hypothesis: Hypothesis, name: str) -> float:
    """The smallest size that matters; a tenth of the range for a parameter that is not the effect's size."""
    effect, name = hypothesis.effect, split_name(name)[0]
    if name == effect.size:
        return effect.smallest
    known = parameter(name)
    return 0.1 * (known.high - known.low)


def apart(hypothesis: Hypothesis, fit: Fit, size: float) -> float:
    """The size; of a fault of one joint, how far the joint is from the others: the spread has a share in it."""
    effect, joints = hypothesis.effect.name, hypothesis.joints
    if isinstance(hypothesis, SetupHypothesis):
        return float(np.ptp(fit.point[-len(hypothesis.names) :]))
    if effect in CHAIN_FAULTS.values() and joints is not None and len(joints) == 1 and effect in fit.parameters:
        return float(fit.parameters[effect][0, joints[0]])  # the chain of measurement has a share in it
    if effect not in FAULTS.values() or joints is None or len(joints) != 1:
        return size
    (own,) = joints
    values = {name: value[0].numpy() for name, value in fit.parameters.items()}
    parameter = next(name for name, fault in FAULTS.items() if fault == effect)
    if parameter not in values or len(values[parameter]) < 3:
        return size
    whole = values[parameter]
    if effect == "torque_constant":
        whole = whole * (1.0 + values["torque_constant_error"])
    others = float(np.median(np.delete(whole, own)))
    return float(whole[own] / others - 1.0) if effect == "torque_constant" else float(whole[own] - others)


def with_finding(refitted: Refitted, finding: Finding, joints: Sequence[str]) -> RobotModel:
    """The model of a refit, the named parameter with its interval."""
    model = with_point(refitted.fit.coordinates, refitted.fit.point)
    if finding.by:
        return model
    estimate = model.estimates[finding.parameter]
    if finding.shared and not estimate.joints:
        low, high = finding.interval
        estimate = Estimate(estimate.value, min(low, estimate.value), max(high, estimate.value))
    return model.with_values({finding.parameter: estimate})
