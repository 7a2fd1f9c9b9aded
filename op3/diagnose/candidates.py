"""Candidates: finite changes by every effect of the catalogue in every set of joints in which it can act."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isclose, pi, remainder

import numpy as np
from torch import Tensor

from op3.diagnose.coordinates import CHAIN, WIDEST, Coordinate, other_forms
from op3.diagnose.judge_settings import Settings
from op3.servo import Effect, Parameter, RobotModel, catalogue
from op3.servo.effect import parameter

SCOPE_PRIORS = {"shared": 0.5, "joint": 0.35, "pair": 0.1, "side": 0.05}
"""Prior probabilities that a fault affects all joints, one joint, a mirror pair, or one side."""

Hypothesis = tuple[str, tuple[int, ...] | None]
"""Effect and joint columns; None: all joints, or the whole robot."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A finite change by one effect in a set of joints.

    Attributes:
        effect: class of the effect.
        joints: columns of the joints; None: all joints with the same value, or the whole robot.
        scope: key of `SCOPE_PRIORS`.
        model: the baseline's model with the effect switched on at its neutral values.
        secant: parameter changes by name.
        mirror_secant: changes in the second joint of a pair, whose angles are mirrored; None: as in the first.
    """

    effect: type[Effect]
    joints: tuple[int, ...] | None
    scope: str
    model: RobotModel
    secant: Mapping[str, float]
    mirror_secant: Mapping[str, float] | None = None

    @property
    def hypothesis(self) -> Hypothesis:
        """Effect and joints, shared by candidates with different secants or forms of the law."""
        return self.effect.name, self.joints

    @property
    def variant(self) -> tuple:
        """Effect, secant and form of the law."""
        return self._variant(self.secant)

    def _variant(self, secant: Mapping[str, float]) -> tuple:
        form = repr(self.model.effect(self.effect.name))
        return self.effect.name, tuple(sorted(secant.items())), form

    def secants(self) -> list[Mapping[str, float]]:
        """Parameter changes in each of its joints."""
        count = len(self.joints or ())
        return [self.secant] * count if self.mirror_secant is None else [self.secant, self.mirror_secant]

    @property
    def key(self) -> tuple:
        """Identifier, independent of the model's values."""
        return self.joints, self.variant

    @property
    def components(self) -> tuple[tuple, ...]:
        """Keys of the elementary candidates whose columns add up to this one; a pair or a side has one per joint."""
        if self.scope in ("pair", "side"):
            return tuple(
                ((joint,), self._variant(secant))
                for joint, secant in zip(self.joints or (), self.secants(), strict=True)
            )
        return (self.key,)

    def label(self, names: Sequence[str]) -> str:
        """Effect and joints, such as ``backlash@elbow``."""
        if self.joints is None:
            return self.effect.name
        return f"{self.effect.name}@{'+'.join(names[j] for j in self.joints)}"

    @property
    def size_parameter(self) -> str:
        """Name of the parameter that is the effect's size."""
        return next((name for name in self.secant if parameter(name).neutral is not None), next(iter(self.secant)))

    def applied(self, values: Mapping[str, Tensor], share: float = 1.0) -> dict[str, Tensor]:
        """Parameters ``[1, joint]`` changed by a share of the secant."""
        result = {name: value.clone() for name, value in values.items()}
        for name, amount in self.secant.items():
            p = parameter(name)
            columns = slice(None) if self.joints is None or not p.per_joint else list(self.joints)
            if p.neutral is None:
                result[name][:, columns] = amount
            else:
                result[name][:, columns] += share * amount
            result[name] = result[name].clamp(p.least, p.most)
        return result

    def size_range(self, base: RobotModel, settings: Settings) -> tuple[float, float, float]:
        """Smallest and largest plausible share of the secant, and the standard deviation of the slab.

        The range of a fault is the catalogue's range times `fault_factor`, within the physical limits. If the baseline
        includes the effect, a joint may have several times the baseline's value.
        """
        p = parameter(self.size_parameter)
        amount = self.secant[p.name]
        span, neutral = p.high - p.low, p.neutral
        if self.effect.name in base.effect_names or neutral is None:
            value = base.value(p.name) if p.name in base.parameters() else p.nominal
            largest = max(span, (WIDEST - 1) * value)
            low, high, size = max(-span, p.least - value), min(largest, p.most - value), span
        else:
            low = settings.fault_factor * (min(p.low, neutral) - neutral)
            high = settings.fault_factor * (max(p.high, neutral) - neutral)
            low, high = max(low, p.least - neutral), min(high, p.most - neutral)
            size = max(p.high - neutral, neutral - p.low)
        shares = sorted((low / amount, high / amount))
        return shares[0], shares[1], settings.slab * size / abs(amount)

    def coordinates(
        self, model: RobotModel, base: Sequence[Coordinate], share: float, settings: Settings
    ) -> tuple[Coordinate, ...]:
        """Coordinates that a refit adds to the baseline: the effect's size, initially a share of the secant, and its
        shape (parameters without a neutral value), initially that of the secant, unless the baseline fits the shape."""
        low, high, deviation = self.size_range(model, settings)
        amount = self.secant[self.size_parameter]
        joints = self.joints if parameter(self.size_parameter).per_joint else None
        bounds = sorted((low * amount, high * amount))
        start = float(np.clip(share * amount, bounds[0], bounds[1]))
        size = Coordinate(self.size_parameter, joints, bounds[0], bounds[1], start, 0.0, deviation * abs(amount), "add")
        shared = {entry.parameter for entry in base if entry.joints is None}
        shape = [p for p in self.effect.parameters if p.neutral is None]
        shape = [p for p in shape if p.name not in shared or (self.joints and p.per_joint)]
        return size, *(coordinate for p in shape for coordinate in self._shape_coordinates(p, model))

    def _shape_coordinates(self, p: Parameter, model: RobotModel) -> Iterator[Coordinate]:
        """Coordinates of a shape parameter over its whole range, or over one turn for an angle."""
        span = p.high - p.low
        by_joint = list(zip(((j,) for j in self.joints or ()), self.secants(), strict=True)) if p.per_joint else []
        for joints, secant in by_joint or [(None, self.secant)]:
            start = secant.get(p.name, model.value(p.name) if p.name in model.parameters() else p.nominal)
            turn = isclose(span, 2 * pi)
            low, high = (start - pi, start + pi) if turn else (min(p.low, start), max(p.high, start))
            yield Coordinate(p.name, joints, low, high, start, start, span)

    def switched_on(self, base: RobotModel, names: Sequence[str]) -> RobotModel:
        """The baseline's model with the effect on, with a neutral size and the secant's shape."""
        effect = self.model.effect(self.effect.name)
        values = {p.name: self.model.estimate(p.name) for p in effect.parameters}
        if self.effect.name in base.effect_names:
            values = {name: base.estimate(name) for name in values}
        model = base.with_effect(effect, values)
        secants = {"": self.secant}
        if self.joints is not None:
            secants = {f"@joint={names[j]}": secant for j, secant in zip(self.joints, self.secants(), strict=True)}
        shape = {name for name in self.secant if parameter(name).neutral is None}
        return model.with_values({f"{name}{at}": secant[name] for at, secant in secants.items() for name in shape})


