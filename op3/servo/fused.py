"""Runs of numpy calls, carried out side by side for a few hundred robots at a time.

A step of the servo law for thousands of robots is some two hundred passes over arrays that do not fit into the cache.
Here the robots are taken in blocks: all operations of a step for one block, whose intermediate results stay in the
cache, then the next block. One small interpreter of elementary operations, compiled once and kept on disk, does that
for any law; operations that it does not know remain calls of numpy between two runs. The results are those of numpy,
bit by bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from op3.servo.interpreter import interpret

Array = NDArray[Any]

BLOCK = 256
"""Robots in a block: a row of registers is a kilobyte or two."""

LONGEST_SUM = 128
"""Joints that are summed in numpy's order."""

FEWEST = 4
"""Operations that are worth a run."""

SHORTEST_RUN = 32
"""Neighbouring robots with the same parameters from which parameters are read once for all of them."""

OPERATIONS: dict[Any, int] = {
    np.add: 0,
    np.subtract: 1,
    np.multiply: 2,
    np.divide: 3,
    np.minimum: 4,
    np.maximum: 5,
    np.negative: 6,
    np.absolute: 7,
    np.sign: 8,
    np.sqrt: 9,
    np.greater: 10,
    np.greater_equal: 11,
    np.less: 12,
    np.less_equal: 13,
    np.equal: 14,
    np.not_equal: 15,
    np.logical_and: 16,
    np.logical_or: 17,
    np.logical_not: 18,
}
"""Elementwise operations that the interpreter knows."""

COPY, WHERE, PICK, SUM, SUM_ALONG = 19, 20, 22, 23, 21
"""The others: copy, copy where a condition holds, copy of a picked entry, and sums over rows and along them."""

UNARY = (np.negative, np.absolute, np.sign, np.sqrt, np.logical_not)


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


@dataclass(frozen=True, eq=False)
class _Pick:
    """Which of several entries is meant.

    Attributes:
        index: array that holds its number.
        apart: bytes from entry to entry.
        count: how many there are.
    """

    index: Array
    apart: int
    count: int


@dataclass(frozen=True)
class _Cell:
    """Where an operand ``[robot, joint]`` lies; robots that lie apart, and their joints together, change places.

    Attributes:
        root: id of the array that owns the memory.
        address: of the first number.
        robot: bytes to the next robot.
        joint: bytes to the next joint.
        kind: of the numbers.
        picked: tells which entry of several is meant; None for most.
    """

    root: int
    address: int
    robot: int
    joint: int
    kind: np.dtype[Any]
    picked: _Pick | None = None


