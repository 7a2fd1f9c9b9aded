"""Complete description of a simulated robot: the effects that are on, and the values of their parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any

import torch
from torch import Tensor

from op3.servo.conditions import Condition, split_name
from op3.servo.effect import Effect, Parameter, in_stage_order, parameter


@dataclass(frozen=True)
class Estimate:
    """A parameter's value with its 90 % interval, and the joints and conditions in which it differs.

    Attributes:
        value: value of all joints that are not in `joints`, in the parameter's unit.
        low: lower end of the interval; None without data.
        high: upper end of the interval.
        joints: values of joints that differ, by joint name.
        intervals: low and high ends of the values in `joints`, by joint name, if known from data.
        by: estimates for logs that meet a condition, see `op3.servo.conditions`.
    """

    value: float
    low: float | None = None
    high: float | None = None
    joints: Mapping[str, float] = field(default_factory=dict)
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    by: Mapping[Condition, "Estimate"] = field(default_factory=dict)


@dataclass(frozen=True)
class RobotModel:
    """The active effects with their parameter values.

    Unknown names of parameters or effects raise a ValueError that lists the known ones.

    Attributes:
        effects: active effects, each at most once.
        estimates: estimates by parameter name; parameters without an entry have their nominal value.
        bus_voltage: battery or supply voltage [V] for logs without it.
        provenance: origin of the values: data, seed, date, loss.
    """

    effects: tuple[Effect, ...]
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    bus_voltage: float = 11.1
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "effects", tuple(in_stage_order(self.effects)))
        known = self.parameters()
        for name in self.estimates:
            if name not in known:
                parameter(name)  # a name that no effect has gets its own message
                raise ValueError(
                    f"a value for {name!r} is given, but the effect with this parameter is off;"
                    f" effects on: {', '.join(self.effect_names)}"
                )
            _check(known[name], self.estimates[name])

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Names of the effects that are on, in the order of their stages."""
        return tuple(effect.name for effect in self.effects)

    @property
    def stiff(self) -> bool:
        """Whether an effect that is on needs steps of the usual length or shorter."""
        return any(effect.stiff for effect in self.effects)

    def parameters(self) -> dict[str, Parameter]:
        """The parameters of the effects that are on, by name."""
        return {p.name: p for effect in self.effects for p in effect.parameters}

    def effect(self, name: str) -> Effect:
        """The effect of this name."""
        for candidate in self.effects:
            if candidate.name == name:
                return candidate
        raise ValueError(f"effect {name!r} is not on; effects on: {', '.join(self.effect_names)}")

    def value(self, name: str) -> float:
        """A parameter's shared value, in its unit."""
        known = self.parameters()
        if name not in known:
            raise ValueError(f"no parameter {name!r} in this model; it has {', '.join(known)}")
        return self.estimates[name].value if name in self.estimates else known[name].nominal

    def estimate(self, name: str) -> Estimate:
        """A parameter's estimate, or its nominal value if there is none; `name` may contain a condition or a joint."""
        base, condition = split_name(name)
        shared = self.estimates.get(base, Estimate(self.value(base)))
        if condition is None:
            return shared
        if condition.joint is not None:
            value, interval = shared.joints.get(condition.joint), shared.intervals.get(condition.joint, (None, None))
            return Estimate(shared.value, shared.low, shared.high) if value is None else Estimate(value, *interval)
        return shared.by.get(condition, shared)

    def under(self, metadata: Mapping[str, Any]) -> "RobotModel":
        """This model for a log with these metadata, by field: applicable conditional values replace the shared ones.

        Raises:
            ValueError: if a condition names an unknown field.
        """
        held = {
            name: special
            for name, estimate in self.estimates.items()
            for condition, special in estimate.by.items()
            if condition.holds(metadata)
        }
        return self.with_values(held) if held else self

    def tensors(self, joints: Sequence[str]) -> dict[str, Tensor]:
        """All parameter values, each ``[1, joint]`` (``[1, 1]`` for one of the whole robot), float64.

        Raises:
            ValueError: if an estimate names a joint that is not in `joints`.
        """
        values = {}
        for name, known in self.parameters().items():
            row = torch.full((1, len(joints) if known.per_joint else 1), self.value(name), dtype=torch.float64)
            for joint, value in self.estimates[name].joints.items() if name in self.estimates else ():
                if joint not in joints:
                    raise ValueError(f"{name}: unknown joint {joint!r}; the robot has {', '.join(joints)}")
                row[0, list(joints).index(joint)] = value
            values[name] = row
        return values

    def with_values(self, values: Mapping[str, float | Estimate]) -> "RobotModel":
        """This model with changed parameter values; a number replaces a shared value, or that of a condition or
        joint."""
        estimates = dict(self.estimates)
        for name, value in sorted(values.items(), key=lambda item: "@" in item[0]):  # shared values first
            base, condition = split_name(name)
            made = value if isinstance(value, Estimate) else Estimate(float(value))
            if condition is not None:
                shared = estimates.get(base, Estimate(self.value(base)))
                made = _with_special(shared, condition, made)
            estimates[base] = made
        return replace(self, estimates=estimates)

    def moved(self, values: Mapping[str, float | Estimate]) -> "RobotModel":
        """This model with changed shared values; separate values of joints change too, see `for_joints`."""
        kept = {}
        for name, value in values.items():
            made = value if isinstance(value, Estimate) else Estimate(float(value))
            own = {} if "@" in name else self.estimate(name).joints
            rows = self.for_joints(name, torch.tensor([made.value], dtype=torch.float64), tuple(own)) if own else None
            kept[name] = made if rows is None else replace(made, joints=dict(zip(own, rows[0].tolist(), strict=True)))
        return self.with_values(kept)

    def for_joints(self, name: str, values: Tensor, joints: Sequence[str]) -> Tensor:
        """The value of each joint for another shared value of a parameter, ``[candidate, joint]``.

        A joint with a separate value keeps its ratio to the shared value, because servos differ by ratios; a joint
        without the effect stays without it. If the shared value is zero or changes sign, it keeps its difference.

        Args:
            values: shared values, ``[candidate]``.

        Returns:
            ``[candidate, joint]``, or the unchanged values if no joint has a separate value.
        """
        estimate = self.estimate(name)
        if not estimate.joints:
            return values
        known, shared = self.parameters()[name], estimate.value
        columns = []
        for joint in joints:
            own = estimate.joints.get(joint, shared)
            in_ratio = shared != 0.0 and own * shared >= 0.0
            moved = values * (own / shared) if in_ratio else values + (own - shared)
            columns.append(moved.clamp(known.least, known.most))
        return torch.stack(columns, dim=1)

    def with_effect(self, effect: Effect, values: Mapping[str, float | Estimate] | None = None) -> "RobotModel":
        """This model with an additional effect, which replaces an effect of the same name."""
        others = tuple(e for e in self.effects if e.name != effect.name)
        return replace(self, effects=(*others, effect)).with_values(values or {})

    def without(self, *names: str) -> "RobotModel":
        """This model without these effects and their parameters."""
        gone = {p.name for name in names for p in self.effect(name).parameters}
        return replace(
            self,
            effects=tuple(e for e in self.effects if e.name not in names),
            estimates={k: v for k, v in self.estimates.items() if k not in gone},
        )


