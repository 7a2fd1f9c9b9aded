"""A step of the servo law, translated from torch to numpy.

One robot is twenty numbers, a few hundred pendulums are a few hundred: torch spends its time on calls, not on numbers.
So the operations of one step are noted, and are run by numpy into arrays that are reused, which takes a fraction of the
time. The law itself is written once, in torch; what cannot be translated is run by torch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from op3.servo.effect import Signals

Array = NDArray[Any]

_UNARY: dict[str, Callable[..., Any]] = {
    "abs": np.abs,
    "neg": np.negative,
    "exp": np.exp,
    "expm1": np.expm1,
    "log": np.log,
    "sin": np.sin,
    "cos": np.cos,
    "tanh": np.tanh,
    "sqrt": np.sqrt,
    "sign": np.sign,
    "reciprocal": np.reciprocal,
    "bitwise_not": np.logical_not,
    "logical_not": np.logical_not,
}
_BINARY: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "pow": np.power,
    "minimum": np.minimum,
    "maximum": np.maximum,
    "atan2": np.arctan2,
    "hypot": np.hypot,
    "copysign": np.copysign,
    "remainder": np.mod,
    "gt": np.greater,
    "ge": np.greater_equal,
    "lt": np.less,
    "le": np.less_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "bitwise_and": np.logical_and,
    "bitwise_or": np.logical_or,
    "logical_and": np.logical_and,
    "logical_or": np.logical_or,
}


class Untranslatable(Exception):
    """The step does something that has no translation."""


class CompiledStep:
    """One step over signals and the memory of effects, as numpy calls.

    Args:
        step: works on the signals that it is given, and leaves in them what the next step needs.
        signals: after a reset of the law; shapes count, and the values.
        outputs: names of the signals that are wanted.
        live: arrays that stand for inputs and change by themselves, by the signal's name.
        filled: signals that the caller fills before every step; the others keep what the last step made of them.

    Attributes:
        inputs: arrays to be filled in before a call, by the signal's name; what the step does not read is missing.
        state: memory of the effects, by name, as far as the step reads it; it may be written between calls.
        outputs: results of the last call, by the signal's name.
        next_state: memory of the effects that the last call left, by name.
        factors: on the motor's parameters, as the last call left them, by the parameter's name.

    Raises:
        Untranslatable: if an operation is not known here.
    """

    def __init__(
        self,
        step: Callable[[Signals], None],
        signals: Signals,
        outputs: Sequence[str],
        live: Mapping[str, Array] | None = None,
        filled: Sequence[str] = (),
    ):
        values = {item.name: getattr(signals, item.name) for item in fields(signals)}
        given = {name: value.clone() for name, value in values.items() if isinstance(value, Tensor)}
        memory = {name: value.clone() for name, value in signals.state.items()}
        arrays = {name: value.numpy() for name, value in given.items()} | dict(live or {})
        names = list(given)
        recording = _record(step, given, memory)
        added = [name for name in recording.state if name not in memory]
        if added:
            memory |= {name: torch.zeros_like(recording.state[name]) for name in added}
            recording = _record(step, given, memory)
        examples = [*arrays.values(), *(value.numpy() for value in memory.values())]
        left = [*recording.state.values(), *recording.factors.values()]
        carried: list[str] = []
        while True:
            wanted = [*(recording.signals[name] for name in [*outputs, *carried]), *left]
            needed = _needed(recording.calls, wanted)
            used = [name for name in names if id(given[name]) in needed and name not in filled]
            if set(used) <= set(carried):
                break
            carried = used
        program = _Program(recording.calls, [*given.values(), *memory.values()], examples, wanted)
        self._calls, slots, results = program.calls, program.arguments, iter(program.results)
        self.inputs = {name: slots[at] for at, name in enumerate(names) if at in slots}
        self.state = {name: slots[at] for at, name in enumerate(memory, len(names)) if at in slots}
        if list(recording.state) != list(memory) or any(name in self.state for name in added):
            raise Untranslatable("an effect adds to the memory that it reads")
        self.outputs: dict[str, Array] = {name: next(results) for name in outputs}
        kept = {name: next(results) for name in carried}
        self.next_state: dict[str, Array] = {name: next(results) for name in memory}
        self.factors: dict[str, Array] = {name: next(results) for name in recording.factors}
        old = [*(self.inputs.get(name) for name in carried), *(self.state.get(name) for name in memory)]
        pairs = zip(old, [*kept.values(), *self.next_state.values()], strict=True)
        self._memory = [(before, after) for before, after in pairs if before is not None and before is not after]
        overwritten = [id(before) for before, _ in self._memory]
        if any(id(after) in overwritten for _, after in self._memory):
            raise Untranslatable("an effect that hands on the memory of another")

    def __len__(self) -> int:
        """Number of operations in a step."""
        return len(self._calls)

    def __call__(self) -> None:
        """One step: from `inputs` and `state` to `outputs` and the next `state`."""
        for call in self._calls:
            call()
        for old, new in self._memory:
            old[...] = new


class _Recorder(TorchDispatchMode):
    """Notes every operation that runs, with its tensors; far cheaper than a symbolic trace."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[_Call] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        with self:
            composed = func.decompose(*args, **(kwargs or {}))
        if composed is not NotImplemented:  # made of other operations, which were noted; so it is in inference mode
            return composed
        result = func(*args, **(kwargs or {}))
        self.calls.append(_Call(func, args, kwargs or {}, result))
        return result


