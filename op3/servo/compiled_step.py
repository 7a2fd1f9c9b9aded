"""A step of the servo law, translated from torch to numpy.

One robot is twenty numbers, a few hundred pendulums are a few hundred: torch spends its time on calls, not on numbers.
So the operations of one step are noted, and are run by numpy into arrays that are reused, which takes a fraction of the
time. The law itself is written once, in torch; what cannot be translated is run by torch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from op3.servo.block_run import Array, BlockRun
from op3.servo.effect import Signals
from op3.servo.fused import fuse, pick
from op3.servo.recording import Call, Recording, Untranslatable, record

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


class CompiledStep:
    """One step over signals and the memory of effects, as numpy calls.

    Args:
        step: works on the signals that it is given, and leaves in them what the next step needs.
        signals: after a reset of the law; shapes count, and the values.
        outputs: names of the signals that are wanted.
        live: arrays that stand for inputs and change by themselves, by the signal's name.
        filled: signals that the caller fills before every step; the others keep what the last step made of them.
        parameters: tensors of the step, by any key, that `renew` may put others in place of.

    Attributes:
        inputs: arrays to be filled in before a call, by the signal's name; what the step does not read is missing.
        state: memory of the effects, by name, as far as the step reads it; it may be written between calls.
        outputs: results of the last call, by the signal's name. The next call overwrites them.
        next_state: memory of the effects that the last call left, by name.
        factors: on the motor's parameters, as the last call left them, by the parameter's name.

    Raises:
        Untranslatable: if an operation is not known here, or if numpy finds other numbers than torch.
    """

    def __init__(
        self,
        step: Callable[[Signals], None],
        signals: Signals,
        outputs: Sequence[str],
        live: Mapping[str, Array] | None = None,
        filled: Sequence[str] = (),
        parameters: Mapping[Any, Tensor] | None = None,
    ):
        given = _inputs(signals, live or {})
        memory = {name: _in_order(value, signals.position) for name, value in signals.state.items()}
        recording = record(step, given, memory)
        added = [name for name in recording.state if name not in memory]
        if added:  # the first step made room for them
            memory |= {name: torch.zeros_like(recording.state[name]) for name in added}
            recording = record(step, given, memory)
        left = [*recording.state.values(), *recording.factors.values()]
        carried: list[str] = []
        while True:
            wanted = [*(recording.signals[name] for name in [*outputs, *carried]), *left]
            needed = recording.needed(wanted)
            read = [name for name, value in given.items() if id(value) in needed and name not in filled]
            if set(read) <= set(carried):
                break
            carried = read
        if list(recording.state) != list(memory) or any(id(memory[name]) in needed for name in added):
            raise Untranslatable("an effect adds to the memory that it reads")
        arrays = {name: value.numpy() for name, value in given.items()} | dict(live or {})
        places = {id(value): arrays[name] for name, value in given.items()}
        places |= {id(value): value.numpy() for value in memory.values()}
        own = [*(None for _ in outputs), *(given[name] for name in carried), *memory.values()]
        own += [None for _ in recording.factors]
        try:
            with np.errstate(all="ignore"):
                program = _Program(recording, needed, places, wanted, own, renewable=parameters is not None)
        except Untranslatable:
            raise
        except Exception as error:  # an operation with arguments of a kind that is not known here
            raise Untranslatable(str(error)) from error
        self._calls, results = program.calls, iter(program.results)
        self.inputs = {name: arrays[name] for name, value in given.items() if id(value) in needed}
        self.state = {name: places[id(value)] for name, value in memory.items() if id(value) in needed}
        self.outputs: dict[str, Array] = {name: next(results) for name in outputs}
        kept = {name: next(results) for name in carried}
        self.next_state: dict[str, Array] = {name: next(results) for name in memory}
        self.factors: dict[str, Array] = {name: next(results) for name in recording.factors}
        renewed = [(self.inputs[name], kept[name]) for name in carried]
        renewed += [(before, self.next_state[name]) for name, before in self.state.items()]
        self._renewed = [(before, after) for before, after in renewed if before is not after]
        changing = [*self.inputs.values(), *self.state.values()]
        self._runs: Sequence[Callable[[], Any]] = fuse(
            self._calls, signals.position.detach().numpy(), program.results, changing
        )
        self._renewal = None
        if parameters is not None:
            calls_of_parameters = recording.of_parameters(needed)
            if calls_of_parameters is not None:
                self._renewal = _Renewal(calls_of_parameters, parameters, program.parameters)

    def renew(self, parameters: Mapping[Any, Tensor]) -> bool:
        """Put other parameters in place of those given; what the step remembers is to be filled in by the caller.

        Returns:
            Whether that could be done. If not, the step is of no use any more.
        """
        if self._renewal is None or not self._renewal(parameters):
            return False
        return all(run.renew() for run in self._runs if isinstance(run, BlockRun))

    def __len__(self) -> int:
        """Number of operations in a step."""
        return len(self._calls)

    def __call__(self) -> None:
        """One step: from `inputs` and `state` to `outputs` and the next `state`."""
        self._carry_out(self._runs)

    def call_by_call(self) -> None:
        """The same step, every operation a call of numpy: the numbers are the same, and it takes longer."""
        self._carry_out(self._calls)

    def _carry_out(self, calls: Sequence[Callable[[], Any]]) -> None:
        with np.errstate(all="ignore"):  # simulations that diverge are somebody else's to find
            for call in calls:
                call()
        for before, after in self._renewed:
            before[...] = after


class _Renewal:
    """Parameters of a step, and what it made of them before it ran for the first time.

    Args:
        calls: on parameters alone.
        parameters: that may be others, by key.
        known: by the id of a tensor, the tensor and what the step holds of it.
    """

    def __init__(
        self, calls: Sequence[Call], parameters: Mapping[Any, Tensor], known: Mapping[int, tuple[Tensor, Any]]
    ):
        self._calls, self._parameters, self._known = calls, dict(parameters), dict(known)

    def __call__(self, parameters: Mapping[Any, Tensor]) -> bool:
        """Write others into the arrays of the step; False if they are of another kind."""
        if parameters.keys() != self._parameters.keys():
            return False
        now: dict[int, Tensor] = {}
        for key, before in self._parameters.items():
            value = parameters[key].detach()
            if value.shape != before.shape or value.dtype != before.dtype:
                return False
            if not torch.equal(now.setdefault(id(before), value), value):
                return False  # what was one tensor are two
        with torch.no_grad():
            for call in self._calls:
                made = call.function(*_put(call.arguments, now), **_put(call.options, now))
                several = [made] if isinstance(made, Tensor) else list(made)
                now |= {id(before): value for before, value in zip(call.results, several, strict=True)}
        for place, (before, held) in self._known.items():
            if place not in now:
                continue
            value = now[place]
            if not isinstance(held, np.ndarray):
                if value.item() != held:
                    return False
                continue
            if value.shape != before.shape or value.dtype != before.dtype:
                return False
            np.copyto(held, value.numpy())
        return True


def _put(nest: Any, now: Mapping[int, Tensor]) -> Any:
    """A nest of arguments with other tensors in it."""
    if isinstance(nest, Tensor):
        return now.get(id(nest), nest)
    if isinstance(nest, Mapping):
        return {name: _put(each, now) for name, each in nest.items()}
    return type(nest)(_put(each, now) for each in nest) if isinstance(nest, list | tuple) else nest


def _inputs(signals: Signals, live: Mapping[str, Array]) -> dict[str, Tensor]:
    """Copies of all signals that are tensors, with the numbers that live arrays have now."""
    values = {item.name: getattr(signals, item.name) for item in fields(signals)}
    tensors = {name: value for name, value in values.items() if isinstance(value, Tensor)}
    given = {name: _in_order(value, signals.position) for name, value in tensors.items()}
    return given | {name: torch.from_numpy(np.array(array)) for name, array in live.items()}


def _in_order(value: Tensor, like: Tensor) -> Tensor:
    """A copy that lies in memory as another tensor ``[sim, joint]`` does: numpy is slow where orders differ."""
    value = value.detach()
    if value.shape[-2:] != like.shape:
        return value.clone()
    if like.stride(0) >= like.stride(1):
        return value.clone(memory_format=torch.contiguous_format)
    return value.transpose(-1, -2).clone(memory_format=torch.contiguous_format).transpose(-1, -2)


class _Program:
    """A recording as a list of numpy calls into fixed arrays; what depends on parameters alone was computed by torch.

    Args:
        recording: of a step.
        needed: ids of the tensors that have to be known; the rest is left out.
        places: arrays for what changes from step to step, by the id of the tensor.
        wanted: tensors to be computed.
        own: for each of these, the tensor whose array takes it over after the step, if one does.
        renewable: whether parameters lie in arrays of the program's own.

    Attributes:
        calls: of one step.
        parameters: what was read of tensors that do not change, by id.
        results: arrays of what is wanted. None shares memory with what changes before it is read.
    """

    def __init__(
        self,
        recording: Recording,
        needed: set[int],
        places: Mapping[int, Array],
        wanted: Sequence[Tensor],
        own: Sequence[Tensor | None],
        renewable: bool = False,
    ):
        self.calls: list[Callable[[], Any]] = []
        self.parameters: dict[int, tuple[Tensor, Any]] = {}
        self._renewable = renewable
        self._known: dict[tuple[Any, ...], Any] = {}
        self._values: dict[int, Any] = dict(places)
        for call in recording.calls:
            if any(id(made) in needed and id(made) in recording.moving for made in call.results):
                made = self._call(call)
                for tensor, array in zip(call.results, made if isinstance(made, list) else [made], strict=True):
                    self._values[id(tensor)] = array
        changing = [array for key, array in places.items() if key in needed]
        self.results = []
        for tensor, taker in zip(wanted, own, strict=True):
            result = np.asarray(self._look_up(tensor))
            stays = taker is not None and result is places[id(taker)]
            if not stays and any(np.may_share_memory(result, array) for array in changing):
                result = self._copied(result)
            _compare(result, tensor.numpy())
            self.results.append(result)

    def _copied(self, value: Array) -> Array:
        copy = value.copy(order="K")
        self.calls.append(partial(np.copyto, copy, value))
        return copy

    def _call(self, call: Call) -> Any:
        arguments = [self._look_up(each) for each in call.arguments]
        name, _, overload = str(call.function).removeprefix("aten.").partition(".")
        unknown = {option: value for option, value in call.options.items() if option not in IGNORED}
        alpha = unknown.pop("alpha", 1)
        if unknown:
            raise Untranslatable(f"aten.{name} with {unknown}")
        if alpha != 1:
            scaled = 0 if name == "rsub" else 1
            arguments[scaled] = self._add(np.multiply, (arguments[scaled], alpha))
        if name == "_to_copy":
            return self._cast(arguments[0], call.result.numpy().dtype)
        if name.startswith("bitwise") and call.result.dtype != torch.bool:
            raise Untranslatable(f"aten.{name} of whole numbers")
        if name in CONSTANT:
            return call.result.numpy()
        key = (name, overload, *(_identity(each) for each in arguments))
        if key not in self._known:
            self._known[key] = self._emit(name, tuple(arguments))
        return self._known[key]

    def _look_up(self, argument: Any) -> Any:
        if isinstance(argument, Tensor):
            if id(argument) not in self._values:  # parameters, and what was made of them
                own = argument.detach().clone() if self._renewable else argument.detach()
                fixed = own.numpy()
                self._values[id(argument)] = fixed.item() if fixed.ndim == 0 else fixed
                if self._renewable:
                    self.parameters[id(argument)] = argument, self._values[id(argument)]
            return self._values[id(argument)]
        return [self._look_up(each) for each in argument] if isinstance(argument, list | tuple) else argument

    def _emit(self, name: str, arguments: tuple[Any, ...]) -> Any:
        if name in _VIEWS:
            return _VIEWS[name](*arguments)
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
            return self._add(pick, (arguments[0], arguments[2], arguments[1]))
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
        # one behind the other, each in its own memory order
        order = np.argsort([-abs(step) for step in parts[0].strides], kind="stable")
        out = np.stack([part.transpose(order) for part in parts]).transpose(0, *(1 + np.argsort(order)))
        out = np.moveaxis(out, 0, axis)
        self.calls += [partial(np.copyto, _select(out, axis, at), part) for at, part in enumerate(parts)]
        return out

    def _sum(self, value: Array, axes: Sequence[int] | None = None, keep: bool = False) -> Any:
        return self._add(partial(np.sum, keepdims=keep), (value, tuple(axes) if axes else None))

    def _cast(self, value: Array, kind: Any) -> Array:
        out = value.astype(kind)
        self.calls.append(partial(np.copyto, out, value, casting="unsafe"))
        return out

    def _where(self, condition: Any, then: Any, otherwise: Any) -> Any:
        shape = np.broadcast_shapes(np.shape(condition), np.shape(then), np.shape(otherwise))
        # in the memory order of the others
        like = next(each for each in (then, otherwise, condition, np.empty(shape)) if np.shape(each) == shape)
        out = np.empty_like(like, dtype=np.result_type(then, otherwise))
        for call in (partial(np.copyto, out, otherwise), partial(np.copyto, out, then, where=condition)):
            call()
            self.calls.append(call)
        return out

    def _add(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Array:
        out = np.asarray(function(*arguments))  # a number without an axis too is computed anew
        self.calls.append(partial(function, *arguments, out=out))
        return out


def _compare(found: Array, expected: Array) -> None:
    """Refuse an array that is not, to rounding at its own size, what torch made of the same numbers."""
    if found.dtype == expected.dtype and np.array_equal(found, expected):
        return
    size = 1.0 + float(np.abs(expected, where=np.isfinite(expected), out=np.zeros(expected.shape)).max(initial=0.0))
    rounding = np.sqrt(np.finfo(expected.dtype).eps) if expected.dtype.kind == "f" else 0.0
    if found.dtype != expected.dtype or not np.allclose(found, expected, rtol=0, atol=rounding * size, equal_nan=True):
        raise Untranslatable("numpy finds other numbers than torch")


def _identity(argument: Any) -> Any:
    if isinstance(argument, list):
        return tuple(_identity(each) for each in argument)
    return id(argument) if isinstance(argument, np.ndarray) else argument


def _select(value: Array, axis: int, index: int) -> Array:
    return value[(*(slice(None),) * (axis % value.ndim), index, ...)]


def _slice(value: Array, axis: int = 0, start: int | None = None, end: int | None = None, step: int = 1) -> Array:
    return value[(*(slice(None),) * (axis % value.ndim), slice(start, end, step))]


def _unbind(value: Array, axis: int = 0) -> list[Array]:
    return [_select(value, axis, index) for index in range(value.shape[axis])]


def _expand(value: Array, shape: Sequence[int], **_: Any) -> Array:
    known = (1,) * (len(shape) - value.ndim) + value.shape
    return np.broadcast_to(value, [have if want == -1 else want for want, have in zip(shape, known, strict=True)])


_VIEWS: dict[str, Callable[..., Any]] = {
    "alias": lambda value: value,
    "clone": lambda value: value,
    "detach": lambda value: value,
    "lift_fresh_copy": lambda value: value,
    "select": _select,
    "slice": _slice,
    "unbind": _unbind,
    "expand": _expand,
    "unsqueeze": np.expand_dims,
    "transpose": np.swapaxes,
}
"""Operations that look at the same numbers in another way; the view is made once and stays true within a step."""

CONSTANT = ("zeros_like", "ones_like", "full_like")
"""Operations that read of a tensor its shape alone."""

IGNORED = ("dtype", "layout", "device", "pin_memory", "memory_format", "non_blocking", "implicit")
"""Options by which the result's numbers do not change; its kind is that of what torch made."""
