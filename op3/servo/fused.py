"""Runs of numpy calls, carried out side by side for a few hundred robots at a time.

A step of the servo law for thousands of robots is some two hundred passes over arrays that do not fit into the cache.
Here the robots are taken in blocks: all operations of a step for one block, whose intermediate results stay in the
cache, then the next block. One small interpreter of elementary operations, compiled once and kept on disk, does that
for any law; operations that it does not know remain calls of numpy between two runs. The results are those of numpy,
bit by bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from op3.servo.block_run import OPERATIONS, Array, BlockRun, Cell, Pick, Step
from op3.servo.interpreter import COPY, SUM, SUM_ALONG, WHERE

BLOCK = 256
"""Robots in a block: a row of registers is a kilobyte or two."""

LONGEST_SUM = 128
"""Joints that are summed in numpy's order."""

FEWEST = 4
"""Operations that are worth a run."""

SHORTEST_RUN = 32
"""Neighbouring robots with the same parameters from which parameters are read once for all of them."""


def fuse(
    calls: Sequence[Callable[[], Any]],
    like: Array,
    kept: Sequence[Array],
    changing: Sequence[Array],
) -> list[Callable[[], Any]]:
    """The same calls, in runs where that is possible.

    Args:
        calls: partials of numpy's functions on fixed arrays, each with the array that it fills as `out`, or of
            `numpy.copyto`; they have run before.
        like: array ``[robot, joint]``, of the kind that most are.
        kept: arrays that are read when all calls are done, and must hold what numpy would have left.
        changing: arrays that somebody fills between calls; what no call fills either has its numbers for ever.
    """
    plan = _Plan(calls, like, kept, changing)
    result: list[Callable[[], Any]] = []
    for fusable, begin, end in plan.runs():
        if fusable and end - begin >= FEWEST:
            result.append(plan.run(begin, end))
        else:
            result += calls[begin:end]
    return result


