"""Parameters of the baseline fit with priors: shared parameters, differences between servos, measurement chain."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np
import torch
from scipy.stats import norm, t
from torch import Tensor

from op3.diagnose.judge_settings import Settings
from op3.servo import Effect, Parameter, RobotModel, Usual, catalogue
from op3.servo.conditions import Condition, split_name
from op3.servo.effects import LinkInertia

SPREAD_LIMIT = 3.0
"""Standard deviations by which a servo of a sound robot may differ from the others; a candidate must explain a larger
difference. With few servos the corresponding quantile of Student's distribution applies."""

WIDEST = 10.0
"""Largest ratio between a fitted parameter and its given value if that is outside the catalogue's range. Numerical:
hobby servos differ by more (XL330-M288 and MX-106: 0.52 and 8.4 N m at stall, ROBOTIS e-Manual), but the given model
should describe a similar servo. The search starts at the lower end."""

_USUAL = {name: usual for effect in catalogue().values() for name, usual in effect.usual.items()}

CHAIN: Mapping[str, Usual] = {name: usual for name, usual in _USUAL.items() if not usual.bench}
"""Parameters of the measurement chain, which every baseline fit includes."""

BENCH: Mapping[str, Usual] = {name: usual for name, usual in _USUAL.items() if usual.bench}
"""Parameters that every baseline fit of a bench includes."""

SPREAD: Mapping[str, float] = {name: share for e in catalogue().values() for name, share in e.spread.items()}
"""Standard deviation of parameters between servos of one make, relative to the shared value."""

CHAIN_SPREAD: Mapping[str, float] = {name: usual.spread for name, usual in CHAIN.items() if usual.own}
"""Standard deviation of the measurement chain's parameters with one value per servo, such as current zeros."""


@dataclass(frozen=True)
class Coordinate:
    """One fitted parameter.

    Attributes:
        parameter: name in the model.
        joints: columns of the joints that the parameter changes; None: all joints have the same value.
        low: lower bound.
        high: upper bound.
        start: initial value.
        prior: prior mean.
        deviation: prior standard deviation.
        kind: ``value``: the parameter itself. ``add``: an increment of the parameter in its joints. ``scale``: a
            relative change of the parameter in its joints.
        tails: degrees of freedom of a Student prior; infinite for a normal prior.
    """

    parameter: str
    joints: tuple[int, ...] | None
    low: float
    high: float
    start: float
    prior: float
    deviation: float = inf
    kind: str = "value"
    tails: float = inf

    @property
    def zero(self) -> float:
        """The value at which the parameter itself is zero."""
        return -1.0 if self.kind == "scale" else 0.0

    @property
    def shared(self) -> bool:
        """Whether it applies to several joints."""
        return self.joints is None or len(self.joints) > 1

    @property
    def per_servo(self) -> bool:
        """Whether it is the deviation of one servo from the others."""
        scaled = self.kind == "scale" or (self.kind == "value" and self.parameter in CHAIN_SPREAD)
        return self.joints is not None and scaled


