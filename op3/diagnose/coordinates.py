"""The numbers of the base: shared parameters, the spread of its servos, and the chain of measurement, with priors."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np
import torch
from scipy.stats import norm
from torch import Tensor

from op3.diagnose.judge_settings import Settings
from op3.servo import Effect, Parameter, RobotModel, Usual, catalogue
from op3.servo.conditions import Condition, split_name
from op3.servo.effects import LinkInertia

SPREAD_LIMIT = 3.0
"""Standard deviations that a joint may differ in the base; what differs more is a fault, and a candidate."""

WIDEST = 10.0
"""How many times smaller or larger than given a parameter may be that lies outside the catalogue's range. Our own
choice: all hobby servos differ by more (XL330-M288 and MX-106: 0.52 and 8.4 N m at stall, ROBOTIS e-Manual), but what
is given is that of one alike. A search begins so far below what is given."""


_USUAL = {name: usual for effect in catalogue().values() for name, usual in effect.usual.items()}

CHAIN: Mapping[str, Usual] = {name: usual for name, usual in _USUAL.items() if not usual.bench}
"""What is part of every baseline, whatever the given model holds."""

BENCH: Mapping[str, Usual] = {name: usual for name, usual in _USUAL.items() if usual.bench}
"""What is part of every baseline of a bench."""

SPREAD: Mapping[str, float] = {name: share for e in catalogue().values() for name, share in e.spread.items()}
"""By how much servos of one make differ, as a standard deviation relative to the shared value."""

OWN: Mapping[str, float] = {name: usual.spread for name, usual in CHAIN.items() if usual.own}
"""By how much they differ in numbers of the chain that each has for itself."""


@dataclass(frozen=True)
class Coordinate:
    """One number of a fit.

    Attributes:
        parameter: of the model.
        joints: columns that it moves; None for all alike.
        low: smallest value.
        high: largest value.
        start: where the fit starts.
        prior: what it is expected to be.
        deviation: standard deviation of that expectation.
        kind: ``value``: it is the parameter. ``add``: it is added to the parameter of its joints. ``scale``: the
            parameter of its joints is multiplied by one plus this.
        tails: degrees of freedom of the expectation, Student's where they are finite and else normal.
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
    def shared(self) -> bool:
        """Whether it is a number of several joints."""
        return self.joints is None or len(self.joints) > 1

    @property
    def of_servo(self) -> bool:
        """Whether it says by how much one servo differs from the others."""
        return self.joints is not None and (self.kind == "scale" or (self.kind == "value" and self.parameter in OWN))


@dataclass(frozen=True)
class Coordinates:
    """An ordered set of numbers and how they become parameters of a model.

    Attributes:
        model: gives everything that is not moved.
        joints: joint names.
        entries: the numbers.
    """

    model: RobotModel
    joints: tuple[str, ...]
    entries: tuple[Coordinate, ...]

    def _all(self, field: str) -> np.ndarray:
        return np.array([getattr(entry, field) for entry in self.entries])

    start = property(lambda self: self._all("start"), doc="Where a fit starts, ``[coordinate]``.")
    low = property(lambda self: self._all("low"), doc="Smallest values, ``[coordinate]``.")
    high = property(lambda self: self._all("high"), doc="Largest values, ``[coordinate]``.")
    prior = property(lambda self: self._all("prior"), doc="Expected values, ``[coordinate]``.")
    deviation = property(lambda self: self._all("deviation"), doc="Standard deviations of these, ``[coordinate]``.")

    def penalties(self, points: np.ndarray) -> np.ndarray:
        """Minus two log prior (but for constants) of points ``[candidate, coordinate]``."""
        square, tails = np.square((points - self.prior) / self.deviation), self._all("tails")
        heavy, result = np.isfinite(tails), square
        result[..., heavy] = (tails[heavy] + 1) * np.log1p(square[..., heavy] / tails[heavy])
        return result.sum(-1)

    def deviation_at(self, point: np.ndarray) -> np.ndarray:
        """Standard deviations of the normal priors that pull at a point as much as the priors do, ``[coordinate]``."""
        square, tails = np.square((point - self.prior) / self.deviation), self._all("tails")
        heavy, result = np.isfinite(tails), self.deviation
        result[heavy] *= np.sqrt((tails[heavy] + square[heavy]) / (tails[heavy] + 1))
        return result

    def values(self, points: np.ndarray) -> dict[str, Tensor]:
        """Parameters by name, ``[candidate, joint]``, within what physics allows.

        Args:
            points: ``[candidate, coordinate]``.
        """
        known, base = self.model.parameters(), self.model.tensors(self.joints)
        result: dict[str, Tensor] = {}
        moved = torch.from_numpy(np.ascontiguousarray(points, dtype=np.float64))
        for kind in ("value", "add", "scale"):
            for i, entry in enumerate(self.entries):
                if entry.kind != kind:
                    continue
                name = entry.parameter
                if name not in result:
                    whole = base[split_name(name)[0]]
                    result[name] = whole.expand(len(points), whole.shape[1]).clone()
                columns = slice(None) if entry.joints is None else list(entry.joints)
                column = moved[:, i : i + 1]
                if kind == "value":
                    result[name][:, columns] = column
                elif kind == "add":
                    result[name][:, columns] += column
                else:
                    result[name][:, columns] *= 1.0 + column
        limits = {name: known[split_name(name)[0]] for name in result}
        return {name: value.clamp(limits[name].least, limits[name].most) for name, value in result.items()}

    def extended(self, model: RobotModel, more: Sequence[Coordinate]) -> "Coordinates":
        """These numbers and more, for a model with more effects."""
        return Coordinates(model, self.joints, (*self.entries, *more))


