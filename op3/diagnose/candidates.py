"""What could be missing: every effect of the catalogue, in every place where it can sit, as finite changes."""

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

PLACES = {"shared": 0.5, "joint": 0.35, "pair": 0.1, "side": 0.05}
"""How much more probable it is beforehand that a fault is of all joints, of one, of a mirror pair, or of a side."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One finite change of one effect in one place.

    Attributes:
        effect: its class.
        joints: columns in which it sits; None for all joints alike, or the whole robot.
        scope: key of `PLACES`.
        model: the base's model with the effect on, neutral.
        secant: amounts by parameter name.
        partner: those in the second joint of a pair, where an angle is at its mirror image; None: the same.
    """

    effect: type[Effect]
    joints: tuple[int, ...] | None
    scope: str
    model: RobotModel
    secant: Mapping[str, float]
    partner: Mapping[str, float] | None = None

    @property
    def place(self) -> tuple[str, tuple[int, ...] | None]:
        """Effect and joints: candidates of one place are secants, or forms, of one hypothesis."""
        return self.effect.name, self.joints

    @property
    def shape(self) -> tuple:
        """Effect, secant and form: all but where it sits."""
        return self._shaped(self.secant)

    def _shaped(self, secant: Mapping[str, float]) -> tuple:
        form = repr(self.model.effect(self.effect.name))
        return self.effect.name, tuple(sorted(secant.items())), form

    def secants(self) -> list[Mapping[str, float]]:
        """Amounts in each of its joints."""
        count = len(self.joints or ())
        return [self.secant] * count if self.partner is None else [self.secant, self.partner]

    @property
    def key(self) -> tuple:
        """What tells it from every other, whatever the values of its model."""
        return self.joints, self.shape

    @property
    def parts(self) -> tuple[tuple, ...]:
        """Keys of what it is the sum of, to first order: of a pair or a side what it is in each of its joints."""
        if self.scope in ("pair", "side"):
            return tuple(
                ((joint,), self._shaped(secant))
                for joint, secant in zip(self.joints or (), self.secants(), strict=True)
            )
        return (self.key,)

    def label(self, names: Sequence[str]) -> str:
        """Effect and joints, such as ``backlash@elbow``."""
        if self.joints is None:
            return self.effect.name
        return f"{self.effect.name}@{'+'.join(names[j] for j in self.joints)}"

    @property
    def sized(self) -> str:
        """The parameter whose amount says how much of the effect there is."""
        return next((name for name in self.secant if parameter(name).neutral is not None), next(iter(self.secant)))

    def moved(self, values: Mapping[str, Tensor], share: float = 1.0) -> dict[str, Tensor]:
        """Parameters ``[1, joint]`` at a share of the secant, starting from those given."""
        result = {name: value.clone() for name, value in values.items()}
        for name, amount in self.secant.items():
            known = parameter(name)
            at = slice(None) if self.joints is None or not known.per_joint else list(self.joints)
            if known.neutral is None:
                result[name][:, at] = amount
            else:
                result[name][:, at] += share * amount
            result[name] = result[name].clamp(known.least, known.most)
        return result

    def reach(self, base: RobotModel, settings: Settings) -> tuple[float, float, float]:
        """Lowest and highest plausible share of the secant, and the slab's standard deviation.

        Plausible is what the catalogue's range says of a fault: more than a sound robot has, as far as physics allows;
        of what the base has, too, a joint may have many times what the others have.
        """
        known = parameter(self.sized)
        amount = self.secant[known.name]
        span, neutral = known.high - known.low, known.neutral
        if self.effect.name in base.effect_names or neutral is None:
            now = base.value(known.name) if known.name in base.parameters() else known.nominal
            most = max(span, (WIDEST - 1) * now)
            low, high, size = max(-span, known.least - now), min(most, known.most - now), span
        else:
            low = settings.faulty * (min(known.low, neutral) - neutral)
            high = settings.faulty * (max(known.high, neutral) - neutral)
            low, high = max(low, known.least - neutral), min(high, known.most - neutral)
            size = max(known.high - neutral, neutral - known.low)
        ends = sorted((low / amount, high / amount))
        return ends[0], ends[1], settings.slab * size / abs(amount)

    def coordinates(
        self, model: RobotModel, base: Sequence[Coordinate], share: float, settings: Settings
    ) -> tuple[Coordinate, ...]:
        """The numbers of a refit beside the base's: the effect's size in its joints, from a share of the secant on, and
        its shape in each of them, from the secant's on, where the base has no such number of its own."""
        low, high, deviation = self.reach(model, settings)
        amount, at = self.secant[self.sized], self.joints if parameter(self.sized).per_joint else None
        ends = sorted((low * amount, high * amount))
        start = float(np.clip(share * amount, ends[0], ends[1]))
        size = Coordinate(self.sized, at, ends[0], ends[1], start, 0.0, deviation * abs(amount), "add")
        shared = {entry.parameter for entry in base if entry.joints is None}
        apart = [known for known in self.effect.parameters if known.neutral is None]
        shape = [one for one in apart if one.name not in shared or (self.joints and one.per_joint)]
        return size, *(one for known in shape for one in self._of_shape(known, model))

    def _of_shape(self, known: Parameter, model: RobotModel) -> Iterator[Coordinate]:
        """A shape's numbers, which may be anything plausible; an angle turns once round."""
        span = known.high - known.low
        own = list(zip(((j,) for j in self.joints or ()), self.secants(), strict=True)) if known.per_joint else []
        for place, secant in own or [(None, self.secant)]:
            now = model.value(known.name) if known.name in model.parameters() else known.nominal
            given = secant.get(known.name, now)
            low, high = (
                (given - pi, given + pi) if isclose(span, 2 * pi) else (min(known.low, given), max(known.high, given))
            )
            yield Coordinate(known.name, place, low, high, given, given, span)

    def switched_on(self, base: RobotModel, names: Sequence[str]) -> RobotModel:
        """The base with the effect on, neutral, and the shape that the secant says (such as a phase) in its place."""
        effect = self.model.effect(self.effect.name)
        given = {p.name: self.model.estimate(p.name) for p in effect.parameters}
        if self.effect.name in base.effect_names:
            given = {name: base.estimate(name) for name in given}
        model = base.with_effect(effect, given)
        where = {"": self.secant}
        if self.joints is not None:
            where = {f"@joint={names[j]}": secant for j, secant in zip(self.joints, self.secants(), strict=True)}
        shape = {name for name in self.secant if parameter(name).neutral is None}
        return model.with_values({f"{name}{at}": secant[name] for at, secant in where.items() for name in shape})


