"""What could be missing: every effect of the catalogue, in every place where it can sit."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from op3.diagnose.coordinates import CHAIN, FORMS, HELD, Coordinate, Coordinates, other_forms
from op3.robot.motions import BENCH_JOINTS
from op3.servo import Effect, Parameter, RobotModel, catalogue, effect_class
from op3.servo.effect import parameter
from op3.sim.pendulum_simulation import LINK, ROTOR

CHAIN_TIMING = ("latency", "current_lag", "velocity_filter")
"""Effects of firmware and bus, which all joints share."""

OF_THE_MOTOR = ("torque_constant", "terminal_resistance")
"""Errors of what the motor has as parameters: in all joints they are what a base refits anyway."""

POSITION_ONLY = ("position_servo", "minimum_duty")
"""Effects of servos with a position loop of their own."""

OF_A_BENCH = ("directional_friction", "antagonistic_friction")
"""Forms of `load_friction` with shares of their own for motor and load, which a bench of one servo tells apart. On a
robot they would only take its name where its friction follows the motor's torque more than the load's."""

CURRENT_ONLY = ("current_lag", "current_offset", "packet_drop")
"""Effects of servos that regulate current."""

FAULTY = 1.6
"""How many times larger than the catalogue's range for a sound robot an effect may be found: what is looked for is a
fault. Beyond it a size is not plausible."""

UNHELD_ONLY = ("gyro_bias", "imu_mount", "ground_tilt")
"""Effects that a robot with a held base, or a bench, does not show."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One effect in one place.

    Attributes:
        effect: its class.
        joints: columns in which it sits; None for all joints alike, or the whole robot.
        model: the base model with the effect on, neutral.
        secants: finite changes by which it is screened: amounts by parameter name.
    """

    effect: type[Effect]
    joints: tuple[int, ...] | None
    model: RobotModel
    secants: tuple[Mapping[str, float], ...]

    def label(self, names: Sequence[str]) -> str:
        """Effect and joint, such as ``backlash@r_knee``."""
        if self.joints is None:
            return self.effect.name
        return f"{self.effect.name}@{'+'.join(names[j] for j in self.joints)}"

    def neutral(self, joints: Sequence[str]) -> dict[str, Tensor]:
        """Parameters at which it changes nothing, those of the base included, ``[1, joint]``."""
        return self.model.tensors(joints)

    def columns(self, known: Parameter) -> tuple[int, ...] | None:
        """Columns in which one of its parameters is moved."""
        return self.joints if known.per_joint else None

    def moved(self, base: Mapping[str, Tensor], secant: Mapping[str, float], share: float = 1.0) -> dict[str, Tensor]:
        """Parameters ``[1, joint]`` at a share of a secant, starting from `base`."""
        values = {name: value.clone() for name, value in base.items()}
        for name, amount in secant.items():
            known = parameter(name)
            value = values[name] if name in values else self.model.tensors([""] * _width(base))[name].clone()
            columns = self.columns(known)
            where = slice(None) if columns is None else list(columns)
            if known.neutral is None:
                value[:, where] = amount
            else:
                value[:, where] += share * amount
            values[name] = value.clamp(known.least, known.most)
        return values

    def coordinates(
        self, base: Coordinates, secant: Mapping[str, float], share: float
    ) -> tuple[Coordinates, np.ndarray]:
        """Coordinates of a refit beside the base's, and where they start (the new ones only)."""
        entries = []
        for name, amount in secant.items():
            known = self.model.parameters()[name]
            columns = self.columns(known)
            if known.neutral is None:
                entries.append(Coordinate(name, columns, known.low, known.high, amount, amount, known.high - known.low))
            else:
                now, reach = self.model.value(name), FAULTY if known.neutral == 0.0 else 1.0
                low = max(known.least, reach * min(known.low, known.neutral)) - now
                high = min(known.most, reach * known.high) - now
                if self.effect.name in base.model.effect_names:
                    # beside a parameter that the base has: as much again in either direction
                    low, high = -reach * (known.high - known.low), reach * (known.high - known.low)
                    if name in CHAIN and not CHAIN[name][2]:
                        low = 0.0  # the chain itself has what is expected
                start = float(np.clip(share * amount, low, high))
                # the angle that an effect depends on stands for its size where only a part of a turn is seen
                expected = 2 * (high - low) if len(secant) == 1 else (known.high - known.low) / 2
                entries.append(Coordinate(name, columns, low, high, start, 0.0, expected, "add"))
        start = np.array([entry.start for entry in entries])
        return base.extended(self.model, entries), start


