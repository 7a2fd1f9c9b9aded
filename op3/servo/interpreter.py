"""The loop behind `op3.servo.block_run`, compiled to machine code once and kept on disk."""

from typing import Any

import numba
import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic

from op3.servo.machine_code import machine_code


def _typed(context: Any, address: Any) -> Any:
    """A number as the address of memory."""

    def generate(_: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(address), generate


_pointer: Any = intrinsic(_typed)
_array: Any = numba.carray  # type: ignore[reportPrivateImportUsage]


@numba.njit(inline="always")
def _row(address, count, kind):
    """Numbers that lie one behind the other."""
    return _array(_pointer(address), count, kind)


@numba.njit(inline="always")
def _one(address, kind):
    """Room of one number."""
    return _array(_pointer(address), 1, kind)


@numba.njit(inline="always")
def _sum(row):
    """A sum in the order of numpy, which has eight partial ones from eight numbers on."""
    count = len(row)
    if count < 8:
        total = row[0]
        for k in range(1, count):
            total += row[k]
        return total
    parts = row[:8].copy()
    whole = count - count % 8
    for first in range(8, whole, 8):
        for k in range(8):
            parts[k] += row[first + k]
    total = ((parts[0] + parts[1]) + (parts[2] + parts[3])) + ((parts[4] + parts[5]) + (parts[6] + parts[7]))
    for k in range(whole, count):
        total += row[k]
    return total


@machine_code
def interpret(code, address, joint, robot, block, registers, robots, joints, size):  # pragma: no cover - machine code
    """Carry out operations for all robots, block by block.

    Args:
        code: operation, result and operands as numbers of places, ``[operation, 4]``, see `op3.servo.block_run`.
        address: of the first number of every place, ``[place]``.
        joint: bytes from joint to joint.
        robot: bytes from robot to robot.
        block: bytes from block to block.
        registers: of the type of all numbers; only its type counts.
        robots: how many.
        joints: how many.
        size: of a block.
    """
    kind = registers.dtype
    one, zero = kind.type(1), kind.type(0)
    for first in range(0, robots, size):
        count, number = min(size, robots - first), first // size
        for i in range(len(code)):
            op, o, x, y = code[i, 0], code[i, 1], code[i, 2], code[i, 3]
            for j in range(joints):
                to = address[o] + number * block[o] + j * joint[o]
                at = address[x] + number * block[x] + j * joint[x]
                by = address[y] + number * block[y] + j * joint[y]
                if op >= 24:  # strides or kinds of their own
                    if op == 24:
                        out = _row(to, count, kind)
                        if robot[x] == 0:
                            value = _one(at, kind)[0]
                            for k in range(count):
                                out[k] = value
                        else:
                            for k in range(count):
                                out[k] = _one(at + k * robot[x], kind)[0]
                    elif op == 25:
                        out = _row(to, count, kind)
                        for k in range(count):
                            out[k] = _one(at + k * robot[x], np.uint8)[0]
                    elif op == 26:
                        a = _row(at, count, kind)
                        for k in range(count):
                            _one(to + k * robot[o], kind)[0] = a[k]
                    else:
                        a = _row(at, count, kind)
                        for k in range(count):
                            _one(to + k * robot[o], np.uint8)[0] = a[k] != 0
                    continue
                out = _row(to, count, kind)
                a = _row(at, count, kind)
                b = _row(by, count, kind)
                if op == 0:
                    for k in range(count):
                        out[k] = a[k] + b[k]
                elif op == 1:
                    for k in range(count):
                        out[k] = a[k] - b[k]
                elif op == 2:
                    for k in range(count):
                        out[k] = a[k] * b[k]
                elif op == 3:
                    for k in range(count):
                        out[k] = a[k] / b[k]
                elif op == 4:
                    for k in range(count):
                        out[k] = a[k] if a[k] < b[k] or a[k] != a[k] else b[k]
                elif op == 5:
                    for k in range(count):
                        out[k] = a[k] if a[k] > b[k] or a[k] != a[k] else b[k]
                elif op == 6:
                    for k in range(count):
                        out[k] = -a[k]
                elif op == 7:
                    for k in range(count):
                        out[k] = abs(a[k])
                elif op == 8:
                    for k in range(count):
                        out[k] = one if a[k] > 0 else (-one if a[k] < 0 else (a[k] if a[k] != a[k] else zero))
                elif op == 9:
                    for k in range(count):
                        out[k] = np.sqrt(a[k])
                elif op == 10:
                    for k in range(count):
                        out[k] = one if a[k] > b[k] else zero
                elif op == 11:
                    for k in range(count):
                        out[k] = one if a[k] >= b[k] else zero
                elif op == 12:
                    for k in range(count):
                        out[k] = one if a[k] < b[k] else zero
                elif op == 13:
                    for k in range(count):
                        out[k] = one if a[k] <= b[k] else zero
                elif op == 14:
                    for k in range(count):
                        out[k] = one if a[k] == b[k] else zero
                elif op == 15:
                    for k in range(count):
                        out[k] = one if a[k] != b[k] else zero
                elif op == 16:
                    for k in range(count):
                        out[k] = one if (a[k] != 0) & (b[k] != 0) else zero
                elif op == 17:
                    for k in range(count):
                        out[k] = one if (a[k] != 0) | (b[k] != 0) else zero
                elif op == 18:
                    for k in range(count):
                        out[k] = one if a[k] == 0 else zero
                elif op == 19:
                    for k in range(count):
                        out[k] = a[k]
                elif op == 20:
                    for k in range(count):
                        out[k] = a[k] if b[k] != 0 else out[k]
                elif op == 21:  # along the row, which holds the sum everywhere
                    value = _sum(a)
                    for k in range(count):
                        out[k] = value
                elif op == 23 and j == 0:
                    for k in range(count):
                        out[k] = a[k]
                elif op == 23:  # over joints, into the first row
                    total = _row(address[o] + number * block[o], count, kind)
                    for k in range(count):
                        total[k] = total[k] + a[k]
            if op == 23 and joint[o] != 0:
                total = _row(address[o] + number * block[o], count, kind)
                for j in range(1, joints):
                    out = _row(address[o] + number * block[o] + j * joint[o], count, kind)
                    for k in range(count):
                        out[k] = total[k]
