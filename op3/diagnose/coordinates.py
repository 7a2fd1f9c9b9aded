"""The numbers that a fit moves: shared parameters, deviations of single joints, and how far they may go."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np
import torch
from torch import Tensor

from op3.servo import Parameter, RobotModel, catalogue
from op3.servo.conditions import split_name

SPREAD: Mapping[str, float] = {
    "torque_constant": 0.02,
    "coulomb_friction": 0.03,
    "viscous_friction": 0.03,
    "static_friction_excess": 0.03,
}
"""How much servos of one make differ, as a standard deviation relative to the shared value."""

FAULTS: Mapping[str, str] = {
    "torque_constant": "torque_constant",
    "coulomb_friction": "coulomb",
    "viscous_friction": "viscous",
    "static_friction_excess": "stribeck",
}
"""Effects of single joints that the spread of a parameter may hide."""

REACH = 4.0
"""How many times smaller or larger than its start a parameter outside the catalogue's range may become."""

HELD = ("controller_gain",)
"""Parameters that a base does not refit: the firmware's gain is known. It is a hypothesis like others."""

SPREAD_LIMIT = 2.0
"""Standard deviations that a joint may differ; what differs more is a fault of this joint, and a hypothesis."""


NEAR = 0.1
"""Relative difference from the median up to which joints are taken to have one value and a spread; as far as the spread
goes in any case."""

OUTLIER = 1.5
"""Standard deviations from the median of all joints beyond which a joint's own fault is looked into."""

OUTLYING_READING = 2.0
"""Standard deviations of a joint's part in the chain of measurement beyond which a fault there is looked into."""

CHAIN_FAULTS: Mapping[str, str] = {"current_offset": "current_offset"}
"""Effects of single joints that the chain of measurement may hide, up to its bounds."""

CHAIN: Mapping[str, tuple[float, float, bool]] = {
    "velocity_time_constant": (0.002, 0.0006, False),
    "current_time_constant": (0.0005, 0.0003, False),
    "current_offset": (0.0, 0.003, True),
    "bristle_compliance": (0.0025, 0.0008, False),
}
"""What every chain of measurement has a little of: expected value, standard deviation, and whether joints differ.

Unmodelled, a velocity filter of 2 ms passes for a wrong terminal resistance in nearly every case.
"""

CHAIN_REACH = 4
"""Standard deviations that a part of the chain may differ from what is expected."""


def chain_limit(name: str) -> float:
    """The most that a base takes for granted of a part of the chain of measurement, in the parameter's unit."""
    value, deviation, _ = CHAIN[name]
    return value + CHAIN_REACH * deviation


def with_chain(model: RobotModel) -> RobotModel:
    """The model with the effects of the measurement chain on, at what is expected of them."""
    for effect in catalogue().values():
        for known in effect.parameters:
            if known.name in CHAIN and effect.name not in model.effect_names:
                model = model.with_effect(effect(), {known.name: CHAIN[known.name][0]})
    return model


FORMS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "dte": ("form", ("passive", "power")),
    "stribeck": ("fade", ("exponential", "gaussian")),
    "load_friction": ("form", ("sum", "motor")),
    "encoder_nonlinearity": ("velocity", ("bent", "apart")),
}
"""Laws that the literature writes in several ways with the same parameters: the option that says which, and its values.
Which of them a servo obeys is not what is asked, so none of them may decide a name."""