@dataclass(frozen=True, eq=False)
class _Call:
    function: Any
    arguments: tuple[Any, ...]
    options: Mapping[str, Any]
    result: Any


@dataclass(frozen=True, eq=False)
class _Recording:
    """What ran in a step, and which tensors it left."""

    calls: Sequence[_Call]
    signals: Mapping[str, Tensor]
    state: Mapping[str, Tensor]
    factors: Mapping[str, Tensor]


def _record(
    step: Callable[[Signals], None], given: Mapping[str, Tensor], memory: Mapping[str, Tensor], phase: int = 0
) -> _Recording:
    """Run a step and note its operations."""
    seen: dict[str, Any] = {"phase": phase, **given}
    signals = Signals(**seen, state=dict(memory), factors={})
    try:
        with torch.no_grad(), _Recorder() as recorder:
            step(signals)
    except Exception as error:  # what an effect does in Python can fail in any way on copies of its tensors
        raise Untranslatable(str(error)) from error
    _check(recorder.calls, [*given.values(), *memory.values()])
    after = {name: getattr(signals, name) for name in given}
    return _Recording(recorder.calls, after, signals.state, signals.factors)


def _check(calls: Sequence[_Call], given: Sequence[Tensor]) -> None:
    """Refuse what is not the same operations for other numbers."""
    moving = {id(tensor) for tensor in given}
    for call in calls:
        if call.function._schema.is_mutable:
            raise Untranslatable(f"{call.function} changes a tensor in place")
        if any(id(read) in moving for read in _tensors((call.arguments, dict(call.options)))):
            if not all(isinstance(made, Tensor) for made in _parts(call.result)):
                raise Untranslatable(f"{call.function} lets numbers decide")
            moving.update(id(made) for made in _tensors(call.result))


def _needed(calls: Sequence[_Call], wanted: Sequence[Tensor]) -> set[int]:
    """Tensors that have to be known for those wanted, by id; none is gone while the calls are there."""
    needed = {id(tensor) for tensor in wanted}
    for call in reversed(calls):
        if any(id(made) in needed for made in _tensors(call.result)):
            needed.update(id(read) for read in _tensors((call.arguments, dict(call.options))))
    return needed


