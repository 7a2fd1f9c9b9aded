"""What a step of the servo law does, as a list of torch operations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from op3.servo.effect import Signals

DECIDING = (torch.Tag.dynamic_output_shape, torch.Tag.data_dependent_output)
"""Marks of operations whose results are not of one shape, or no tensors, whatever the numbers."""


class Untranslatable(Exception):
    """The step does something that has no translation."""


@dataclass(frozen=True, eq=False)
class Call:
    """One operation that ran.

    Attributes:
        function: the ATen overload.
        arguments: positional ones, tensors or nests of them among other values.
        options: keyword ones.
        result: a tensor, or several.
        reads: tensors among the arguments.
        results: tensors that it made.
    """

    function: Any
    arguments: tuple[Any, ...]
    options: Mapping[str, Any]
    result: Any
    reads: Sequence[Tensor]
    results: Sequence[Tensor]


@dataclass(frozen=True, eq=False)
class Recording:
    """A step that ran; tensors are told by their ids, and all are kept.

    Attributes:
        calls: in their order.
        signals: what the step left in the signals, by name.
        state: what it left in the memory of the effects.
        factors: what it left of factors on the motor's parameters.
        moving: ids of what may have other numbers in another step; the rest is parameters.
    """

    calls: Sequence[Call]
    signals: Mapping[str, Tensor]
    state: Mapping[str, Tensor]
    factors: Mapping[str, Tensor]
    moving: set[int]

    def of_parameters(self, needed: set[int]) -> list[Call] | None:
        """Operations on parameters alone whose results are needed; None if numbers of parameters decide something."""
        fixed = [call for call in self.calls if not any(id(made) in self.moving for made in call.results)]
        if any(tag in call.function.tags for call in fixed for tag in DECIDING):
            return None
        return [call for call in fixed if any(id(made) in needed for made in call.results)]

    def needed(self, wanted: Sequence[Tensor]) -> set[int]:
        """Ids of the tensors that have to be known for those wanted."""
        needed = {id(tensor) for tensor in wanted}
        for call in reversed(self.calls):
            if any(id(made) in needed for made in call.results):
                needed.update(id(read) for read in call.reads)
        return needed


def record(step: Callable[[Signals], None], signals: Mapping[str, Tensor], memory: Mapping[str, Tensor]) -> Recording:
    """Run a step and note its operations, which is far cheaper than to trace it symbolically.

    Args:
        step: works on the signals that it is given.
        signals: all of them that are tensors; the phase is zero where it is none.
        memory: of the effects.

    Raises:
        Untranslatable: if the step fails, changes a tensor in place, or lets numbers decide what it does.
    """
    seen: dict[str, Any] = {"phase": 0, **signals}
    worked = Signals(**seen, state=dict(memory), factors={})
    try:
        with torch.no_grad(), _Recorder() as recorder:
            step(worked)
    except Exception as error:  # what an effect does in Python can fail in any way on copies of its tensors
        raise Untranslatable(str(error)) from error
    moving = {id(tensor) for tensor in (*signals.values(), *memory.values())}
    for call in recorder.calls:
        if call.function._schema.is_mutable:
            raise Untranslatable(f"{call.function} changes a tensor in place")
        if any(id(read) in moving for read in call.reads):
            if any(tag in call.function.tags for tag in DECIDING) or not call.results:
                raise Untranslatable(f"{call.function} lets numbers decide")
            moving.update(id(made) for made in call.results)
    left = {name: getattr(worked, name) for name in signals}
    return Recording(recorder.calls, left, worked.state, worked.factors, moving)


_ELEMENTARY: set[Any] = set()
"""Operations that are not made of others."""


class _Recorder(TorchDispatchMode):
    """Notes every operation that runs."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[Call] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        if func not in _ELEMENTARY:
            with self:
                composed = func.decompose(*args, **(kwargs or {}))
            if composed is not NotImplemented:  # made of other operations, which were noted; so in inference mode
                return composed
            _ELEMENTARY.add(func)
        result = func(*args, **(kwargs or {}))
        reads, results = _tensors((*args, *kwargs.values()) if kwargs else args), _tensors((result,))
        self.calls.append(Call(func, args, kwargs or {}, result, reads, results))
        return result


def _tensors(nest: Iterable[Any]) -> list[Tensor]:
    """Tensors in a nest of lists, tuples and dictionaries."""
    found: list[Tensor] = []
    for each in nest:
        if isinstance(each, Tensor):
            found.append(each)
        elif isinstance(each, list | tuple | dict):
            found += _tensors(each.values() if isinstance(each, dict) else each)
    return found
