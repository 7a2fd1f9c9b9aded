"""The servo law of one robot, translated from torch to numpy.

One robot is twenty numbers: torch spends its time on calls, not on numbers. So the law is traced once, and its
operations are run by numpy into arrays that are reused, which takes a fraction of the time. The law itself stays where
it is, in `op3.servo`; what cannot be translated is run by torch.
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

from op3.servo import ServoLaw, Signals

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
    """The law does something that has no translation."""


class CompiledLaw:
    """A law and its memory in numpy, for simulations whose control period is one step.

    Args:
        law: with its parameters set.
        signals: after a reset of the law, the inputs filled in; their shapes count, and the memory they start with.
        outputs: names of the signals that are wanted.
        live: arrays that stand for inputs and change by themselves, by the signal's name.

    Attributes:
        inputs: arrays to be filled in before a call, by the signal's name; what the law does not read is missing.
        state: memory of the effects, by name, as far as the law reads it; it may be written between calls.
        outputs: results of the last call, by the signal's name.

    Raises:
        Untranslatable: if an operation is not known here.
    """

    def __init__(
        self, law: ServoLaw, signals: Signals, outputs: Sequence[str], live: Mapping[str, Array] | None = None
    ):
        names = [field.name for field in fields(signals) if field.name not in ("phase", "state")]
        given = {name: getattr(signals, name).clone() for name in names}
        memory = {name: value.clone() for name, value in signals.state.items()}

        def step(values: dict[str, Tensor], state: dict[str, Tensor]) -> tuple[list[Tensor], list[Tensor]]:
            traced = Signals(**values, phase=0, state=dict(state))
            law.tick(traced)
            law.step(traced)
            if list(traced.state) != list(state):
                raise Untranslatable("an effect adds to the memory in its first step")
            return [getattr(traced, name) for name in outputs], list(traced.state.values())

        with torch.no_grad():
            module = make_fx(step)(given, memory)
        arrays = {name: value.numpy() for name, value in given.items()} | dict(live or {})
        self._program = _Program(module, [*arrays.values(), *(value.numpy() for value in memory.values())])
        slots = self._program.arguments
        self.inputs = {name: slots[at] for at, name in enumerate(names) if at in slots}
        self.state = {name: slots[at] for at, name in enumerate(memory, len(names)) if at in slots}
        results = self._program.results
        self.outputs: dict[str, Array] = dict(zip(outputs, results, strict=False))
        written = zip(memory, results[len(outputs) :], strict=True)
        self._memory = [
            (self.state[name], result)
            for name, result in written
            if name in self.state and self.state[name] is not result
        ]
        held = [id(array) for array in self.state.values()]
        if any(id(new) in held for _, new in self._memory):
            raise Untranslatable("an effect that hands on the memory of another")

    def __call__(self) -> None:
        """One step: from `inputs` and `state` to `outputs` and the next `state`."""
        for call in self._program.calls:
            call()
        for old, new in self._memory:
            old[...] = new


class _Program:
    """A traced graph as a list of numpy calls into fixed arrays."""

    def __init__(self, module: GraphModule, given: Sequence[Array]):
        graph: Graph = module.graph
        graph.eliminate_dead_code()
        self.calls: list[Callable[[], Any]] = []
        self.arguments: dict[int, Array] = {}
        self._known: dict[tuple[Any, ...], Any] = {}
        self._values: dict[Node, Any] = {}
        arguments = 0
        for node in graph.nodes:
            if node.op == "placeholder":
                if node.users:
                    self.arguments[arguments] = self._values[node] = given[arguments]
                arguments += 1
            elif node.op == "get_attr":
                self._values[node] = getattr(module, str(node.target)).detach().numpy()
            elif node.op == "call_function":
                self._values[node] = self._call(node)
            elif node.op == "output":
                flat: list[Node] = []
                torch.fx.node.map_arg(node.args[0], flat.append)
                self.results = [self._values[each] for each in flat]

    def _call(self, node: Node) -> Any:
        if node.target is operator.getitem:
            raise Untranslatable("an operation with several results")
        name, _, overload = str(node.target).removeprefix("aten.").partition(".")
        arguments = tuple(self._values[each] if isinstance(each, Node) else each for each in node.args)
        key = (name, overload, *(id(each) if isinstance(each, np.ndarray) else each for each in arguments))
        if node.kwargs.get("alpha", 1) != 1 or node.kwargs.get("rounding_mode") is not None:
            raise Untranslatable(f"aten.{name} with {dict(node.kwargs)}")
        if key not in self._known:
            self._known[key] = self._emit(name, arguments)
        return self._known[key]

    def _emit(self, name: str, arguments: tuple[Any, ...]) -> Any:
        if name in ("clone", "detach", "alias", "lift_fresh_copy"):
            return arguments[0]
        if name in ("zeros_like", "ones_like", "full_like", "scalar_tensor"):
            return _constant(name, arguments)
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

    def _where(self, condition: Array, then: Any, otherwise: Any) -> Any:
        shape = np.broadcast_shapes(np.shape(condition), np.shape(then), np.shape(otherwise))
        out = np.zeros(shape)
        self.calls += [partial(np.copyto, out, otherwise), partial(np.copyto, out, then, where=condition)]
        return out

    def _add(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        if not any(isinstance(each, np.ndarray) for each in arguments):
            return function(*arguments)
        out = function(*arguments)
        self.calls.append(partial(function, *arguments, out=out))
        return out


def _constant(name: str, arguments: tuple[Any, ...]) -> Any:
    if name == "scalar_tensor":
        return arguments[0]
    value = {"zeros_like": 0.0, "ones_like": 1.0}.get(name)
    return np.full_like(arguments[0], arguments[1] if value is None else value, dtype=float)
