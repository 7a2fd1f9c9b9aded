"""What may differ between the set-ups of a bench: an arm that was mounted anew has a zero of its own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from op3.diagnose.coordinates import Coordinate, Coordinates
from op3.diagnose.hypotheses import Hypothesis
from op3.rollout import Rollout
from op3.servo import Effect, RobotModel, catalogue
from op3.servo.conditions import Condition, split_name
from op3.servo.effect import parameter

FIELDS = ("length", "mass")
"""Fields of the metadata that say which set-up was recorded."""

DIFFERS = ("encoder_offset",)
"""Effects that may differ between set-ups: what changes when an arm is taken off and put on again."""


@dataclass(frozen=True, eq=False)
class SetupHypothesis(Hypothesis):
    """One effect whose size differs between set-ups.

    Attributes:
        field: of the metadata that tells set-ups apart.
        names: the conditional parameters, one for each set-up.
    """

    field: str = ""
    names: tuple[str, ...] = ()

    def label(self, names: Sequence[str]) -> str:
        """Effect and what it differs by, such as ``encoder_offset by length``."""
        del names
        return f"{self.effect.name} by {self.field}"

    def neutral(self, joints: Sequence[str]) -> dict[str, Tensor]:
        """Parameters at which all set-ups are alike, ``[1, joint]``."""
        values = self.model.tensors(joints)
        return values | {name: values[split_name(name)[0]] for name in self.names}

    def moved(self, base: Mapping[str, Tensor], secant: Mapping[str, float], share: float = 1.0) -> dict[str, Tensor]:
        """Parameters ``[1, joint]`` with the offset of some set-ups moved by a share of a secant."""
        values = {name: value.clone() for name, value in base.items()}
        for name in self.names:
            values[name] = base[name] + share * secant.get(name, 0.0)
        return values

    def coordinates(
        self, base: Coordinates, secant: Mapping[str, float], share: float
    ) -> tuple[Coordinates, np.ndarray]:
        """Coordinates of a refit beside the base's: the value of every set-up, from where the screen has it."""
        entries = []
        for name in self.names:
            known = parameter(split_name(name)[0])
            now = self.model.value(known.name)
            span = known.high - known.low
            start = float(np.clip(now + share * secant.get(name, 0.0), now - span, now + span))
            entries.append(Coordinate(name, None, now - span, now + span, start, now, 2 * span))
        return base.extended(self.model, entries), np.array([entry.start for entry in entries])


def setup_hypotheses(model: RobotModel, logs: Sequence[Rollout], without: Sequence[str] = ()) -> list[SetupHypothesis]:
    """Every effect of `DIFFERS` that may have a value of its own in each set-up of a bench.

    Args:
        model: the base model, its values fitted.
        logs: of a bench; logs of a robot, or of one set-up, give none.
        without: names of effects not to consider.
    """
    found = []
    for field in FIELDS:
        values = sorted({getattr(log.metadata, field) for log in logs} - {None})
        if len(values) < 2 or any(log.metadata.mount != "pendulum" for log in logs):
            continue
        for effect in (catalogue()[name] for name in DIFFERS if name not in without):
            known = effect.parameters[0]
            names = tuple(f"{known.name}@{Condition(field, value)}" for value in values)
            if all(Condition(field, value) in model.estimate(known.name).by for value in values if _on(model, effect)):
                continue  # the base has them already
            amount = next(iter(effect.secants))[known.name]
            with_it = model if _on(model, effect) else model.with_effect(effect(), {known.name: known.neutral or 0.0})
            # a model object of its own: the screen simulates hypotheses of one object together
            secants = tuple({name: amount} for name in names)
            found.append(SetupHypothesis(effect, None, replace(with_it), secants, field, names))
    return found


def _on(model: RobotModel, effect: type[Effect]) -> bool:
    return effect.name in model.effect_names
