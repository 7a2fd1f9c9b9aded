"""Packets of Dynamixel Protocol 2.0, to the byte.

    FF FF FD 00 | id | length (2) | instruction | parameters | crc (2)

`length` counts everything after it. Instruction and parameters are stuffed: another FD follows every FF FF FD, so that
a header cannot appear inside a packet. The CRC covers all preceding bytes as transmitted. Source: ROBOTIS e-Manual,
"DYNAMIXEL Protocol 2.0".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

HEADER = b"\xff\xff\xfd\x00"
"""Header of every packet."""

BROADCAST_ID = 0xFE
"""Address of all devices."""

MAX_ID = 0xFC
"""Highest id of a device."""

MAX_LENGTH = 1024
"""Largest accepted value of a packet's length field; the buffer of dynamixel-sdk."""

ALERT = 0x80
"""Bit of a status packet's error byte: the device has a hardware error."""

_PATTERN = b"\xff\xff\xfd"


class Instruction(IntEnum):
    """The instruction of a packet; `STATUS` for an answer."""

    PING_1 = -1
    """A ping of protocol 1.0, its only instruction that is supported."""
    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    FAST_BULK_READ = 0x9A


class Error(IntEnum):
    """Error number of a status packet, without the `ALERT` bit."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


def _after_a_byte(register: int) -> int:
    """The CRC register of 16 bits after eight zero bits."""
    for _ in range(8):
        register = (register << 1 ^ (0x8005 if register & 0x8000 else 0)) & 0xFFFF
    return register


_CRC = [_after_a_byte(byte << 8) for byte in range(256)]


def crc16(data: bytes | bytearray, crc: int = 0) -> int:
    """CRC-16 with polynomial 0x8005, most significant bit first, no final inversion; `crc` is that of earlier bytes."""
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ _CRC[crc >> 8 ^ byte]
    return crc


def stuff(body: bytes) -> bytes:
    """Instruction and parameters as sent over the wire."""
    return body.replace(_PATTERN, b"\xff\xff\xfd\xfd")


def unstuff(body: bytes) -> bytes:
    """The inverse of `stuff`."""
    return body.replace(b"\xff\xff\xfd\xfd", _PATTERN)


def encode(device: int, instruction: int, parameters: bytes = b"") -> bytes:
    """A complete packet to or from a device.

    Raises:
        ValueError: if the packet would be longer than `MAX_LENGTH`, or the id is invalid.
    """
    if not 0 <= device <= BROADCAST_ID or device == 0xFD:
        raise ValueError(f"a device's id is 0 to {MAX_ID} or {BROADCAST_ID} for all, got {device}")
    body = stuff(bytes((instruction,)) + parameters)
    length = len(body) + 2
    if length > MAX_LENGTH:
        raise ValueError(f"a packet can contain at most {MAX_LENGTH - 3} bytes of parameters, got {len(parameters)}")
    packet = HEADER + bytes((device, length & 0xFF, length >> 8)) + body
    return packet + crc16(packet).to_bytes(2, "little")


def encode_status(device: int, error: int, data: bytes = b"") -> bytes:
    """A device's answer; its error is one of `Error`, with `ALERT` added if the device has a hardware error."""
    return encode(device, Instruction.STATUS, bytes((error,)) + data)


def _packet_1(device: int, content: int) -> bytes:
    """A packet of protocol 1.0 with only an instruction or an error."""
    return bytes((0xFF, 0xFF, device, 2, content, ~(device + 2 + content) & 0xFF))


def encode_status_1(device: int) -> bytes:
    """A device's answer to a ping of protocol 1.0 (ROBOTIS e-Manual, "DYNAMIXEL Protocol 1.0")."""
    return _packet_1(device, Error.NONE)


def encode_fast_status(parts: list[tuple[int, int, bytes]]) -> list[bytes]:
    """Each device's part of the common status packet that answers a fast sync or bulk read.

    Each appends its error, id, data and a CRC over everything before; the packet's id is `BROADCAST_ID`, and nothing
    is stuffed. `parts` are error, id and data of each device in order.
    """
    length = 1 + sum(len(data) + 4 for _, _, data in parts)
    head = HEADER + bytes((BROADCAST_ID, length & 0xFF, length >> 8, Instruction.STATUS))
    sent, crc = [], 0
    for number, (error, device, data) in enumerate(parts):
        piece = (head if number == 0 else b"") + bytes((error, device)) + data
        crc = crc16(piece, crc)
        piece += crc.to_bytes(2, "little")
        crc = crc16(piece[-2:], crc)
        sent.append(piece)
    return sent


def fast_answers(data: bytes, ids: Sequence[int], length: int) -> dict[int, tuple[int, bytes]]:
    """Error and bytes of each device in such a packet, by id in the requested order, with the requested lengths.

    If a part is missing or damaged, the parts before it are valid and the rest is lost.
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


@dataclass(frozen=True, slots=True)
class Packet:
    """One complete packet, to a device or from it.

    Attributes:
        device: id of the device.
        instruction: one of `Instruction`, or an unknown number.
        parameters: parameters without stuffing; in an answer the error byte comes first.
    """

    device: int
    instruction: int
    parameters: bytes

    @property
    def error(self) -> int:
        """Error number of a status packet, without the alert."""
        return self.parameters[0] & ~ALERT

    @property
    def data(self) -> bytes:
        """The parameters of a status packet after its error byte."""
        return self.parameters[1:]


class Parser:
    """Finds packets in a stream of bytes that may contain other bytes.

    A packet is accepted if its header, id and length are valid and its CRC is correct; otherwise the search continues
    one byte after its header, so that a packet after a damaged one is found.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()

    def reset(self) -> None:
        """Discard an incomplete packet."""
        self._buffer.clear()

    def feed(self, data: bytes) -> list[Packet]:
        """Add received bytes; return the packets that they complete. A ping of protocol 1.0 must arrive alone."""
        if len(data) == 6 and data == _packet_1(data[2], Instruction.PING):
            return [Packet(data[2], Instruction.PING_1, b"")]
        buffer = self._buffer
        buffer += data
        found = []
        while True:
            self._drop(self._begin())
            if len(buffer) < 7:
                return found
            length = buffer[5] | buffer[6] << 8
            if buffer[4] in (0xFD, 0xFF) or not 3 <= length <= MAX_LENGTH:
                self._drop(3)
                continue
            end = 7 + length
            if len(buffer) < end:
                return found
            if crc16(buffer[: end - 2]) != buffer[end - 2] | buffer[end - 1] << 8:
                self._drop(3)
                continue
            body, device = bytes(buffer[7 : end - 2]), buffer[4]
            del buffer[:end]
            if not (device == BROADCAST_ID and body[0] == Instruction.STATUS):
                body = unstuff(body)  # only fast answers are not stuffed
            found.append(Packet(device, body[0], body[1:]))

    def _begin(self) -> int:
        """Index at which a header begins, or may begin with the next bytes."""
        buffer = self._buffer
        at = buffer.find(HEADER)
        if at >= 0:
            return at
        for kept in (3, 2, 1):
            if buffer.endswith(HEADER[:kept]):
                return len(buffer) - kept
        return len(buffer)

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