def all_candidates(
    model: RobotModel,
    joints: Sequence[str],
    moving: Sequence[bool],
    mirror: Mapping[str, tuple[str, int]],
    without: Sequence[str] = (),
) -> list[Candidate]:
    """Every effect of the catalogue that logs of a robot with a held base can reveal, in all sets of joints.

    Parameters that the baseline fits are not candidates: the measurement chain, and shared values of its effects.

    Args:
        model: the baseline's model.
        joints: joint names.
        moving: which joints move.
        mirror: mirror joint and the sign of its angle, by joint.
        without: effects that are not considered.
    """
    result: list[Candidate] = []
    for name, effect in catalogue().items():
        if not _observable(effect, model) or name in without:
            continue
        if effect.both_sides and not mirror_pairs(joints, moving, mirror):
            continue
        on = name in model.effect_names
        neutral = {p.name: p.nominal if p.neutral is None else p.neutral for p in effect.parameters}
        with_effect = model if on else model.with_effect(effect(), neutral)
        forms = [with_effect, *([] if on else other_forms(with_effect, lambda other, effect=effect: other is effect))]
        for form in forms:
            for secant in _secants(effect, on):
                for scope, columns in _scopes(model, effect, joints, moving, mirror):
                    sign = mirror[joints[columns[0]]][1] if scope == "pair" and columns else 1
                    mirror_secant = _mirrored(effect, secant) if sign < 0 else None
                    result.append(Candidate(effect, columns, scope, form, secant, mirror_secant))
    return result