@dataclass(frozen=True)
class Coordinates:
    """The fitted parameters and their mapping to the parameters of a model.

    Attributes:
        model: the model with the values of all parameters that are not fitted.
        joints: joint names.
        entries: the fitted parameters.
    """

    model: RobotModel
    joints: tuple[str, ...]
    entries: tuple[Coordinate, ...]

    def _array(self, field: str) -> np.ndarray:
        return np.array([getattr(entry, field) for entry in self.entries])

    start = property(lambda self: self._array("start"), doc="Initial values, ``[coordinate]``.")
    low = property(lambda self: self._array("low"), doc="Lower bounds, ``[coordinate]``.")
    high = property(lambda self: self._array("high"), doc="Upper bounds, ``[coordinate]``.")
    prior = property(lambda self: self._array("prior"), doc="Prior means, ``[coordinate]``.")
    deviation = property(lambda self: self._array("deviation"), doc="Prior standard deviations, ``[coordinate]``.")

    def penalties(self, points: np.ndarray) -> np.ndarray:
        """-2 log prior of points ``[point, coordinate]``, without constants."""
        penalty, tails = np.square((points - self.prior) / self.deviation), self._array("tails")
        student = np.isfinite(tails)
        penalty[..., student] = (tails[student] + 1) * np.log1p(penalty[..., student] / tails[student])
        return penalty.sum(-1)

    def deviation_at(self, point: np.ndarray) -> np.ndarray:
        """Standard deviations of the normal priors with the same gradient at a point, ``[coordinate]``."""
        square, tails = np.square((point - self.prior) / self.deviation), self._array("tails")
        student, deviation = np.isfinite(tails), self.deviation
        deviation[student] *= np.sqrt((tails[student] + square[student]) / (tails[student] + 1))
        return deviation

    def values(self, points: np.ndarray) -> dict[str, Tensor]:
        """Model parameters by name, ``[point, joint]``, clipped to their physical limits.

        Args:
            points: ``[point, coordinate]``.
        """
        parameters, tensors = self.model.parameters(), self.model.tensors(self.joints)
        result: dict[str, Tensor] = {}
        amounts = torch.from_numpy(np.ascontiguousarray(points, dtype=np.float64))
        for kind in ("value", "add", "scale"):
            for i, entry in enumerate(self.entries):
                if entry.kind != kind:
                    continue
                name = entry.parameter
                if name not in result:
                    tensor = tensors[split_name(name)[0]]
                    result[name] = tensor.expand(len(points), tensor.shape[1]).clone()
                columns = slice(None) if entry.joints is None else list(entry.joints)
                amount = amounts[:, i : i + 1]
                if kind == "value":
                    result[name][:, columns] = amount
                elif kind == "add":
                    result[name][:, columns] += amount
                else:
                    result[name][:, columns] *= 1.0 + amount
        limits = {name: parameters[split_name(name)[0]] for name in result}
        return {name: value.clamp(limits[name].least, limits[name].most) for name, value in result.items()}

    def extended(self, model: RobotModel, entries: Sequence[Coordinate]) -> "Coordinates":
        """These coordinates followed by others, for a model with more effects."""
        return Coordinates(model, self.joints, (*self.entries, *entries))


def with_chain(model: RobotModel) -> RobotModel:
    """The model with all effects of the measurement chain on, at their usual values.

    A servo with an internal position loop has no current lag, and its latency delays the goal instead of the current.
    """
    regulated = "current_pd" in model.effect_names
    for effect in catalogue().values():
        usual = {p.name: CHAIN[p.name].value for p in effect.parameters if p.name in CHAIN}
        if not usual or effect.name in model.effect_names:
            continue
        if {"current_time_constant", "current_offset"} & set(usual) and not regulated:
            continue
        options = {"signal": "goal"} if effect.name == "latency" and not regulated else {}
        model = model.with_effect(effect(**options), usual)
    return model


def with_setups(model: RobotModel, lengths: Sequence[float]) -> RobotModel:
    """The model with the inertia of a bench's weight and one encoder offset per arm, because arms are remounted."""
    if lengths and "link_inertia" not in model.effect_names:
        model = model.with_effect(LinkInertia(), {name: usual.value for name, usual in BENCH.items()})
    if "encoder_offset" not in model.effect_names or len(set(lengths)) < 2:
        return model
    names = [f"encoder_offset@{Condition('length', length)}" for length in sorted(set(lengths))]
    return model.with_values(dict.fromkeys(names, model.value("encoder_offset")))


def other_forms(model: RobotModel, selected: Callable[[type[Effect]], bool] = lambda effect: True) -> list[RobotModel]:
    """The model with every other combination of the forms of its laws, or only of the selected effects' laws."""
    result = [model]
    for effect in (effect for effect in model.effects if selected(type(effect))):
        values = {p.name: model.estimate(p.name) for p in effect.parameters}
        for option, forms in effect.written.items():
            others = [replace(effect, **{option: form}) for form in forms if form != getattr(effect, option)]  # type: ignore[type-var]
            result += [variant.with_effect(other, values) for variant in result for other in others]
    return result[1:]


