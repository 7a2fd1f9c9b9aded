"""Reaction of the devices to an instruction, and the order of their answers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

from op3.deploy.emulator.device import OPEN_CR_INSTRUCTIONS, Device
from op3.deploy.emulator.servo import Servo
from op3.deploy.protocol import (
    ALERT,
    BROADCAST_ID,
    Error,
    Instruction,
    Packet,
    encode_fast_status,
    encode_status,
    encode_status_1,
)

PING_SLOT = 0.003
"""Time that a broadcast ping waits for each id that does not answer [s]; firmware of the OpenCR."""

FAST_GAP = 5e-6
"""Pause between devices in a fast read [s] (inferred)."""

LONGEST_FAST = 0xFFFF - 1
"""Bytes that devices can put into one fast status packet; the length field has 16 bits. A larger request gets no
answer.
"""

LEVELS: dict[int, int] = {Instruction.PING: 0, Instruction.READ: 1}
"""Lowest status return level at which an instruction is answered; 2 for all others."""

Answer = tuple[float, bytes]
"""Pause before an answer [s], and its bytes."""


class Dispatcher:
    """Passes instructions to the devices.

    In sync and bulk reads a device answers after the answer of the previous one, so after a missing device none answers
    (as in the OpenCR's firmware, whose timeout of 50 ms exceeds usual timeouts of computers). All answers contain the
    registers' values at the end of the instruction.

    Args:
        turnaround: time from an instruction's end to the answer [s].
        hears: function that decides whether a device receives an instruction.
    """

    def __init__(self, devices: Sequence[Device], turnaround: float, hears: Callable[[Device], bool]):
        self._devices, self._turnaround, self._hears = devices, turnaround, hears
        self._by_id: dict[int, Device] = {}

    def answers(self, packet: Packet, now: float) -> list[Answer]:
        """Carry out an instruction at a time [s]."""
        instruction, parameters = packet.instruction, packet.parameters
        self._by_id = {device.id: device for device in reversed(self._devices)}
        if instruction in (Instruction.SYNC_READ, Instruction.BULK_READ):
            return self._chain(_reads(instruction, parameters))
        if instruction in (Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ):
            return self._fast(list(_reads(instruction, parameters)))
        if instruction == Instruction.SYNC_WRITE:
            for number, address, data in _writes(parameters):
                if device := self._listening(number):
                    device.write(address, data)
            return []
        if instruction == Instruction.STATUS:
            return []
        if packet.device == BROADCAST_ID:
            return self._broadcast(packet, now)
        device = self._listening(packet.device, 1 if instruction == Instruction.PING_1 else 2)
        if device is None:
            return []
        if instruction == Instruction.PING_1:
            return [(self._pause(device), encode_status_1(packet.device))]
        if not isinstance(device, Servo) and instruction not in OPEN_CR_INSTRUCTIONS:
            return []
        level = device.return_level  # read before the write takes effect, as in the manual's examples
        error, data = self._single(device, packet, now)
        if level < LEVELS.get(instruction, 2):
            return []
        return [(self._pause(device), encode_status(packet.device, error | _alert(device), data))]

    def _listening(self, device_id: int, protocol: int = 2) -> Device | None:
        device = self._by_id.get(device_id)
        return device if device is not None and self._understands(device, protocol) else None

    def _understands(self, device: Device, protocol: int = 2) -> bool:
        return device.protocol == protocol and self._hears(device)

    def _pause(self, device: Device) -> float:
        return self._turnaround + device.return_delay

    def _single(self, device: Device, packet: Packet, now: float) -> tuple[int, bytes]:
        """Error and data of an instruction for one device."""
        instruction, parameters = packet.instruction, packet.parameters
        if instruction == Instruction.PING:
            return Error.NONE, device.ping()
        if instruction == Instruction.READ:
            if len(parameters) != 4:
                return Error.DATA_LENGTH, b""
            return device.read(_word(parameters, 0), _word(parameters, 2))
        if instruction == Instruction.WRITE:
            if len(parameters) < 3:
                return Error.DATA_LENGTH, b""
            return device.write(_word(parameters, 0), parameters[2:]), b""
        if instruction == Instruction.REBOOT and isinstance(device, Servo):
            device.power(True, now)
            return Error.NONE, b""
        return Error.INSTRUCTION, b""

    def _broadcast(self, packet: Packet, now: float) -> list[Answer]:
        """An instruction for all devices; only a ping is answered."""
        if packet.instruction == Instruction.PING:
            answers, last = [], 0
            for number in sorted(self._by_id):
                if device := self._listening(number):
                    pause = self._pause(device) + PING_SLOT * max(0, number - last - 1)
                    answers.append((pause, encode_status(number, _alert(device), device.ping())))
                    last = number
            return answers
        for device in self._devices:
            if packet.instruction != Instruction.READ and isinstance(device, Servo) and self._understands(device):
                self._single(device, packet, now)
        return []

    def _chain(self, items: Iterable[tuple[int, int, int]]) -> list[Answer]:
        answers = []
        for number, address, length in items:
            device = self._listening(number)
            if device is None or device.return_level < 1:
                break
            error, data = device.read(address, length)
            answers.append((self._pause(device), encode_status(number, error | _alert(device), data)))
        return answers

    def _fast(self, asked: Sequence[tuple[int, int, int]]) -> list[Answer]:
        """Answers to a fast read, with the requested length even if some devices do not answer."""
        parts, pauses, silent = [], [], False
        for number, address, length in asked:
            device = self._listening(number)
            if not isinstance(device, Servo) or device.return_level < 1:
                silent, device = True, None
            error, data = (Error.NONE, b"") if device is None else device.read(address, length)
            parts.append((error | _alert(device), number, data.ljust(length, b"\0")))
            if not silent and device is not None:
                pauses.append(FAST_GAP if pauses else self._pause(device))
        if not parts or sum(len(data) + 4 for _, _, data in parts) > LONGEST_FAST:
            return []
        return list(zip(pauses, encode_fast_status(parts), strict=False))


def _alert(device: Device | None) -> int:
    return ALERT if device is not None and device.alert else 0


def _word(data: bytes, at: int) -> int:
    return data[at] | data[at + 1] << 8


def _reads(instruction: int, parameters: bytes) -> Iterator[tuple[int, int, int]]:
    """Id, address and length of every item that a sync or bulk read requests."""
    if instruction in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ):
        if len(parameters) > 4:
            address, length = _word(parameters, 0), _word(parameters, 2)
            yield from ((number, address, length) for number in parameters[4:])
    elif len(parameters) % 5 == 0:
        for at in range(0, len(parameters), 5):
            yield parameters[at], _word(parameters, at + 1), _word(parameters, at + 3)


def _writes(parameters: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Id, address and data of the complete items of a sync write."""
    if len(parameters) > 4:
        address, length = _word(parameters, 0), _word(parameters, 2)
        for at in range(4, len(parameters) - length, length + 1):
            yield parameters[at], address, parameters[at + 1 : at + 1 + length]