def other_forms(model: RobotModel, names: Sequence[str] = tuple(FORMS)) -> list[RobotModel]:
    """The model with its effects in every other combination of forms.

    Args:
        model: in one of its forms.
        names: of effects whose form may change.
    """
    result = [model]
    for name in names:
        option, forms = FORMS[name]
        for effect in (e for e in model.effects if e.name == name):
            rest = [form for form in forms if form != getattr(effect, option)]
            others = [replace(effect, **{option: form}) for form in rest]  # type: ignore[type-var]
            values = {p.name: model.estimate(p.name) for p in effect.parameters}
            result += [variant.with_effect(other, values) for variant in result for other in others]
    return result[1:]


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
    """

    parameter: str
    joints: tuple[int, ...] | None
    low: float
    high: float
    start: float
    prior: float
    deviation: float = inf
    kind: str = "value"

    @property
    def name(self) -> str:
        """Parameter and joints, such as ``coulomb_friction[3]``."""
        where = "" if self.joints is None else f"[{','.join(map(str, self.joints))}]"
        return f"{self.parameter}{where}" + ("" if self.kind == "value" else f" {self.kind}")


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

    def __len__(self) -> int:
        return len(self.entries)

    @property
    def start(self) -> np.ndarray:
        """Where a fit starts, ``[coordinate]``."""
        return np.array([entry.start for entry in self.entries])

    @property
    def low(self) -> np.ndarray:
        """Smallest values, ``[coordinate]``."""
        return np.array([entry.low for entry in self.entries])

    @property
    def high(self) -> np.ndarray:
        """Largest values, ``[coordinate]``."""
        return np.array([entry.high for entry in self.entries])

    def penalties(self, points: np.ndarray) -> np.ndarray:
        """How many standard deviations points ``[candidate, coordinate]`` are from what is expected."""
        prior = np.array([entry.prior for entry in self.entries])
        deviation = np.array([entry.deviation for entry in self.entries])
        return (points - prior) / deviation

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

    def suspects(self, point: np.ndarray) -> list[tuple[str, int, float]]:
        """Joints that stand out by more than their servos' spread: effect, joint, and by how much, most first.

        A fault of one joint draws the spread of all joints to its bounds: its own to one, the others' to the other.

        Args:
            point: of a refitted base, ``[coordinate]``.
        """
        found = []
        for parameter, effect in FAULTS.items():
            at = [i for i, e in enumerate(self.entries) if e.parameter == parameter and e.kind == "scale"]
            if len(at) < 3:
                continue
            apart = (point[at] - np.median(point[at])) / self.entries[at[0]].deviation
            worst = int(np.abs(apart).argmax())
            columns = self.entries[at[worst]].joints
            if abs(apart[worst]) > OUTLIER and columns is not None:
                found.append((effect, columns[0], float(apart[worst])))
        for entry, value in zip(self.entries, point, strict=True):
            apart = (value - entry.prior) / entry.deviation
            if CHAIN.get(entry.parameter, (0.0, 0.0, False))[2] and entry.joints and abs(apart) > OUTLYING_READING:
                found.append((CHAIN_FAULTS[entry.parameter], entry.joints[0], float(apart)))
        return sorted(found, key=lambda suspect: -abs(suspect[2]))

    def extended(self, model: RobotModel, more: Sequence[Coordinate]) -> "Coordinates":
        """These numbers and more, for a model with more effects."""
        return Coordinates(model, self.joints, (*self.entries, *more))


def base_coordinates(
    model: RobotModel, joints: Sequence[str], *, fixed_base: bool, named: Sequence[tuple[str, int]] = ()
) -> Coordinates:
    """What is refitted before and beside every hypothesis: the model's own parameters, and the spread of its servos.

    A forward efficiency of a current-driven servo is left out: it cannot be told from the torque constant. So are
    masses of a base that is held.

    Args:
        model: whose parameters.
        joints: joint names.
        fixed_base: whether the base is held.
        named: parameters and joints in which a fault has been named: these keep a value of their own.
    """
    entries: list[Coordinate] = []
    drive = next((getattr(e, "drive", "current") for e in model.effects if e.name == "motor"), "current")
    for effect in model.effects:
        held = bool(effect.edits) and all(edit.target == "base_body" for edit in effect.edits)
        for known in effect.parameters:
            if (held and fixed_base) or (known.name == "forward_efficiency" and drive == "current"):
                continue
            if known.name in CHAIN:
                entries.extend(_chain(model, known, joints))
                continue
            if known.name in HELD:
                continue
            low, high = _range(known, model.value(known.name))
            span = high - low
            for columns, start in _alike(model, known, joints, {joint for name, joint in named if name == known.name}):
                ends = (low, high, *_range(known, start))
                entries.append(
                    Coordinate(known.name, columns, min(ends), max(ends), start, start, max(ends) - min(ends))
                )
            for condition, special in model.estimate(known.name).by.items():
                name, start = f"{known.name}@{condition}", special.value
                entries.append(Coordinate(name, None, start - span, start + span, start, start, span))
    if len(joints) > 1:
        for name, deviation in SPREAD.items():
            if name in model.parameters() and any(entry.parameter == name for entry in entries):
                reach = SPREAD_LIMIT * deviation
                entries.extend(
                    Coordinate(name, (j,), -reach, reach, 0.0, 0.0, deviation, "scale") for j in range(len(joints))
                )
    return Coordinates(model, tuple(joints), tuple(entries))


def _range(known: Parameter, value: float) -> tuple[float, float]:
    """Where a parameter may go: in the catalogue's range, or about a value that lies beyond it.

    Such a value is that of a servo of another size, or of a joint with a fault that has been named.
    """
    if known.low <= value <= known.high:
        return known.low, known.high
    if value == 0.0:
        return min(known.low, 0.0), max(known.high, 0.0)
    ends = value / REACH, value * REACH
    return max(known.least, min(ends)), min(known.most, max(ends))


def _alike(
    model: RobotModel, known: Parameter, joints: Sequence[str], named: set[int]
) -> list[tuple[tuple[int, ...] | None, float]]:
    """Joints that share a value, and the value: all; or those near the median, and each of the others by itself.

    Joints in which an effect is off stay so.
    """
    own = model.tensors(joints)[known.name][0].numpy()
    if len(own) == 1 or np.ptp(own) < 1e-12:
        return [(None, float(own[0]))]
    middle = float(np.median(own))
    spread = SPREAD_LIMIT * SPREAD.get(known.name, 0.0)  # all others may be at its other end
    near = np.abs(own - middle) <= max(NEAR, 2.0 * spread / (1.0 - spread)) * abs(middle) + 1e-12
    near[sorted(named)] = False
    groups = [] if middle == known.neutral else [(tuple(np.flatnonzero(near).tolist()), float(own[near].mean()))]
    return [*groups, *(((int(j),), float(own[j])) for j in np.flatnonzero(~near))]


def _chain(model: RobotModel, known: Parameter, joints: Sequence[str]) -> list[Coordinate]:
    """A parameter of the measurement chain: near what is expected of it, or free where the model has another value.

    It has one after the effect has been named: what every chain has a little of is then no longer what is expected.
    """
    value, deviation, own = CHAIN[known.name]
    low, high = max(known.least, value - CHAIN_REACH * deviation), chain_limit(known.name)
    now, span = model.tensors(joints)[known.name][0].tolist(), known.high - known.low
    entries = []
    for number, columns in enumerate([(j,) for j in range(len(joints))] if own else [None]):
        at = float(now[number % len(now)])
        if low <= at <= high:
            entries.append(Coordinate(known.name, columns, low, high, value, value, deviation))
        else:
            least, most = min(known.low, at - span), max(known.high, at + span)
            entries.append(
                Coordinate(known.name, columns, max(known.least, least), min(known.most, most), at, at, span)
            )
    return entries
