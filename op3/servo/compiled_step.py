"""A step of the servo law, translated from torch to numpy.

One robot is twenty numbers, a few hundred pendulums are a few hundred: torch spends its time on calls, not on numbers.
So a step is traced once, and its operations are run by numpy into arrays that are reused, which takes a fraction of the
time. The law itself is written once, in torch; what cannot be translated is run by torch.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.fx import Graph, GraphModule, Node
from torch.fx.experimental.proxy_tensor import make_fx

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
        signals: after a reset of the law and, where it needs more memory, a first step; shapes count, and the values.
        outputs: names of the signals that are wanted.
        live: arrays that stand for inputs and change by themselves, by the signal's name.
        filled: signals that the caller fills before every step; the others keep what the last step made of them.

    Attributes:
        inputs: arrays to be filled in before a call, by the signal's name; what the step does not read is missing.
        state: memory of the effects, by name, as far as the step reads it; it may be written between calls.
        outputs: results of the last call, by the signal's name.
        next_state: memory of the effects that the last call left, by name.

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
        examples = [*arrays.values(), *(value.numpy() for value in memory.values())]
        names, carried = list(given), []
        while True:
            module = _trace(step, given, memory, [*outputs, *carried])
            self._program = _Program(module, examples)
            used = [name for at, name in enumerate(names) if at in self._program.arguments and name not in filled]
            if set(used) <= set(carried):
                break
            carried = used
        slots = self._program.arguments
        self.inputs = {name: slots[at] for at, name in enumerate(names) if at in slots}
        self.state = {name: slots[at] for at, name in enumerate(memory, len(names)) if at in slots}
        results = self._program.results
        self.outputs: dict[str, Array] = dict(zip(outputs, results, strict=False))
        self.next_state: dict[str, Array] = dict(zip(memory, results[len(results) - len(memory) :], strict=True))
        old = [*(self.inputs.get(name) for name in carried), *(self.state.get(name) for name in memory)]
        pairs = zip(old, results[len(outputs) :], strict=True)
        self._memory = [(before, after) for before, after in pairs if before is not None and before is not after]
        kept = [id(before) for before, _ in self._memory]
        if any(id(after) in kept for _, after in self._memory):
            raise Untranslatable("an effect that hands on the memory of another")

    def __call__(self) -> None:
        """One step: from `inputs` and `state` to `outputs` and the next `state`."""
        for call in self._program.calls:
            call()
        for old, new in self._memory:
            old[...] = new


def _trace(
    step: Callable[[Signals], None], given: Mapping[str, Tensor], memory: Mapping[str, Tensor], wanted: Sequence[str]
) -> GraphModule:
    """The operations of a step, from signals and memory to the signals wanted and the next memory."""

    def flat(values: dict[str, Tensor], state: dict[str, Tensor]) -> list[Tensor]:
        traced = Signals(**values, phase=0, state=dict(state), factors={})
        step(traced)
        if list(traced.state) != list(state):
            raise Untranslatable("an effect adds to the memory in its first step")
        return [*(getattr(traced, name) for name in wanted), *traced.state.values()]

    try:
        with torch.no_grad():
            return make_fx(flat)(dict(given), dict(memory))
    except Untranslatable:
        raise
    except Exception as error:  # an effect that decides by numbers in Python can fail in any way when it is traced
        raise Untranslatable(str(error)) from error


class _Program:
    """A traced graph as a list of numpy calls into fixed arrays; what depends on parameters alone is computed once."""

    def __init__(self, module: GraphModule, given: Sequence[Array]):
        graph: Graph = module.graph
        graph.eliminate_dead_code()
        self.calls: list[Callable[[], Any]] = []
        self.arguments: dict[int, Array] = {}
        self._known: dict[tuple[Any, ...], Any] = {}
        self._values: dict[Node, Any] = {}
        self._fixed: dict[int, Array] = {}
        arguments = 0
        for node in graph.nodes:
            if node.op == "placeholder":
                if node.users:
                    self.arguments[arguments] = self._values[node] = given[arguments]
                arguments += 1
            elif node.op == "get_attr":
                self._values[node] = self._fix(getattr(module, str(node.target)).detach().numpy())
            elif node.op == "call_function":
                self._values[node] = self._call(node)
            elif node.op == "output":
                flat: list[Node] = []
                torch.fx.node.map_arg(node.args[0], flat.append)
                self.results = [self._values[each] for each in flat]

    def _call(self, node: Node) -> Any:
        arguments = tuple(self._look_up(each) for each in node.args)
        if node.target is operator.getitem:
            return arguments[0][arguments[1]]  # of what `unbind` gave
        name, _, overload = str(node.target).removeprefix("aten.").partition(".")
        if node.kwargs.get("alpha", 1) != 1 or node.kwargs.get("rounding_mode") is not None:
            raise Untranslatable(f"aten.{name} with {dict(node.kwargs)}")
        key = (name, overload, *(_identity(each) for each in arguments))
        if key not in self._known:
            self._known[key] = self._emit(name, arguments)
        return self._known[key]

    def _look_up(self, argument: Any) -> Any:
        if isinstance(argument, Node):
            return self._values[argument]
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
            return self._add(np.stack, (arguments[0], arguments[1] if len(arguments) > 1 else 0))
        if name == "sum":
            return self._sum(*arguments)
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

    def _sum(self, value: Array, axes: Sequence[int] | None = None, keep: bool = False) -> Any:
        return self._add(partial(np.sum, keepdims=keep), (value, None if axes is None else tuple(axes)))

    def _where(self, condition: Array, then: Any, otherwise: Any) -> Any:
        shape = np.broadcast_shapes(np.shape(condition), np.shape(then), np.shape(otherwise))
        if all(self._is_fixed(each) for each in (condition, then, otherwise)):
            return self._fix(np.where(condition, then, otherwise))
        out = np.zeros(shape)
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


def _identity(argument: Any) -> Any:
    if isinstance(argument, list):
        return tuple(_identity(each) for each in argument)
    return id(argument) if isinstance(argument, np.ndarray) else argument


def _select(value: Array, axis: int, index: int) -> Array:
    return value[(slice(None),) * (axis % value.ndim) + (index,)]


def _unbind(value: Array, axis: int = 0) -> list[Array]:
    return [_select(value, axis, index) for index in range(value.shape[axis])]


_VIEWS: dict[str, Callable[..., Any]] = {
    "alias": lambda value: value,
    "clone": lambda value, **_: value,
    "detach": lambda value: value,
    "lift_fresh_copy": lambda value: value,
    "select": _select,
    "unbind": _unbind,
    "expand": lambda value, shape, **_: np.broadcast_to(
        value, [have if want == -1 else want for want, have in zip(shape, value.shape, strict=True)]
    ),
    "unsqueeze": np.expand_dims,
}
"""Operations that look at the same numbers in another way; the view is made once and stays true."""


def _constant(name: str, arguments: tuple[Any, ...]) -> Any:
    if name == "scalar_tensor":
        return arguments[0]
    value = {"zeros_like": 0.0, "ones_like": 1.0}.get(name)
    return np.full_like(arguments[0], arguments[1] if value is None else value, dtype=float)
