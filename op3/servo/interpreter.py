"""The loop behind `op3.servo.block_run`, compiled to machine code once and kept on disk."""

import numba
import numpy as np

from op3.servo.machine_code import machine_code, row_at

ADD, SUBTRACT, MULTIPLY, DIVIDE, MINIMUM, MAXIMUM, NEGATIVE, ABSOLUTE, SIGN, SQRT = range(10)
GREATER, GREATER_EQUAL, LESS, LESS_EQUAL, EQUAL, NOT_EQUAL, AND, OR, NOT = range(10, 19)
"""Elementwise operations, by numpy's names."""

COPY, WHERE, SUM_ALONG, SUM = range(19, 23)
"""Copy, copy where a condition holds, and sums along rows and over them."""

LOAD, LOAD_TRUTH, STORE, STORE_TRUTH = range(23, 27)
"""Between registers and memory with strides of its own, or that holds truths."""


@numba.njit(inline="always")
def _one(address, kind):
    """Room of one number."""
    return row_at(address, 1, kind)


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
                if op >= LOAD:  # strides or kinds of their own
                    if op == LOAD:
                        out = row_at(to, count, kind)
                        if robot[x] == 0:
                            value = _one(at, kind)[0]
                            for k in range(count):
                                out[k] = value
                        else:
                            for k in range(count):
                                out[k] = _one(at + k * robot[x], kind)[0]
                    elif op == LOAD_TRUTH:
                        out = row_at(to, count, kind)
                        for k in range(count):
                            out[k] = _one(at + k * robot[x], np.uint8)[0]
                    elif op == STORE:
                        a = row_at(at, count, kind)
                        for k in range(count):
                            _one(to + k * robot[o], kind)[0] = a[k]
                    else:
                        a = row_at(at, count, kind)
                        for k in range(count):
                            _one(to + k * robot[o], np.uint8)[0] = a[k] != 0
                    continue
                out = row_at(to, count, kind)
                a = row_at(at, count, kind)
                b = row_at(by, count, kind)
                if op == ADD:
                    for k in range(count):
                        out[k] = a[k] + b[k]
                elif op == SUBTRACT:
                    for k in range(count):
                        out[k] = a[k] - b[k]
                elif op == MULTIPLY:
                    for k in range(count):
                        out[k] = a[k] * b[k]
                elif op == DIVIDE:
                    for k in range(count):
                        out[k] = a[k] / b[k]
                elif op == MINIMUM:
                    for k in range(count):
                        out[k] = a[k] if a[k] < b[k] or a[k] != a[k] else b[k]
                elif op == MAXIMUM:
                    for k in range(count):
                        out[k] = a[k] if a[k] > b[k] or a[k] != a[k] else b[k]
                elif op == NEGATIVE:
                    for k in range(count):
                        out[k] = -a[k]
                elif op == ABSOLUTE:
                    for k in range(count):
                        out[k] = abs(a[k])
                elif op == SIGN:
                    for k in range(count):
                        out[k] = one if a[k] > 0 else (-one if a[k] < 0 else (a[k] if a[k] != a[k] else zero))
                elif op == SQRT:
                    for k in range(count):
                        out[k] = np.sqrt(a[k])
                elif op == GREATER:
                    for k in range(count):
                        out[k] = one if a[k] > b[k] else zero
                elif op == GREATER_EQUAL:
                    for k in range(count):
                        out[k] = one if a[k] >= b[k] else zero
                elif op == LESS:
                    for k in range(count):
                        out[k] = one if a[k] < b[k] else zero
                elif op == LESS_EQUAL:
                    for k in range(count):
                        out[k] = one if a[k] <= b[k] else zero
                elif op == EQUAL:
                    for k in range(count):
                        out[k] = one if a[k] == b[k] else zero
                elif op == NOT_EQUAL:
                    for k in range(count):
                        out[k] = one if a[k] != b[k] else zero
                elif op == AND:
                    for k in range(count):
                        out[k] = one if (a[k] != 0) & (b[k] != 0) else zero
                elif op == OR:
                    for k in range(count):
                        out[k] = one if (a[k] != 0) | (b[k] != 0) else zero
                elif op == NOT:
                    for k in range(count):
                        out[k] = one if a[k] == 0 else zero
                elif op == COPY:
                    for k in range(count):
                        out[k] = a[k]
                elif op == WHERE:
                    for k in range(count):
                        out[k] = a[k] if b[k] != 0 else out[k]
                elif op == SUM_ALONG:  # along the row, which holds the sum everywhere
                    value = _sum(a)
                    for k in range(count):
                        out[k] = value
                elif op == SUM and j == 0:
                    for k in range(count):
                        out[k] = a[k]
                elif op == SUM:  # over joints, into the first row
                    total = row_at(address[o] + number * block[o], count, kind)
                    for k in range(count):
                        total[k] = total[k] + a[k]
            if op == SUM and joint[o] != 0:
                total = row_at(address[o] + number * block[o], count, kind)
                for j in range(1, joints):
                    out = row_at(address[o] + number * block[o] + j * joint[o], count, kind)
                    for k in range(count):
                        out[k] = total[k]