def with_chain(model: RobotModel) -> RobotModel:
    """The model with the effects of the chain of measurement on, at what is usual.

    A servo with a position loop of its own has no current loop to lag, and its goal is what arrives late.
    """
    regulated = "current_pd" in model.effect_names
    for effect in catalogue().values():
        usual = {known.name: CHAIN[known.name].value for known in effect.parameters if known.name in CHAIN}
        if not usual or effect.name in model.effect_names:
            continue
        if {"current_time_constant", "current_offset"} & set(usual) and not regulated:
            continue
        options = {"signal": "goal"} if effect.name == "latency" and not regulated else {}
        model = model.with_effect(effect(**options), usual)
    return model


def with_setups(model: RobotModel, lengths: Sequence[float]) -> RobotModel:
    """The model with the extent of a bench's weight, and a zero of the encoder for each arm: each is mounted anew."""
    if lengths and "link_inertia" not in model.effect_names:
        model = model.with_effect(LinkInertia(), {name: chain.value for name, chain in BENCH.items()})
    if "encoder_offset" not in model.effect_names or len(set(lengths)) < 2:
        return model
    zero = model.value("encoder_offset")
    names = [f"encoder_offset@{Condition('length', length)}" for length in sorted(set(lengths))]
    return model.with_values(dict.fromkeys(names, zero))


def other_forms(model: RobotModel, chosen: Callable[[type[Effect]], bool] = lambda effect: True) -> list[RobotModel]:
    """The model with its effects, or chosen ones, in every other combination of ways to write their laws."""
    result = [model]
    for effect in (one for one in model.effects if chosen(type(one))):
        values = {p.name: model.estimate(p.name) for p in effect.parameters}
        for option, forms in effect.written.items():
            others = [replace(effect, **{option: form}) for form in forms if form != getattr(effect, option)]  # type: ignore[type-var]
            result += [variant.with_effect(other, values) for variant in result for other in others]
    return result[1:]


def base_coordinates(
    model: RobotModel,
    joints: Sequence[str],
    moving: Sequence[bool] | None = None,
    priors: Mapping[str, Usual] = CHAIN,
) -> Coordinates:
    """What is fitted before and beside every finding: the model's own parameters, the servos' spread, and the chain.

    A forward efficiency of a current-driven servo is left out: it cannot be told from the torque constant. So are
    masses of a base that is held, and the firmware's gain, which is known.

    Args:
        model: whose parameters, with its chain.
        joints: joint names.
        moving: which of them move; the others have no numbers of their own.
        priors: numbers of which it is known what they are expected to be.
    """
    moving = [True] * len(joints) if moving is None else moving
    drive = next((getattr(e, "drive", "current") for e in model.effects if e.name == "motor"), "current")
    entries: list[Coordinate] = []
    for effect in model.effects:
        held = bool(effect.edits) and all(edit.target == "base_body" for edit in effect.edits)
        for known in effect.parameters:
            if held or known.name == "controller_gain" or (known.name == "forward_efficiency" and drive == "current"):
                continue
            if known.name in priors:
                entries.extend(_chain(known, priors[known.name], joints, moving))
                continue
            own = model.tensors(joints)[known.name][0].numpy()
            if np.ptp(own) > 1e-12:
                entries.extend(_together(known, own))
                continue
            start = float(own[0])
            low, high = _range(known, start)
            span, special = high - low, model.estimate(known.name).by
            for condition, one in special.items():
                at, name = one.value, f"{known.name}@{condition}"
                entries.append(Coordinate(name, None, at - span, at + span, at, at, span))
            if not special:  # else each set-up has its own
                entries.append(Coordinate(known.name, None, low, high, start, start, span))
    for name, deviation in SPREAD.items() if len(joints) > 1 else ():
        if any(entry.parameter == name for entry in entries):
            reach = SPREAD_LIMIT * deviation
            own_places = [(j,) for j in range(len(joints)) if moving[j]]
            entries += [Coordinate(name, at, -reach, reach, 0.0, 0.0, deviation, "scale") for at in own_places]
    return Coordinates(model, tuple(joints), tuple(entries))


