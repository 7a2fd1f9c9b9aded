"""A step of a simulation in numpy, which works on the signals of the law."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from numpy.typing import NDArray

from op3.servo import Signals
from op3.servo.compiled_step import CompiledStep, Untranslatable

HANDED_OVER = ("applied_torque", "damping", "friction_bound")
"""What the physics gets from the law."""

RESULTS = (*HANDED_OVER, "target_current", "duty", "voltage", "current", "motor_torque")
"""Signals that a step of the law leaves and others read."""

TRANSLATED_AFTER = 50
"""Steps in torch after a reset before numpy takes over; a shorter run does not pay for the translation."""


class Translated:
    """A translated step over the signals of a simulation.

    The signals are views of the step's arrays. Whoever puts another tensor in their place between two steps (a command,
    a sensor with a memory) is heard.

    Args:
        step: the translation.
        live: names of inputs that somebody else fills.
    """

    def __init__(self, step: CompiledStep, live: Sequence[str] = ()):
        self.step = step
        self._inputs = {name: torch.from_numpy(array) for name, array in step.inputs.items() if name not in live}
        others = {name: array for name, array in step.outputs.items() if name not in self._inputs}
        self._outputs = {name: torch.from_numpy(array) for name, array in others.items()}
        self._state = {name: torch.from_numpy(array) for name, array in step.state.items()}
        # memory that a step writes before it reads it
        self._written = {
            name: torch.from_numpy(array) for name, array in step.next_state.items() if name not in self._state
        }
        self._factors = {name: torch.from_numpy(array) for name, array in step.factors.items()}

    @classmethod
    def of(
        cls,
        step: Callable[[Signals], None],
        signals: Signals,
        outputs: Sequence[str],
        live: Mapping[str, NDArray[Any]] | None = None,
    ) -> Translated | None:
        """The step in numpy; None where it has no translation.

        Args:
            step: what to translate, see `op3.servo.compiled_step.CompiledStep`.
            signals: after a step.
            outputs: names of the signals that are wanted.
            live: arrays that stand for inputs and are filled by somebody else before every step.
        """
        try:
            return cls(CompiledStep(step, signals, outputs, live, tuple(live or ())), tuple(live or ()))
        except Untranslatable:
            return None

    def hear(self, signals: Signals) -> None:
        """Take over what was put into the signals since the last step."""
        for name, view in self._inputs.items():
            value = getattr(signals, name)
            if value is not view:
                view.copy_(value)
                setattr(signals, name, view)
        for name, view in self._state.items():
            if signals.state[name] is not view:
                view.copy_(signals.state[name])
                signals.state[name] = view

    def tell(self, signals: Signals) -> None:
        """Put the results into the signals."""
        for name, view in self._outputs.items():
            setattr(signals, name, view)
        signals.state.update(self._written)
        signals.factors.update(self._factors)

    def advance(self, signals: Signals) -> None:
        """One step from the signals to the signals."""
        self.hear(signals)
        self.step()
        self.tell(signals)