@dataclass(frozen=True)
class _Step:
    """One elementary operation: a cell from cells and numbers, where a cell's condition holds."""

    operation: int
    out: _Cell
    operands: tuple[_Cell | float, ...]


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
        self.values: dict[_Cell, Array] = {}
        self.cells: dict[int, _Cell | None] = {}
        self.steps = self._within_blocks([self._elementary(call) for call in calls])
        self.kept = {_root(array) for array in kept}
        self.used: dict[int, list[tuple[int, tuple[int, int, int]]]] = {}
        for number, (call, steps) in enumerate(zip(calls, self.steps, strict=True)):
            for root, cell in self._touched(call, steps):
                self.used.setdefault(root, []).append((number, cell))
        filled = {_root(array) for array in (_result_of(call) for call in calls) if array is not None}
        self.fixed = set(self.used) - filled - {_root(array) for array in changing}
        self.size, self.compact = self._groups()

    def _within_blocks(self, steps: list[list[_Step] | None]) -> list[list[_Step] | None]:
        """Without calls by which a robot's numbers could depend on those of another block."""
        written: dict[int, set[int]] = {}
        for step in (one for some in steps for one in some or ()):
            written.setdefault(step.out.root, set()).add(step.out.robot)

        def own(step: _Step) -> bool:
            cells = [each for each in (step.out, *step.operands) if isinstance(each, _Cell)]
            return all(written[cell.root] == {cell.robot} for cell in cells if cell.root in written)

        return [some if some is None or all(own(step) for step in some) else None for some in steps]

    def _groups(self) -> tuple[int, dict[_Cell, Array]]:
        """Size of a block, and parameters with one number per block and joint, ``[joint, block]``.

        Robots that differ in their state alone are neighbours, so that parameters come in runs.
        """
        cells = {
            each for steps in self.steps for step in steps or () for each in step.operands if isinstance(each, _Cell)
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
        return size, {cell: np.ascontiguousarray(value[::size].T) for cell, value in whole.items()}

    def runs(self) -> Iterator[tuple[bool, int, int]]:
        """Neighbouring calls of one kind: whether they can run in blocks, the first, and the one after the last."""
        begin = 0
        for end in range(1, len(self.calls) + 1):
            here = self.steps[begin] is not None
            if end == len(self.calls) or (self.steps[end] is not None) != here:
                yield here, begin, end
                begin = end

    def run(self, begin: int, end: int) -> Run:
        """Calls from one to another, all of which can run in blocks."""
        steps = [step for steps in self.steps[begin:end] for step in steps or ()]
        private = self._private(begin, end, steps)
        return Run(steps, private, self)

    def _private(self, begin: int, end: int, steps: Sequence[_Step]) -> set[int]:
        """Roots of arrays that nobody sees but these steps, and that these see in one way and fill before they read."""
        filled: dict[int, bool] = {}
        for step in steps:
            reads = [each for each in step.operands if isinstance(each, _Cell)]
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

    def _touched(self, call: Callable[[], Any], steps: list[_Step] | None):
        """Roots of the arrays that a call touches, and where in them."""
        if steps is None:
            for array in _arrays(call):
                yield _root(array), (array.ctypes.data, -1, -1)
            return
        for step in steps:
            for cell in (step.out, *step.operands):
                if isinstance(cell, _Cell):
                    yield cell.root, (cell.address, cell.robot, cell.joint)

    def _elementary(self, call: Callable[[], Any]) -> list[_Step] | None:
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
        if getattr(function, "picks", False):
            return self._pick(out, *arguments)
        return None

    def _copy(self, call: partial[Any]) -> list[_Step] | None:
        out, value = call.args
        where = call.keywords.get("where")
        if set(call.keywords) - {"where"} or not _floats(out, self.float):
            return None
        layers = self._layers(out, [value] if where is None else [value, where])
        return self._steps(COPY if where is None else WHERE, layers) if layers else None

    def _steps(self, operation: int, layers: list[list[Any]]) -> list[_Step] | None:
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
            found.append(_Step(operation, place, tuple(cell for cell in cells if cell is not None)))
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

    def _sum(self, out: Array, value: Any, axes: Any, keepdims: bool = False) -> list[_Step] | None:
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

    def _pick(self, out: Array, value: Any, index: Any, axis: int) -> list[_Step] | None:
        if axis != 0 or not isinstance(index, np.ndarray) or index.dtype != np.int64 or not _floats(value, self.float):
            return None
        if value.ndim < 2 or value.shape[-2:] != self.whole or not _floats(out, self.float):
            return None
        pick = _Pick(index, value.strides[0], len(value))
        value, out = value[0], out[0]
        if value.ndim > 3:
            return None
        found = []
        for from_, to in [(value, out)] if value.ndim == 2 else list(zip(value, out, strict=True)):
            place, cell = self._cell(to), self._cell(from_)
            if place is None or cell is None:
                return None
            found.append(_Step(PICK, place, (replace(cell, picked=pick),)))
        return found

    def _operand(self, value: Any) -> _Cell | float | None:
        if isinstance(value, np.ndarray):
            return self._cell(value)
        if isinstance(value, bool | int | float) or getattr(value, "dtype", None) == self.float:
            return float(value)
        return None

    def _cell(self, array: Array) -> _Cell | None:
        """Where an array lies, spread to all robots and joints; None if it is of another kind."""
        if id(array) not in self.cells:
            self.alive.append(array)
            self.cells[id(array)] = self._new_cell(array)
        return self.cells[id(array)]

    def _new_cell(self, array: Array) -> _Cell | None:
        if (array.dtype != self.float and array.dtype != np.bool_) or array.ndim > 2:
            return None
        sizes, steps = (1,) * (2 - array.ndim) + array.shape, (0,) * (2 - array.ndim) + array.strides
        if any(size not in (1, whole) for size, whole in zip(sizes, self.whole, strict=True)):
            return None
        robot, joint = (step if size > 1 else 0 for size, step in zip(sizes, steps, strict=True))
        if self.turned:
            robot, joint = joint, robot
        cell = _Cell(_root(array), array.__array_interface__["data"][0], robot, joint, array.dtype)
        self.values[cell] = array
        return cell


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


class Run:
    """Operations that are carried out block by block.

    Args:
        steps: in their order.
        private: roots of intermediate results, which get registers in place of their own memory.
        plan: of all calls.
    """

    def __init__(self, steps: Sequence[_Step], private: set[int], plan: _Plan):
        self.shape, self.kind, self.size = plan.shape, plan.float, plan.size
        self._alive, self._compact = plan.alive, plan.compact
        self._private = private
        self._places: list[tuple[int, int, int, int, int]] = []  # register or -1, address, joint, robot, block
        self._numbers: dict[Any, int] = {}
        self._picks: dict[_Pick, tuple[list[int], list[int]]] = {}
        self._constants: dict[tuple[float, float], int] = {}
        self._free: list[int] = []
        self._registers = 0
        code: list[tuple[int, int, int, int]] = []
        last = {
            self._name(each): i for i, step in enumerate(steps) for each in (step.out, *step.operands) if _is_cell(each)
        }
        self._held: dict[Any, int] = {}
        for i, step in enumerate(steps):
            borrowed: list[int] = []
            operands = [self._read(each, code, borrowed) for each in step.operands]
            operation = COPY if step.operation == PICK else step.operation
            self._write(operation, step.out, operands, code, borrowed)
            for each in {self._name(each) for each in (step.out, *step.operands) if _is_cell(each)}:
                if last[each] == i and each in self._held:
                    borrowed.append(self._held.pop(each))
            self._free += borrowed
        self._finish(code)

    def _name(self, cell: Any) -> Any:
        """By what a register that holds a cell is known."""
        return cell if cell in self._compact else cell.root

    def _register(self) -> int:
        if self._free:
            return self._free.pop()
        self._registers += 1
        return self._registers - 1

    def _place(self, register: int, address: int = 0, joint: int = 0, robot: int = 0, block: int = 0) -> int:
        key = (register, address, joint, robot, block)
        if key not in self._numbers:
            self._numbers[key] = len(self._places)
            self._places.append(key)
        return self._numbers[key]

    def _memory(self, cell: _Cell) -> int:
        if cell.picked is None:
            return self._place(-1, cell.address, cell.joint, cell.robot, cell.robot * self.size)
        number = len(self._places)
        self._places.append((-1, cell.address, cell.joint, cell.robot, cell.robot * self.size))
        places, bases = self._picks.setdefault(cell.picked, ([], []))
        places.append(number)
        bases.append(cell.address)
        return number

    def _read(self, operand: _Cell | float, code: list[tuple[int, int, int, int]], borrowed: list[int]) -> int:
        if not isinstance(operand, _Cell):
            key = (operand, math.copysign(1.0, operand))  # zeros have signs
            if key not in self._constants:
                self._registers += 1
                self._constants[key] = self._registers - 1
            return self._place(self._constants[key])
        if operand.root in self._private:
            return self._place(self._held[operand.root])
        if operand in self._compact:
            return self._parameter(operand, code)
        place = self._memory(operand)
        if operand.robot == self.kind.itemsize and operand.kind == self.kind:
            return place
        register = self._register()
        borrowed.append(register)
        to = self._place(register)
        code.append((24 if operand.kind == self.kind else 25, to, place, to))
        return to

    def _parameter(self, cell: _Cell, code: list[tuple[int, int, int, int]]) -> int:
        """A register with the number of a block, filled where it is first needed."""
        if cell not in self._held:
            self._held[cell] = self._register()
            numbers = self._compact[cell]
            place = self._place(-1, numbers.ctypes.data, numbers.strides[0], 0, numbers.itemsize)
            to = self._place(self._held[cell])
            code.append((24 if cell.kind == self.kind else 25, to, place, to))
        return self._place(self._held[cell])

    def _write(
        self,
        operation: int,
        out: _Cell,
        operands: Sequence[int],
        code: list[tuple[int, int, int, int]],
        borrowed: list[int],
    ) -> None:
        first, second = operands[0], operands[-1]
        if out.root in self._private:
            if out.root not in self._held:
                self._held[out.root] = self._register()
            code.append((operation, self._place(self._held[out.root]), first, second))
            return
        place = self._memory(out)
        if out.robot == self.kind.itemsize and out.kind == self.kind:
            code.append((operation, place, first, second))
            return
        register = self._register()
        borrowed.append(register)
        to = self._place(register)
        if operation == WHERE:
            code.append((24 if out.kind == self.kind else 25, to, place, to))
        code.append((operation, to, first, second))
        code.append((26 if out.kind == self.kind else 27, place, to, to))

    def _finish(self, code: list[tuple[int, int, int, int]]) -> None:
        """Lay out the registers."""
        joints = self.shape[1]
        self._bank = np.empty((self._registers, joints, self.size), dtype=self.kind)
        for (value, _), register in self._constants.items():
            self._bank[register] = value
        row, item = self._bank.strides[1], self.kind.itemsize
        start, apart = self._bank.ctypes.data, self._bank.strides[0]
        table = [
            (start + register * apart, row, item, 0) if register >= 0 else (address, joint, robot, block)
            for register, address, joint, robot, block in self._places
        ]
        self._table = np.ascontiguousarray(np.array(table, dtype=np.int64).T)
        self._code = np.array(code, dtype=np.int64)
        self._picked = [(pick, np.array(places), np.array(bases)) for pick, (places, bases) in self._picks.items()]
        self._carry_out(0)  # so that the machine code is loaded before it is needed

    def __len__(self) -> int:
        """Number of operations."""
        return len(self._code)

    def __call__(self) -> None:
        """Carry them out."""
        address = self._table[0]
        for pick, places, bases in self._picked:
            number = int(pick.index[0])
            if not 0 <= number < pick.count:
                raise IndexError(f"entry {number} of {pick.count} is to be picked")
            address[places] = bases + number * pick.apart
        self._carry_out(self.shape[0])

    def __reduce__(self) -> Any:
        raise TypeError("a run holds addresses in memory: compile the step anew in place of copying it")

    def _carry_out(self, robots: int) -> None:
        address, joint, robot, block = self._table
        interpret(self._code, address, joint, robot, block, self._bank, robots, self.shape[1], self.size)


def _is_cell(operand: Any) -> bool:
    return isinstance(operand, _Cell)