def own_spread(values: np.ndarray, deviations: np.ndarray, usual: float, settings: Settings) -> float:
    """How much the servos of this robot differ, as a standard deviation: what any make may have hides a fault.

    The median is what most servos have, whatever one of them does. What the logs do not tell of them may differ too.

    Args:
        values: their numbers, ``[servo]``.
        deviations: standard deviations of these, ``[servo]``.
        usual: what servos of one make usually differ by.
    """
    apart = np.sqrt(np.median(np.square((values - np.median(values)) / norm.ppf(0.75)) + np.square(deviations)))
    weight = 1 / settings.law_spread**2
    return float(np.exp((len(values) * np.log(apart) + weight * np.log(usual)) / (len(values) + weight)))


def with_own_spread(
    coordinates: Coordinates, point: np.ndarray, deviations: np.ndarray, settings: Settings
) -> tuple[Coordinates, np.ndarray]:
    """Expectations of servos that differ as this robot's do.

    What they have in common goes to the shared number if there is one, so that the point ``[coordinate]`` is handed
    back too, as the same base; `deviations` are the standard deviations of its numbers.
    """
    entries, point = list(coordinates.entries), point.copy()
    for name, usual in {**SPREAD, **OWN}.items():
        mine = [i for i, entry in enumerate(entries) if entry.parameter == name]
        own = [i for i in mine if entries[i].of_servo]
        if not own:
            continue
        middle = 0.0 if name in OWN else float(np.median(point[own]))
        deviation = own_spread(point[own], deviations[own], usual, settings)
        for i in own:
            entries[i] = replace(entries[i], deviation=deviation)
        point[own] = (1 + point[own]) / (1 + middle) - 1
        for i in (i for i in mine if entries[i].joints is None):
            one = 0.0 if entries[i].kind == "value" else 1.0  # a factor is told as what it adds to 1
            point[i] = (one + point[i]) * (1 + middle) - one
    return replace(coordinates, entries=tuple(entries)), point


def any_spread(coordinates: Coordinates, tails: float) -> Coordinates:
    """Numbers of which one servo's may be far from what the others' are, so that it does not move what all share.

    Args:
        tails: degrees of freedom of Student's expectation.
    """

    def free(entry: Coordinate) -> Coordinate:
        ends = (1 / WIDEST - 1, WIDEST - 1) if entry.kind == "scale" else (entry.low, entry.high)
        return replace(entry, low=ends[0], high=ends[1], tails=tails) if entry.of_servo else entry

    return replace(coordinates, entries=tuple(map(free, coordinates.entries)))


def usual_spread(coordinates: Coordinates) -> Coordinates:
    """Numbers of servos that differ as those of a sound robot do: what differs more is a fault."""
    entries = [
        replace(entry, low=-SPREAD_LIMIT * entry.deviation, high=SPREAD_LIMIT * entry.deviation, tails=inf)
        if entry.of_servo
        else entry
        for entry in coordinates.entries
    ]
    return replace(coordinates, entries=tuple(entries))


def _range(known: Parameter, value: float) -> tuple[float, float]:
    """Where a parameter may go: a quarter beyond the catalogue's range, or about a value of a servo of another size."""
    if known.low <= value <= known.high:
        beyond = 0.25 * (known.high - known.low)
        low = known.low - beyond if known.neutral is None else min(known.low - beyond, known.neutral)
        return max(low, known.least), min(known.high + beyond, known.most)
    if value == 0.0:
        return min(known.low, 0.0), max(known.high, 0.0)
    low, high = sorted((0.0 if known.neutral == 0.0 else value / WIDEST, value * WIDEST))
    return max(known.least, low), min(known.most, high)


def _together(known: Parameter, own: np.ndarray) -> list[Coordinate]:
    """One factor on values that joints have for themselves: those without the effect stay without it.

    A shape, such as a phase, stays as it is.
    """
    if known.neutral != 0.0 and known.name not in SPREAD:
        return []
    largest = float(own[np.abs(own).argmax()])
    ends = sorted(end / largest - 1.0 for end in _range(known, largest))
    return [Coordinate(known.name, None, max(ends[0], -1.0), ends[1], 0.0, 0.0, 1.0, "scale")]


def _chain(known: Parameter, chain: Usual, joints: Sequence[str], moving: Sequence[bool]) -> list[Coordinate]:
    low, high = max(known.least, chain.least, -chain.most), min(known.most, chain.most)
    places = [(j,) for j in range(len(joints)) if moving[j]] if chain.own and len(joints) > 1 else [None]
    return [Coordinate(known.name, place, low, high, chain.value, chain.value, chain.wide) for place in places]
