"""The registers that one tick reads, and how they lie together in a packet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from op3.deploy.protocol import BROADCAST_ID, HEADER, crc16
from op3.deploy.registers import FIRST_INDIRECT_ADDRESS, FIRST_INDIRECT_DATA, OPEN_CR, XM430_W350, Register

_SHORT = {
    "current": "present_current",
    "velocity": "present_velocity",
    "position": "present_position",
    "hardware_error": "hardware_error_status",
    "temperature": "present_temperature",
    "voltage": "present_input_voltage",
}


def _kind(register: Register) -> str:
    return f"<{'i' if register.signed else 'u'}{register.size}"


CONTENTS = tuple((name, XM430_W350[full].address, _kind(XM430_W350[full])) for name, full in _SHORT.items())
"""Name, address and type of what a tick needs: 14 bytes."""

FIRST_PLAIN = XM430_W350["present_current"].address
"""First address of the block that needs no indirect addresses ..."""

PLAIN_LENGTH = XM430_W350["present_temperature"].end - FIRST_PLAIN
"""... and its length: from present current to present temperature, 21 bytes."""


@dataclass(frozen=True)
class Block:
    """A row of bytes that one (fast) sync read fetches from each servo.

    Attributes:
        address: of the first byte.
        length: in bytes.
        fast: whether the servos answer in one common packet.
        indirect: whether the bytes are pointed to by indirect addresses.
        pointer_address: first indirect address.
    """

    address: int
    length: int
    fast: bool
    indirect: bool
    pointer_address: int = FIRST_INDIRECT_ADDRESS

    def pointers(self) -> bytes:
        """What the indirect addresses hold: the address of each byte of the block."""
        addresses = [address + i for _, address, kind in CONTENTS for i in range(np.dtype(kind).itemsize)]
        return np.array(addresses, dtype="<u2").tobytes()

    def unpack(self, data: Sequence[bytes]) -> dict[str, NDArray[np.int64]]:
        """Registers by name, each [joint], sign included. A plain block lacks the hardware error."""
        table = np.frombuffer(b"".join(data), dtype=_INDIRECT if self.indirect else _PLAIN)
        return {name: table[name].astype(np.int64) for name in table.dtype.names or ()}


_INDIRECT = np.dtype([(name, kind) for name, _, kind in CONTENTS])
_PLAIN = np.dtype(
    {
        "names": [name for name, address, _ in CONTENTS if address >= FIRST_PLAIN],
        "formats": [kind for _, address, kind in CONTENTS if address >= FIRST_PLAIN],
        "offsets": [address - FIRST_PLAIN for _, address, _ in CONTENTS if address >= FIRST_PLAIN],
        "itemsize": PLAIN_LENGTH,
    }
)

BLOCKS = (
    Block(FIRST_INDIRECT_DATA, _INDIRECT.itemsize, fast=True, indirect=True),
    Block(FIRST_INDIRECT_DATA, _INDIRECT.itemsize, fast=False, indirect=True),
    Block(FIRST_PLAIN, PLAIN_LENGTH, fast=False, indirect=False),
)
"""Ways to read a tick, best first. The last one needs nothing set up and nothing but a sync read."""


BOARD_ADDRESS = OPEN_CR["button"].address
"""First address of what a tick reads from OpenCR ..."""

BOARD_LENGTH = OPEN_CR["yaw"].end - BOARD_ADDRESS
"""... and its length: buttons, voltage, gyro, accelerometer, roll-pitch-yaw, 20 bytes."""


def unpack_board(data: bytes) -> tuple[int, NDArray[np.int64]]:
    """Supply voltage in counts, and the nine IMU registers."""
    voltage = data[OPEN_CR["present_voltage"].address - BOARD_ADDRESS]
    first = OPEN_CR["gyro_x"].address - BOARD_ADDRESS
    return voltage, np.frombuffer(data, dtype="<i2", offset=first, count=9).astype(np.int64)


def fast_answers(data: bytes, ids: Sequence[int], length: int) -> dict[int, tuple[int, bytes]]:
    """Error and bytes by id of each servo in the answer to a fast sync read.

    Each servo's part ends with a CRC over everything before it. Where one is missing or damaged, the parts before it
    are still good and the rest is lost.

    Args:
        data: bytes that came.
        ids: in the order asked.
        length: bytes asked of each.
    """
    start = data.find(HEADER + bytes((BROADCAST_ID,)))
    if start < 0:
        return {}
    end, crc, answers = start + 8, crc16(data[start : start + 8]), {}
    for number in ids:
        part = data[end : end + length + 4]
        if len(part) < length + 4 or part[1] != number:
            break
        crc = crc16(part[:-2], crc)
        if crc != part[-2] | part[-1] << 8:
            break
        answers[number] = part[0], part[2:-2]
        crc = crc16(part[-2:], crc)
        end += length + 4
    return answers