def _width(base: Mapping[str, Tensor]) -> int:
    return max(value.shape[1] for value in base.values())


def hypotheses(
    model: RobotModel, joints: Sequence[str], *, fixed_base: bool, without: Sequence[str] = ()
) -> list[Hypothesis]:
    """Every effect of the catalogue that these logs could show, shared and in single joints.

    Left out are effects that cannot act on the robot as it is mounted, and parameters that the base refits for all
    joints anyway; those are hypotheses in single joints only.

    Args:
        model: the base model, its values fitted.
        joints: names.
        fixed_base: whether the base is held.
        without: names of effects not to consider.
    """
    current_driven = "current_pd" in model.effect_names
    unfit = (*POSITION_ONLY, *OF_A_BENCH) if current_driven else CURRENT_ONLY
    result = []
    for name, effect in catalogue().items():
        if not effect.secants or name in without or name in unfit:
            continue
        outside = [edit for edit in effect.edits if edit.target in ("base_body", "foot_geom", "ground_geom")]
        if fixed_base and (outside or name in UNHELD_ONLY):
            continue
        if name == "left_right_asymmetry" and not all(_sides(joints).values()):
            continue
        if tuple(joints) == BENCH_JOINTS and any(edit not in (ROTOR, LINK) for edit in effect.edits):
            continue
        on = name in model.effect_names
        with_it = model if on else _switched_on(model, effect)
        for variant in [with_it, *([] if on else _variants(with_it, name))]:
            result.extend(_places(model, variant, effect, joints))
    if len(joints) == 1:
        return [Hypothesis(h.effect, None, h.model, h.secants) for h in result]
    return result


def _places(base: RobotModel, model: RobotModel, effect: type[Effect], joints: Sequence[str]) -> Iterator[Hypothesis]:
    """The places in which one effect can sit."""
    name = effect.name
    secants = tuple(_own(effect, secant) for secant in effect.secants)
    secants = tuple(secant for secant in secants if secant)
    # of what the base refits in every joint by itself, such as the zeros of current sensors, nothing is left to share
    by_joint = {p for p, (_, _, own) in CHAIN.items() if own and len(joints) > 1}
    known = [(p.name in CHAIN and p.name not in by_joint) or p.name in HELD for p in effect.parameters]
    refitted = name in base.effect_names and not any(known)
    refitted |= name in OF_THE_MOTOR and "motor" in base.effect_names
    if {"shared", "robot"} & set(effect.scopes) and not refitted:
        yield Hypothesis(effect, None, model, secants)
    if "joint" in effect.scopes and name not in CHAIN_TIMING and len(joints) > 1:
        yield from (Hypothesis(effect, (j,), model, secants) for j in range(len(joints)))
    sides = _sides(joints)
    if "side" in effect.scopes and all(sides.values()):
        yield from (Hypothesis(effect, columns, model, secants) for columns in sides.values())


def _sides(joints: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Columns of the joints on the left and on the right."""
    return {side: tuple(j for j, n in enumerate(joints) if n.startswith(side)) for side in ("l_", "r_")}


def _variants(model: RobotModel, name: str) -> list[RobotModel]:
    """The model with this effect in its other forms."""
    return other_forms(model, (name,)) if name in FORMS else []


def _switched_on(model: RobotModel, effect: type[Effect]) -> RobotModel:
    """The model with the effect on, where it changes nothing."""
    neutral = {p.name: p.nominal if p.neutral is None else p.neutral for p in effect.parameters}
    options = {"signal": "goal"} if effect.name == "latency" and "current_pd" not in model.effect_names else {}
    return model.with_effect(effect(**options), neutral)


def _own(effect: type[Effect], secant: Mapping[str, float]) -> dict[str, float]:
    """A secant without parameters of other effects, which the base refits."""
    own = {p.name for p in effect.parameters}
    return {name: amount for name, amount in secant.items() if name in own}


def separating(effects: Iterable[str]) -> str:
    """What the catalogue says would separate some effects, by their names, each experiment once."""
    said = dict.fromkeys(effect_class(name).separating_experiment for name in effects)
    return "; ".join(text for text in said if text)


def stacked(values: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Parameter sets ``[1, joint]`` as one, ``[candidate, joint]``."""
    return {name: torch.cat([value[name] for value in values]) for name in values[0]}