def base_coordinates(
    model: RobotModel, joints: Sequence[str], moving: Sequence[bool] | None = None, priors: Mapping[str, Usual] = CHAIN
) -> Coordinates:
    """The coordinates of a baseline fit: the model's parameters, the differences between servos, the measurement chain.

    Three kinds of parameters are not fitted: the forward efficiency of a current-driven servo, which is not
    distinguishable from the torque constant; masses of a held base; and the firmware gain, which is known.

    Args:
        model: the model with its measurement chain.
        joints: joint names.
        moving: which joints move; the others have no separate coordinates.
        priors: prior by parameter name, where one exists.
    """
    moving = [True] * len(joints) if moving is None else moving
    drive = next((getattr(e, "drive", "current") for e in model.effects if e.name == "motor"), "current")
    entries: list[Coordinate] = []
    for effect in model.effects:
        held = bool(effect.edits) and all(edit.target == "base_body" for edit in effect.edits)
        for p in effect.parameters:
            if held or p.name == "controller_gain" or (p.name == "forward_efficiency" and drive == "current"):
                continue
            if p.name in priors:
                entries.extend(_with_prior(p, priors[p.name], joints, moving))
                continue
            values = model.tensors(joints)[p.name][0].numpy()
            if np.ptp(values) > 1e-12:
                entries.extend(_common_factor(p, values))
                continue
            start = float(values[0])
            low, high = _bounds(p, start)
            span, by_condition = high - low, model.estimate(p.name).by
            for condition, estimate in by_condition.items():
                value, name = estimate.value, f"{p.name}@{condition}"
                entries.append(Coordinate(name, None, value - span, value + span, value, value, span))
            if not by_condition:
                entries.append(Coordinate(p.name, None, low, high, start, start, span))
    for name, deviation in SPREAD.items() if len(joints) > 1 else ():
        if any(entry.parameter == name for entry in entries):
            reach = SPREAD_LIMIT * deviation
            columns = [(j,) for j in range(len(joints)) if moving[j]]
            entries += [Coordinate(name, column, -reach, reach, 0.0, 0.0, deviation, "scale") for column in columns]
    return Coordinates(model, tuple(joints), tuple(entries))


def robust_spread(values: np.ndarray, deviations: np.ndarray, usual: float, settings: Settings) -> float:
    """Standard deviation between the servos of this robot; a make's larger spread would hide a fault.

    A median, which one faulty servo does not change, combined with a log-normal prior about the usual spread.

    Args:
        values: values of the servos, ``[servo]``.
        deviations: posterior standard deviations of the values, which count as possible differences, ``[servo]``.
        usual: usual spread between servos of one make.
    """
    spread = np.sqrt(np.median(np.square((values - np.median(values)) / norm.ppf(0.75)) + np.square(deviations)))
    weight = 1 / settings.unmodelled_spread**2
    return float(np.exp((len(values) * np.log(spread) + weight * np.log(usual)) / (len(values) + weight)))


def with_robot_spread(
    coordinates: Coordinates, point: np.ndarray, deviations: np.ndarray, settings: Settings
) -> tuple[Coordinates, np.ndarray]:
    """The coordinates with priors from this robot's spread between servos, and the point that gives the same model.

    The shared parameter absorbs the median of the servos' deviations.

    Args:
        point: fitted values, ``[coordinate]``.
        deviations: posterior standard deviations, ``[coordinate]``.
    """
    entries, point = list(coordinates.entries), point.copy()
    for name, usual in {**SPREAD, **CHAIN_SPREAD}.items():
        indices = [i for i, entry in enumerate(entries) if entry.parameter == name]
        servos = [i for i in indices if entries[i].per_servo]
        if not servos:
            continue
        median = 0.0 if name in CHAIN_SPREAD else float(np.median(point[servos]))
        deviation = robust_spread(point[servos], deviations[servos], usual, settings)
        for i in servos:
            entries[i] = replace(entries[i], deviation=deviation)
        point[servos] = (1 + point[servos]) / (1 + median) - 1
        for i in (i for i in indices if entries[i].joints is None):
            zero = entries[i].zero
            point[i] = (point[i] - zero) * (1 + median) + zero
    return replace(coordinates, entries=tuple(entries)), point