class _Plan:
    """Which calls can run in blocks, and what they touch."""

    def __init__(
        self,
        calls: Sequence[Callable[[], Any]],
        like: Array,
        kept: Sequence[Array],
        changing: Sequence[Array],
    ):
        self.calls, self.whole, self.float = calls, like.shape, like.dtype
        # what lies one behind the other is run over: robots, or a robot's joints
        together = like.strides[1] == like.itemsize and like.shape[1] > 1
        self.turned = together and (like.strides[0] > like.itemsize or len(like) == 1)
        self.shape = like.shape[::-1] if self.turned else like.shape
        self.alive: list[Any] = []  # whose memory is used
        self.values: dict[Cell, Array] = {}
        self.cells: dict[int, Cell | None] = {}
        self.steps = self._within_blocks([self._elementary(call) for call in calls])
        self.kept = {_root(array) for array in kept}
        self.used: dict[int, list[tuple[int, tuple[int, int, int]]]] = {}
        for number, (call, steps) in enumerate(zip(calls, self.steps, strict=True)):
            for root, cell in self._touched(call, steps):
                self.used.setdefault(root, []).append((number, cell))
        filled = {_root(array) for array in (_result_of(call) for call in calls) if array is not None}
        self.fixed = set(self.used) - filled - {_root(array) for array in changing}
        self.sources: dict[Cell, Array] = {}
        self.size, self.compact = self._groups()

    def _within_blocks(self, steps: list[list[Step] | None]) -> list[list[Step] | None]:
        """Without calls by which a robot's numbers could depend on those of another block."""
        written: dict[int, set[int]] = {}
        for step in (one for some in steps for one in some or ()):
            written.setdefault(step.out.root, set()).add(step.out.robot)

        def own(step: Step) -> bool:
            cells = [each for each in (step.out, *step.operands) if isinstance(each, Cell)]
            return all(written[cell.root] == {cell.robot} for cell in cells if cell.root in written)

        return [some if some is None or all(own(step) for step in some) else None for some in steps]

    def _groups(self) -> tuple[int, dict[Cell, Array]]:
        """Size of a block, and parameters with one number per block and joint, ``[joint, block]``.

        Robots that differ in their state alone are neighbours, so that parameters come in runs.
        """
        cells = {
            each for steps in self.steps for step in steps or () for each in step.operands if isinstance(each, Cell)
        }
        fixed = [cell for cell in cells if cell.root in self.fixed and cell.picked is None]
        whole = {cell: np.broadcast_to(self.values[cell], self.whole) for cell in fixed}
        whole = {cell: value.T if self.turned else value for cell, value in whole.items()}
        robots = self.shape[0]
        size, run = robots if self.turned else min(BLOCK, robots), robots
        for value in whole.values():
            changes = value[1:] != value[:-1]
            if value.dtype != np.bool_:
                changes |= np.signbit(value[1:]) != np.signbit(value[:-1])
            run = int(np.gcd.reduce(np.flatnonzero(changes.any(1)) + 1, initial=run))
        if run < robots:
            parts = -(-run // BLOCK)
            while run % parts:
                parts += 1
            if self.turned or run // parts < SHORTEST_RUN:
                return size, {}
            size = run // parts
        self.sources = whole
        return size, {cell: np.array(value[::size].T, order="C") for cell, value in whole.items()}

    def runs(self) -> Iterator[tuple[bool, int, int]]:
        """Neighbouring calls of one kind: whether they can run in blocks, the first, and the one after the last."""
        begin = 0
        for end in range(1, len(self.calls) + 1):
            here = self.steps[begin] is not None
            if end == len(self.calls) or (self.steps[end] is not None) != here:
                yield here, begin, end
                begin = end

    def run(self, begin: int, end: int) -> BlockRun:
        """Calls from one to another, all of which can run in blocks."""
        steps = [step for steps in self.steps[begin:end] for step in steps or ()]
        private = self._private(begin, end, steps)
        return BlockRun(steps, private, self.shape, self.float, self.size, self.compact, self.sources, self.alive)

    def _private(self, begin: int, end: int, steps: Sequence[Step]) -> set[int]:
        """Roots of arrays that nobody sees but these steps, and that these see in one way and fill before they read."""
        filled: dict[int, bool] = {}
        for step in steps:
            reads = [each for each in step.operands if isinstance(each, Cell)]
            reads += [step.out] if step.operation == WHERE else []
            for cell in reads:
                filled.setdefault(cell.root, False)
            filled.setdefault(step.out.root, True)
        private = set()
        for root, first in filled.items():
            inside = all(begin <= number < end for number, _ in self.used[root])
            alike = len({cell for _, cell in self.used[root]}) == 1
            if first and inside and alike and root not in self.kept:
                private.add(root)
        return private

    def _touched(self, call: Callable[[], Any], steps: list[Step] | None):
        """Roots of the arrays that a call touches, and where in them."""
        if steps is None:
            for array in _arrays(call):
                yield _root(array), (array.ctypes.data, -1, -1)
            return
        for step in steps:
            for cell in (step.out, *step.operands):
                if isinstance(cell, Cell):
                    yield cell.root, (cell.address, cell.robot, cell.joint)

    def _elementary(self, call: Callable[[], Any]) -> list[Step] | None:
        """A call as elementary operations; None if it is none of these."""
        assert isinstance(call, partial)
        function, arguments = call.func, list(call.args)
        if function is np.copyto:
            return self._copy(call)
        out = call.keywords.get("out")
        if out is None:
            return None
        if function in OPERATIONS and set(call.keywords) == {"out"}:
            layers = self._layers(out, arguments)
            if out.dtype == np.bool_:  # of two truths
                function = {np.add: np.logical_or, np.multiply: np.logical_and}.get(function, function)
            return self._steps(OPERATIONS[function], layers) if layers else None
        if function is np.sum:
            return self._sum(out, arguments[0], arguments[1], call.keywords.get("keepdims", False))
        if function is pick:
            return self._pick(out, *arguments)
        return None

    def _copy(self, call: partial[Any]) -> list[Step] | None:
        out, value = call.args
        where = call.keywords.get("where")
        if set(call.keywords) - {"where"} or not _floats(out, self.float):
            return None
        layers = self._layers(out, [value] if where is None else [value, where])
        return self._steps(COPY if where is None else WHERE, layers) if layers else None

    def _steps(self, operation: int, layers: list[list[Any]]) -> list[Step] | None:
        found = []
        for out, *operands in layers:
            place, cells = self._cell(out), [self._operand(each) for each in operands]
            if place is None or any(cell is None for cell in cells):
                return None
            steps = zip(
                (place.joint, place.robot) if self.turned else (place.robot, place.joint), out.shape, strict=True
            )
            if any(step == 0 and size > 1 for step, size in steps):
                return None  # a view in which several are one
            found.append(Step(operation, place, tuple(cell for cell in cells if cell is not None)))
        return found

    def _layers(self, out: Array, arguments: Sequence[Any]) -> list[list[Any]] | None:
        """Arrays with a leading axis, taken apart along it; None if they are of other shapes."""
        if out.shape == self.whole[::-1] and out.shape != self.whole:
            whole = [out, *arguments]
            if all(not isinstance(each, np.ndarray) or each.shape == out.shape for each in whole):
                return [[each.T if isinstance(each, np.ndarray) else each for each in whole]]
        if out.ndim == 2:
            return [[out, *arguments]]
        if out.ndim != 3 or out.shape[1:] != self.whole:
            return None
        spread = [np.broadcast_to(each, out.shape) if isinstance(each, np.ndarray) else each for each in arguments]
        return [
            [out[k], *(each[k] if isinstance(each, np.ndarray) else each for each in spread)] for k in range(len(out))
        ]

    def _sum(self, out: Array, value: Any, axes: Any, keepdims: bool = False) -> list[Step] | None:
        if not isinstance(value, np.ndarray) or not _floats(value, self.float) or not _floats(out, self.float):
            return None
        if value.shape == self.whole and axes in ((-1,), (1,)) and out.shape == (self.whole[0], 1):
            if not self.turned:
                return self._steps(SUM, [[out, value]])
            # numpy halves what is longer
            return self._steps(SUM_ALONG, [[out, value]]) if value.shape[1] <= LONGEST_SUM else None
        if value.ndim == 3 and value.shape[1:] == self.whole and axes == (0,) and out.shape == self.whole:
            if len(value) < 2:
                return None
            layers = [[out, value[0], value[1]], *([out, out, layer] for layer in value[2:])]
            return self._steps(OPERATIONS[np.add], layers)
        return None

    def _pick(self, out: Array, value: Any, index: Any, axis: int) -> list[Step] | None:
        if axis != 0 or not isinstance(index, np.ndarray) or index.dtype != np.int64 or not _floats(value, self.float):
            return None
        if value.ndim < 2 or value.shape[-2:] != self.whole or not _floats(out, self.float):
            return None
        pick = Pick(index, value.strides[0], len(value))
        value, out = value[0], out[0]
        if value.ndim > 3:
            return None
        found = []
        for from_, to in [(value, out)] if value.ndim == 2 else list(zip(value, out, strict=True)):
            place, cell = self._cell(to), self._cell(from_)
            if place is None or cell is None:
                return None
            found.append(Step(COPY, place, (cell._replace(picked=pick),)))
        return found

    def _operand(self, value: Any) -> Cell | float | None:
        if isinstance(value, np.ndarray):
            return self._cell(value)
        if isinstance(value, bool | int | float) or getattr(value, "dtype", None) == self.float:
            return float(value)
        return None

    def _cell(self, array: Array) -> Cell | None:
        """Where an array lies, spread to all robots and joints; None if it is of another kind."""
        if id(array) not in self.cells:
            self.alive.append(array)
            self.cells[id(array)] = self._new_cell(array)
        return self.cells[id(array)]

    def _new_cell(self, array: Array) -> Cell | None:
        if (array.dtype != self.float and array.dtype != np.bool_) or array.ndim > 2:
            return None
        height = width = 1
        robot = joint = 0
        if array.ndim == 2:
            (height, width), (robot, joint) = array.shape, array.strides
        elif array.ndim == 1:
            (width,), (joint,) = array.shape, array.strides
        if height not in (1, self.whole[0]) or width not in (1, self.whole[1]):
            return None
        robot, joint = robot if height > 1 else 0, joint if width > 1 else 0
        if self.turned:
            robot, joint = joint, robot
        cell = Cell(_root(array), array.__array_interface__["data"][0], robot, joint, array.dtype)
        self.values[cell] = array
        return cell


def pick(value: Array, index: Array, axis: int, out: Array | None = None) -> Array:
    """The entry at an index ``[1]``, in the memory order of the whole."""
    at = int(index[0])
    entry = value[(*(slice(None),) * (axis % value.ndim), slice(at, at + 1))]
    if out is None:
        return entry.copy(order="K")
    np.copyto(out, entry)
    return out


def _floats(value: Any, kind: np.dtype[Any]) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == kind


def _result_of(call: Any) -> Array | None:
    return call.args[0] if call.func is np.copyto else call.keywords.get("out")


def _arrays(call: Any) -> Iterator[Array]:
    for each in (*call.args, *call.keywords.values()):
        if isinstance(each, np.ndarray):
            yield each


def _root(array: Array) -> int:
    """The memory that an array is a view of."""
    owner: Any = array
    while isinstance(owner, np.ndarray) and isinstance(owner.base, np.ndarray):
        owner = owner.base
    return owner.__array_interface__["data"][0] if owner.base is not None else id(owner)