def _with_special(shared: Estimate, condition: Condition, special: Estimate) -> Estimate:
    """An estimate with another value for a condition or a joint."""
    joint = condition.joint
    if joint is None:
        return replace(shared, by={**shared.by, condition: special})
    intervals = {name: ends for name, ends in shared.intervals.items() if name != joint}
    if special.low is not None and special.high is not None:
        intervals[joint] = (special.low, special.high)
    return replace(shared, joints={**shared.joints, joint: special.value}, intervals=intervals)


def _check(known: Parameter, estimate: Estimate) -> None:
    """Raise an error for physically impossible values and invalid intervals."""
    for value in (estimate.value, *estimate.joints.values()):
        if not known.least <= value <= known.most:
            allowed = (
                f"at least {known.least:g}" if known.most == inf else f"between {known.least:g} and {known.most:g}"
            )
            raise ValueError(f"{known.name} must be {allowed} {known.unit}, got {value!r}")
    for joint in estimate.intervals.keys() - estimate.joints.keys():
        raise ValueError(f"{known.name}: joint {joint!r} has an interval but no value; add the value")
    for low, high in ((estimate.low, estimate.high), *estimate.intervals.values()):
        if low is not None and high is not None and low > high:
            raise ValueError(f"{known.name}: the interval's lower end {low} is above its upper end {high}")
    for special in estimate.by.values():
        _check(known, special)