def _observable(effect: type[Effect], model: RobotModel) -> bool:
    """Whether logs of a robot with a held base and this drive can reveal an effect."""
    if not effect.secants or not effect.foreseeable or effect.free_base:
        return False
    if any(e.target in ("base_body", "ground_geom", "option") for e in effect.edits):
        return False
    regulated = "current_pd" in model.effect_names
    return not set(effect.commands) & ({"firmware_gain"} if regulated else {"p_gain", "d_gain"})


def _secants(effect: type[Effect], on: bool) -> list[dict[str, float]]:
    """An effect's secants without parameters of other effects; without its shape if the model includes the effect."""
    names = {p.name for p in effect.parameters if not (on and p.neutral is None)}
    result: list[dict[str, float]] = []
    for full in effect.secants:
        secant = {name: amount for name, amount in full.items() if name in names}
        if secant not in result and any(parameter(name).neutral is not None for name in secant):
            result.append(secant)
    return result


def _mirrored(effect: type[Effect], secant: Mapping[str, float]) -> dict[str, float]:
    """The secant with each angle replaced by the nearest angle among the effect's secants to its mirror image."""

    def image(name: str, value: float) -> float:
        if not parameter(name).mirrored:
            return value
        return min((other[name] for other in effect.secants), key=lambda angle: abs(remainder(angle + value, 2 * pi)))

    return {name: image(name, value) for name, value in secant.items()}


def _scopes(
    model: RobotModel,
    effect: type[Effect],
    joints: Sequence[str],
    moving: Sequence[bool],
    mirror: Mapping[str, tuple[str, int]],
) -> Iterator[tuple[str, tuple[int, ...] | None]]:
    """Scopes and joint columns in which an effect can act."""
    of_motor = "motor" in model.effect_names and effect.name in ("torque_constant", "terminal_resistance")
    refitted = effect.name in model.effect_names or of_motor
    scopes = set(effect.scopes)
    in_chain = any(p.name in CHAIN for p in effect.parameters)
    if scopes & {"shared", "robot"} and not refitted and not in_chain:
        yield "shared", None
    if not scopes & {"joint", "side"}:
        return
    if len(joints) == 1:
        if not scopes & {"shared", "robot"} and not in_chain:
            yield "shared", None
        return
    yield from (("joint", (j,)) for j in range(len(joints)) if moving[j])
    pairs = mirror_pairs(joints, moving, mirror)
    yield from (("pair", pair) for pair in pairs)
    if len(pairs) > 1 and "side" in scopes:
        yield from (("side", tuple(pair[side] for pair in pairs)) for side in (0, 1))


def mirror_pairs(
    joints: Sequence[str], moving: Sequence[bool], mirror: Mapping[str, tuple[str, int]]
) -> list[tuple[int, int]]:
    """Columns of moving joints and their mirror joints; each pair occurs once, the alphabetically first side first."""
    column = {joint: j for j, joint in enumerate(joints) if moving[j]}
    pairs = {
        (joint, other) for joint in column if (other := mirror.get(joint, (joint, 1))[0]) in column and other > joint
    }
    return sorted((column[first], column[second]) for first, second in pairs)


def log_priors(candidates: Sequence[Candidate]) -> np.ndarray:
    """Log prior of each candidate's hypothesis, ``[candidate]``: the prior of its scope divided by the number of joint
    sets of that scope, and halved for every size parameter after the first."""
    joints: dict[str, set] = {}
    for candidate in candidates:
        joints.setdefault(candidate.scope, set()).add(candidate.joints)
    sizes = [sum(p.neutral is not None for p in c.effect.parameters) for c in candidates]
    return np.log([SCOPE_PRIORS[c.scope] / len(joints[c.scope]) for c in candidates]) - np.log(2.0) * (
        np.array(sizes) - 1
    )


def elementary(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Candidates that are not sums of other candidates."""
    return [candidate for candidate in candidates if candidate.components == (candidate.key,)]


def secant_counts(candidates: Sequence[Candidate]) -> np.ndarray:
    """Number of candidates of the same hypothesis, ``[candidate]``."""
    count = Counter(candidate.hypothesis for candidate in candidates)
    return np.array([count[candidate.hypothesis] for candidate in candidates])
