"""A step of a simulation in numpy, which works on the signals of the law."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from op3.servo import Signals
from op3.servo.compiled_step import CompiledStep
from op3.servo.recording import Untranslatable

HANDED_OVER = ("applied_torque", "damping", "friction_bound")
"""What the physics gets from the law."""

RESULTS = (*HANDED_OVER, "target_current", "duty", "voltage", "current", "motor_torque")
"""Signals that a step of the law leaves and others read."""


class Translated:
    """A translated step over the signals of a simulation.

    The signals are views of the step's arrays, which the next step overwrites. Whoever puts another tensor in their
    place between two steps (a command, a sensor with a memory) is heard.

    Args:
        step: the translation.
        live: names of inputs that somebody else fills.
    """

    def __init__(self, step: CompiledStep, live: Sequence[str] = ()):
        self.step = step
        self._inputs = _views({name: array for name, array in step.inputs.items() if name not in live})
        self._outputs = _views({name: array for name, array in step.outputs.items() if name not in self._inputs})
        self._state = _views(step.state)
        # memory that a step writes before it reads it
        self._written = _views({name: array for name, array in step.next_state.items() if name not in step.state})
        self._factors = _views(step.factors)

    @classmethod
    def of(
        cls,
        step: Callable[[Signals], None],
        signals: Signals,
        outputs: Sequence[str],
        live: Mapping[str, NDArray[Any]] | None = None,
        parameters: Mapping[Any, Tensor] | None = None,
    ) -> Translated | None:
        """The step in numpy; None where it has no translation.

        Args:
            step: what to translate, see `op3.servo.compiled_step.CompiledStep`.
            signals: after a step.
            outputs: names of the signals that are wanted.
            live: arrays that stand for inputs and are filled by somebody else before every step.
            parameters: see `renew`.
        """
        try:
            made = CompiledStep(step, signals, outputs, live, tuple(live or ()), parameters)
            return cls(made, tuple(live or ()))
        except Untranslatable:
            return None

    def renew(self, parameters: Mapping[Any, Tensor]) -> bool:
        """Serve other parameters, see `op3.servo.compiled_step.CompiledStep.renew`."""
        return self.step.renew(parameters)

    def hear(self, signals: Signals) -> None:
        """Take over what was put into the signals since the last step.

        Raises:
            ValueError: if that is to be differentiated.
        """
        for name, view in self._inputs.items():
            value = getattr(signals, name)
            if value is not view:
                _take(self.step.inputs[name], name, value)
                setattr(signals, name, view)
        for name, view in self._state.items():
            value = signals.state[name]
            if value is not view:
                _take(self.step.state[name], name, value)
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


def _take(array: NDArray[Any], name: str, value: Tensor) -> None:
    if value.requires_grad:
        raise ValueError(f"{name} requires gradients, which numpy does not know: simulate with translated=False")
    np.copyto(array, value.numpy())


def _views(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Tensor]:
    """Tensors over the same memory, which may be used in and out of inference mode."""
    with torch.inference_mode(False):
        return {name: torch.from_numpy(array) for name, array in arrays.items()}
