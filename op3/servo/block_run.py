"""Elementary operations that are carried out for one block of robots after another."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from op3.servo.interpreter import (
    ABSOLUTE,
    ADD,
    AND,
    DIVIDE,
    EQUAL,
    GREATER,
    GREATER_EQUAL,
    LESS,
    LESS_EQUAL,
    LOAD,
    LOAD_TRUTH,
    MAXIMUM,
    MINIMUM,
    MULTIPLY,
    NEGATIVE,
    NOT,
    NOT_EQUAL,
    OR,
    SIGN,
    SQRT,
    STORE,
    STORE_TRUTH,
    SUBTRACT,
    WHERE,
    interpret,
)

Array = NDArray[Any]

OPERATIONS: dict[Any, int] = {
    np.add: ADD,
    np.subtract: SUBTRACT,
    np.multiply: MULTIPLY,
    np.divide: DIVIDE,
    np.minimum: MINIMUM,
    np.maximum: MAXIMUM,
    np.negative: NEGATIVE,
    np.absolute: ABSOLUTE,
    np.sign: SIGN,
    np.sqrt: SQRT,
    np.greater: GREATER,
    np.greater_equal: GREATER_EQUAL,
    np.less: LESS,
    np.less_equal: LESS_EQUAL,
    np.equal: EQUAL,
    np.not_equal: NOT_EQUAL,
    np.logical_and: AND,
    np.logical_or: OR,
    np.logical_not: NOT,
}
"""Elementwise operations that the interpreter knows."""

UNARY = (np.negative, np.absolute, np.sign, np.sqrt, np.logical_not)


@dataclass(frozen=True, eq=False)
class Pick:
    """Which of several entries is meant.

    Attributes:
        index: array that holds its number.
        apart: bytes from entry to entry.
        count: how many there are.
    """

    index: Array
    apart: int
    count: int


class Cell(NamedTuple):
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
    picked: Pick | None = None


class Step(NamedTuple):
    """One elementary operation: a cell from cells and numbers, where a cell's condition holds."""

    operation: int
    out: Cell
    operands: tuple[Cell | float, ...]


class BlockRun:
    """Operations that are carried out block by block.

    Args:
        steps: in their order.
        private: roots of intermediate results, which get registers in place of their own memory.
        shape: number of robots and of joints.
        kind: of the numbers.
        size: robots in a block.
        compact: parameters with one number per block and joint, ``[joint, block]``.
        sources: the arrays that these were read from, spread to all robots and joints.
        alive: whatever owns the memory.
    """

    def __init__(
        self,
        steps: Sequence[Step],
        private: set[int],
        shape: tuple[int, ...],
        kind: np.dtype[Any],
        size: int,
        compact: Mapping[Cell, Array],
        sources: Mapping[Cell, Array],
        alive: Sequence[Any],
    ):
        self.shape, self.kind, self.size = shape, kind, size
        self._alive, self._compact, self._sources = alive, compact, sources
        self._private = private
        self._places: list[tuple[int, int, int, int, int]] = []  # register or -1, address, joint, robot, block
        self._numbers: dict[Any, int] = {}
        self._picks: dict[Pick, tuple[list[int], list[int]]] = {}
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
            self._write(step.operation, step.out, operands, code, borrowed)
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

    def _memory(self, cell: Cell) -> int:
        if cell.picked is None:
            return self._place(-1, cell.address, cell.joint, cell.robot, cell.robot * self.size)
        number = len(self._places)
        self._places.append((-1, cell.address, cell.joint, cell.robot, cell.robot * self.size))
        places, bases = self._picks.setdefault(cell.picked, ([], []))
        places.append(number)
        bases.append(cell.address)
        return number

    def _read(self, operand: Cell | float, code: list[tuple[int, int, int, int]], borrowed: list[int]) -> int:
        if not isinstance(operand, Cell):
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
        code.append((LOAD if operand.kind == self.kind else LOAD_TRUTH, to, place, to))
        return to

    def _parameter(self, cell: Cell, code: list[tuple[int, int, int, int]]) -> int:
        """A register with the number of a block, filled where it is first needed."""
        if cell not in self._held:
            self._held[cell] = self._register()
            numbers = self._compact[cell]
            place = self._place(-1, numbers.ctypes.data, numbers.strides[0], 0, numbers.itemsize)
            to = self._place(self._held[cell])
            code.append((LOAD if cell.kind == self.kind else LOAD_TRUTH, to, place, to))
        return self._place(self._held[cell])

    def _write(
        self,
        operation: int,
        out: Cell,
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
            code.append((LOAD if out.kind == self.kind else LOAD_TRUTH, to, place, to))
        code.append((operation, to, first, second))
        code.append((STORE if out.kind == self.kind else STORE_TRUTH, place, to, to))

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

    def renew(self) -> bool:
        """Read parameters with one number per block and joint anew; False if a block has several now."""
        for cell, numbers in self._compact.items():
            value = self._sources[cell]
            blocks = value[:: self.size].T
            if not np.array_equal(np.repeat(blocks, self.size, 1)[:, : len(value)], value.T):
                return False
            numbers[...] = blocks
        return True

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
    return isinstance(operand, Cell)