def with_student_spread(coordinates: Coordinates, tails: float) -> Coordinates:
    """Student priors and wide bounds for the deviations of servos, so that a faulty servo does not move shared values.

    Args:
        tails: degrees of freedom.
    """

    def student(entry: Coordinate) -> Coordinate:
        low, high = (1 / WIDEST - 1, WIDEST - 1) if entry.kind == "scale" else (entry.low, entry.high)
        return replace(entry, low=low, high=high, tails=tails) if entry.per_servo else entry

    return replace(coordinates, entries=tuple(map(student, coordinates.entries)))


def with_sound_spread(coordinates: Coordinates, settings: Settings) -> Coordinates:
    """Priors and bounds of a sound robot for the deviations of servos: a larger deviation is a fault.

    The spread is estimated from few servos, so deviations of sound servos follow Student's distribution. Its degrees of
    freedom are the number of servos plus the weight of the spread's prior.
    """
    servos = Counter(entry.parameter for entry in coordinates.entries if entry.per_servo)

    def sound(entry: Coordinate) -> Coordinate:
        if not entry.per_servo:
            return entry
        freedom = servos[entry.parameter] + 1 / settings.unmodelled_spread**2
        reach = float(t.ppf(norm.cdf(SPREAD_LIMIT), freedom)) * entry.deviation
        return replace(entry, low=-reach, high=reach, tails=freedom)

    return replace(coordinates, entries=tuple(map(sound, coordinates.entries)))


def _bounds(p: Parameter, value: float) -> tuple[float, float]:
    """Bounds of a parameter: the catalogue's range widened by a quarter, or a range around a value outside it.

    A range of positive values without a neutral one is widened by a factor: near zero, a Stribeck velocity has no
    influence, and no step would lead back.
    """
    if p.low <= value <= p.high:
        if p.neutral is None and p.low > 0.0:
            return max(p.low / 1.25, p.least), min(1.25 * p.high, p.most)
        margin = 0.25 * (p.high - p.low)
        low = p.low - margin if p.neutral is None else min(p.low - margin, p.neutral)
        return max(low, p.least), min(p.high + margin, p.most)
    if value == 0.0:
        return min(p.low, 0.0), max(p.high, 0.0)
    low, high = sorted((0.0 if p.neutral == 0.0 else value / WIDEST, value * WIDEST))
    return max(p.least, low), min(p.most, high)


def _common_factor(p: Parameter, values: np.ndarray) -> list[Coordinate]:
    """A common factor on values that differ between joints, so that joints without the effect remain without it.

    Two kinds of parameters are not fitted: angles, and efficiencies, because a factor would change the joints without
    losses too.
    """
    if p.neutral not in (None, 0.0) or (p.neutral is None and p.least < 0.0):
        return []
    largest = float(values[np.abs(values).argmax()])
    low, high = sorted(bound / largest - 1.0 for bound in _bounds(p, largest))
    return [Coordinate(p.name, None, max(low, -1.0), high, 0.0, 0.0, 1.0, "scale")]


def _with_prior(p: Parameter, usual: Usual, joints: Sequence[str], moving: Sequence[bool]) -> list[Coordinate]:
    low, high = max(p.least, usual.least, -usual.most), min(p.most, usual.most)
    columns = [(j,) for j in range(len(joints)) if moving[j]] if usual.own and len(joints) > 1 else [None]
    return [Coordinate(p.name, column, low, high, usual.value, usual.value, usual.wide) for column in columns]