def candidates(
    model: RobotModel,
    joints: Sequence[str],
    moving: Sequence[bool],
    mirror: Mapping[str, tuple[str, int]],
    without: Sequence[str] = (),
) -> list[Candidate]:
    """Every effect of the catalogue that logs of a robot with a held base could show, in every place.

    Left out is what the base has as its own numbers: the chain of measurement, and for all joints alike what it fits;
    and effects `without` which it has to do.
    """
    found: list[Candidate] = []
    for name, effect in catalogue().items():
        if not _possible(effect, model) or name in without:
            continue
        if effect.both_sides and not mirror_pairs(joints, moving, mirror):
            continue
        on = name in model.effect_names
        neutral = {p.name: p.nominal if p.neutral is None else p.neutral for p in effect.parameters}
        with_it = model if on else model.with_effect(effect(), neutral)
        forms = [with_it, *([] if on else other_forms(with_it, lambda other, mine=effect: other is mine))]
        for variant in forms:
            for secant in _own(effect, on):
                for scope, place in _places(model, effect, joints, moving, mirror):
                    sign = mirror[joints[place[0]]][1] if scope == "pair" and place else 1
                    partner = _mirrored(effect, secant) if sign < 0 else None
                    found.append(Candidate(effect, place, scope, variant, secant, partner))
    return found


def _possible(effect: type[Effect], model: RobotModel) -> bool:
    """Whether a robot with a held base and this drive could show it, and the base does not have it as a number."""
    if not effect.secants or not effect.foreseeable or effect.free_base:
        return False
    if any(e.target in ("base_body", "ground_geom", "option") for e in effect.edits):
        return False
    regulated = "current_pd" in model.effect_names
    asks = set(effect.commands)
    return not asks & ({"firmware_gain"} if regulated else {"p_gain", "d_gain"})


def _own(effect: type[Effect], on: bool) -> list[dict[str, float]]:
    """Secants without parameters of other effects, which the base refits; of an effect that is on its shape stays."""
    own = {p.name for p in effect.parameters if not (on and p.neutral is None)}
    kept: list[dict[str, float]] = []
    for secant in effect.secants:
        mine = {name: amount for name, amount in secant.items() if name in own}
        if mine not in kept and any(parameter(name).neutral is not None for name in mine):
            kept.append(mine)
    return kept


def _mirrored(effect: type[Effect], secant: Mapping[str, float]) -> dict[str, float]:
    """That of the effect's secants with its angles at their mirror image."""

    def image(name: str, value: float) -> float:
        if not parameter(name).mirrored:
            return value
        return min((one[name] for one in effect.secants), key=lambda other: abs(remainder(other + value, 2 * pi)))

    return {name: image(name, value) for name, value in secant.items()}


def _places(
    model: RobotModel,
    effect: type[Effect],
    joints: Sequence[str],
    moving: Sequence[bool],
    mirror: Mapping[str, tuple[str, int]],
) -> Iterator[tuple[str, tuple[int, ...] | None]]:
    """Scopes and places in which an effect can sit."""
    of_motor = "motor" in model.effect_names and effect.name in ("torque_constant", "terminal_resistance")
    refitted = effect.name in model.effect_names or of_motor
    scopes = set(effect.scopes)
    in_base = any(p.name in CHAIN for p in effect.parameters)
    if scopes & {"shared", "robot"} and not refitted and not in_base:
        yield "shared", None
    if not scopes & {"joint", "side"}:
        return
    if len(joints) == 1:
        if not scopes & {"shared", "robot"} and not in_base:
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
    """Columns of joints and their partners, each pair once, the alphabetically first side first."""
    at = {joint: j for j, joint in enumerate(joints) if moving[j]}
    pairs = {(joint, other) for joint in at if (other := mirror.get(joint, (joint, 1))[0]) in at and other > joint}
    return sorted((at[first], at[second]) for first, second in pairs)


def place_priors(found: Sequence[Candidate]) -> np.ndarray:
    """Log prior of every candidate's place, ``[candidate]``; each number that a law has beyond its first halves it."""
    places: dict[str, set] = {}
    for one in found:
        places.setdefault(one.scope, set()).add(one.joints)
    numbers = [sum(p.neutral is not None for p in c.effect.parameters) for c in found]
    return np.log([PLACES[c.scope] / len(places[c.scope]) for c in found]) - np.log(2.0) * (np.array(numbers) - 1)


def parts_of(found: Sequence[Candidate]) -> list[Candidate]:
    """Candidates that are no sums of others."""
    return [one for one in found if one.parts == (one.key,)]


def secants_of_place(found: Sequence[Candidate]) -> np.ndarray:
    """How many secants of one effect are at each candidate's place, ``[candidate]``."""
    count = Counter(one.place for one in found)
    return np.array([count[one.place] for one in found])