class _Program:
    """A recording as a list of numpy calls into fixed arrays; what depends on parameters alone is computed once.

    Args:
        calls: of the recording.
        given: tensors that change from step to step.
        arrays: that stand for these.
        wanted: tensors to be computed; what none of them needs is left out.
    """

    def __init__(self, calls: Sequence[_Call], given: Sequence[Tensor], arrays: Sequence[Array], wanted: list[Tensor]):
        self.calls: list[Callable[[], Any]] = []
        self.arguments: dict[int, Array] = {}
        self._known: dict[tuple[Any, ...], Any] = {}
        self._fixed: dict[int, Array] = {}
        needed = _needed(calls, wanted)
        self._values: dict[int, Any] = {}
        for at, (tensor, array) in enumerate(zip(given, arrays, strict=True)):
            self._values[id(tensor)] = array
            if id(tensor) in needed:
                self.arguments[at] = array
        for call in calls:
            if not any(id(tensor) in needed for tensor in _tensors(call.result)):
                continue
            made = self._call(call)
            results = call.result if isinstance(call.result, list | tuple) else [call.result]
            for tensor, array in zip(results, made if isinstance(made, list) else [made], strict=True):
                self._values[id(tensor)] = array
        self.results = [self._look_up(tensor) for tensor in wanted]

    def _call(self, call: _Call) -> Any:
        arguments = tuple(self._look_up(each) for each in call.arguments)
        name, _, overload = str(call.function).removeprefix("aten.").partition(".")
        if call.options.get("rounding_mode") is not None:
            raise Untranslatable(f"aten.{name} with {dict(call.options)}")
        if call.options.get("alpha", 1) != 1:
            arguments = (arguments[0], self._add(np.multiply, (arguments[1], call.options["alpha"])))
        if name == "_to_copy":
            return self._cast(arguments[0], call.result.numpy().dtype)
        key = (name, overload, *(_identity(each) for each in arguments))
        if key not in self._known:
            self._known[key] = self._emit(name, arguments)
        return self._known[key]

    def _cast(self, value: Array, kind: Any) -> Array:
        out = value.astype(kind)
        if self._is_fixed(value):
            return self._fix(out)
        self.calls.append(partial(np.copyto, out, value))
        return out

    def _look_up(self, argument: Any) -> Any:
        if isinstance(argument, Tensor):
            if id(argument) not in self._values:  # a parameter
                self._values[id(argument)] = self._fix(argument.detach().numpy())
            return self._values[id(argument)]
        return [self._look_up(each) for each in argument] if isinstance(argument, list | tuple) else argument

    def _emit(self, name: str, arguments: tuple[Any, ...]) -> Any:
        if name in _VIEWS:
            view = _VIEWS[name](*arguments)
            return self._fix(view) if self._is_fixed(arguments[0]) else view
        if name in ("zeros_like", "ones_like", "full_like", "scalar_tensor"):
            return self._fix(_constant(name, arguments))
        if name in _UNARY:
            return self._add(_UNARY[name], arguments[:1])
        if name in _BINARY:
            return self._add(_BINARY[name], arguments[:2])
        if name == "rsub":
            return self._add(np.subtract, (arguments[1], arguments[0]))
        if name == "addcmul":
            return self._add(np.add, (arguments[0], self._add(np.multiply, arguments[1:3])))
        if name in ("clamp", "clamp_min", "clamp_max"):
            return self._clamp(name, arguments)
        if name == "where":
            return self._where(*arguments)
        if name == "stack":
            return self._stack(*arguments)
        if name == "sum":
            return self._sum(*arguments)
        if name == "index_select" and arguments[2].size == 1:
            return self._add(_pick, (arguments[0], arguments[2], arguments[1]))
        raise Untranslatable(f"aten.{name}")

    def _clamp(self, name: str, arguments: tuple[Any, ...]) -> Any:
        value, low, high = arguments[0], None, None
        if name == "clamp_max":
            high = arguments[1]
        else:
            low = arguments[1]
            high = arguments[2] if len(arguments) > 2 else None
        if low is not None:
            value = self._add(np.maximum, (value, low))
        return value if high is None else self._add(np.minimum, (value, high))

    def _stack(self, parts: list[Array], axis: int = 0) -> Array:
        out = np.stack(parts, axis)
        if self._is_fixed(parts):
            return self._fix(out)
        self.calls += [partial(np.copyto, _select(out, axis, at), part) for at, part in enumerate(parts)]
        return out

    def _sum(self, value: Array, axes: Sequence[int] | None = None, keep: bool = False) -> Any:
        return self._add(partial(np.sum, keepdims=keep), (value, None if axes is None else tuple(axes)))

    def _where(self, condition: Array, then: Any, otherwise: Any) -> Any:
        if all(self._is_fixed(each) for each in (condition, then, otherwise)):
            return self._fix(np.where(condition, then, otherwise))
        shape = np.broadcast_shapes(np.shape(condition), np.shape(then), np.shape(otherwise))
        kind = np.result_type(then, otherwise)
        # in the memory order of the others
        like = next(each for each in (then, otherwise, condition, np.empty(shape)) if np.shape(each) == shape)
        out = np.zeros_like(like, dtype=kind)
        self.calls += [partial(np.copyto, out, otherwise), partial(np.copyto, out, then, where=condition)]
        return out

    def _add(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        if not any(isinstance(each, np.ndarray | list) for each in arguments):
            return function(*arguments)
        out = function(*arguments)
        if not isinstance(out, np.ndarray):
            return out  # of numbers without an axis, which only constants are
        if all(self._is_fixed(each) for each in arguments):
            return self._fix(out)
        self.calls.append(partial(function, *arguments, out=out))
        return out

    def _fix(self, value: Any) -> Any:
        """Note that arrays hold the same numbers in every step."""
        for each in value if isinstance(value, list) else [value]:
            if isinstance(each, np.ndarray):
                self._fixed[id(each)] = each
        return value

    def _is_fixed(self, argument: Any) -> bool:
        if isinstance(argument, list):
            return all(self._is_fixed(each) for each in argument)
        return not isinstance(argument, np.ndarray) or id(argument) in self._fixed


def _parts(value: Any) -> Iterator[Any]:
    """What a nest of lists holds."""
    for each in value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else [value]:
        if isinstance(each, list | tuple | dict):
            yield from _parts(each)
        else:
            yield each


def _tensors(value: Any) -> Iterator[Tensor]:
    return (each for each in _parts(value) if isinstance(each, Tensor))


def _identity(argument: Any) -> Any:
    if isinstance(argument, list):
        return tuple(_identity(each) for each in argument)
    return id(argument) if isinstance(argument, np.ndarray) else argument


def _select(value: Array, axis: int, index: int) -> Array:
    return value[(slice(None),) * (axis % value.ndim) + (index,)]


def _slice(value: Array, axis: int = 0, start: int | None = None, end: int | None = None, step: int = 1) -> Array:
    return value[(slice(None),) * (axis % value.ndim) + (slice(start, end, step),)]


def _pick(value: Array, index: Array, axis: int, out: Array | None = None) -> Array:
    """The entry at an index ``[1]``, in the memory order of the whole."""
    at = int(index[0])
    entry = _slice(value, axis, at, at + 1)
    if out is None:
        return entry.copy(order="K")
    np.copyto(out, entry)
    return out


def _unbind(value: Array, axis: int = 0) -> list[Array]:
    return [_select(value, axis, index) for index in range(value.shape[axis])]


_VIEWS: dict[str, Callable[..., Any]] = {
    "alias": lambda value: value,
    "clone": lambda value, **_: value,
    "detach": lambda value: value,
    "lift_fresh_copy": lambda value: value,
    "select": _select,
    "slice": _slice,
    "unbind": _unbind,
    "expand": lambda value, shape, **_: np.broadcast_to(
        value, [have if want == -1 else want for want, have in zip(shape, value.shape, strict=True)]
    ),
    "unsqueeze": np.expand_dims,
    "transpose": np.swapaxes,
}
"""Operations that look at the same numbers in another way; the view is made once and stays true."""


def _constant(name: str, arguments: tuple[Any, ...]) -> Any:
    if name == "scalar_tensor":
        return arguments[0]
    value = {"zeros_like": 0.0, "ones_like": 1.0}.get(name)
    return np.full_like(arguments[0], arguments[1] if value is None else value)
