"""The line between computer and devices, which carries one byte at a time from one sender, and files of its frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, inf
from pathlib import Path
from typing import Annotated, Literal, TextIO

import numpy as np
from pydantic import Field

from op3.common.settings import NotNegative, Number, settings
from op3.deploy.emulator.faults import Faults
from op3.deploy.protocol import Packet, Parser


@settings("timing")
class LineTiming:
    """Delays of the transmission: with these values a tick of twenty servos and the IMU takes 5.1 ms at 2 Mbit/s.

    Attributes:
        host_delay: time from a write of the computer to the first bit on the line [s].
        turnaround: time from an instruction's end to the answer, in addition to the register `return_delay_time` [s]
            (inferred).
        usb_delay: time from the adapter to the computer [s].
        latency_timer: time for which the adapter collects bytes before it sends fewer than `USB_PAYLOAD` [s]. Linux'
            default for FTDI adapters is 0.016; robots set 0.001.
        quiet: silence after which the devices discard an incomplete packet [s].
    """

    host_delay: NotNegative = 1e-4
    turnaround: NotNegative = 25e-6
    usb_delay: NotNegative = 1e-4
    latency_timer: Annotated[Number, Field(ge=1e-4)] = 1e-3
    quiet: NotNegative = 0.02


USB_PAYLOAD = 62
"""Bytes that an FTDI adapter sends at once."""

BITS_PER_BYTE = 10
"""Start bit, eight bits, stop bit."""

Direction = Literal[">", "<"]
"""To the devices, or to the computer."""


@dataclass(frozen=True)
class Frame:
    """Bytes that were transmitted together.

    Attributes:
        time: time of the first bit [s].
        direction: ">" from the computer, "<" to it.
        data: bytes on the wire, or those that reached the computer after a fault.
    """

    time: float
    direction: Direction
    data: bytes


def read_frames(path: str | Path) -> list[Frame]:
    """The frames of a file that a `Line` wrote.

    Raises:
        ValueError: if a line is not a frame; the message names the line.
    """
    frames = []
    for number, line in enumerate(Path(path).read_text(encoding="ascii").splitlines(), 1):
        try:
            time, direction, data = line.split(" ", 2)
            if direction not in (">", "<"):
                raise ValueError(direction)
            frames.append(Frame(float(time), direction, bytes.fromhex(data)))  # type: ignore[arg-type]
        except ValueError:
            raise ValueError(f"{path}, line {number}: not a frame `<time> <direction> <bytes>`: {line!r}") from None
    return frames


def _new_file(path: Path) -> TextIO:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path.open("w", encoding="ascii")


Answers = Callable[[Packet, float], list[tuple[float, bytes]]]
"""Handles an instruction that ends at a time [s]; returns the pauses before the answers [s], and the answers."""


class Line:
    """The line, the adapter, and the bytes under way.

    Args:
        rng: random generator of the faults.
        record: new file for all frames, ``<time in s> <direction> <bytes in hexadecimal>``; None for none.
    """

    def __init__(
        self,
        answers: Answers,
        timing: LineTiming,
        faults: Faults,
        rng: np.random.Generator,
        record: str | Path | None,
    ):
        self.baud = 1_000_000
        self.timing, self.faults = timing, faults
        self._answers, self._rng, self._file = answers, rng, None if record is None else _new_file(Path(record))
        self._parser = Parser()
        self._host_ends = self._devices_end = self._flushed = self._deadline = self._held_until = 0.0
        self._spoken: list[tuple[float, bytes]] = []
        self._inbox: deque[tuple[float, bytes]] = deque()
        self._ready = bytearray()
        self._adapter = bytearray()

    def send(self, data: bytes, now: float) -> None:
        """The computer writes bytes at a time [s]."""
        byte_time = BITS_PER_BYTE / self.baud
        begin = max(now + self.timing.host_delay, self._host_ends)
        end = begin + len(data) * byte_time
        if begin - self._host_ends > self.timing.quiet:
            self._parser.reset()
        self._host_ends = end
        collides = begin < self._devices_end
        if collides:
            # two senders at once: nobody receives this, and the devices' answer is truncated
            self._cut(begin)
            self._parser.reset()
        self.flush_frames()
        self._write_frame(begin, ">", data)
        if collides:
            return
        for packet in self._parser.feed(data):
            if self.faults.unheard and self._rng.random() < self.faults.unheard:
                continue
            line = end
            for pause, answer in self._answers(packet, end):
                line = self._speak(line + pause, answer, byte_time)
            self._devices_end = max(self._devices_end, line)

    def _speak(self, begin: float, answer: bytes, byte_time: float) -> float:
        """Send a device's answer; return the time of its end [s]."""
        heard = self._spoil(answer, begin) if self.faults.spoiling else answer
        if self._file is not None and heard:
            self._spoken.append((begin, heard))
        self._receive(begin, heard, byte_time)
        return begin + len(answer) * byte_time

    def _spoil(self, answer: bytes, begin: float) -> bytes:
        """Bytes of an answer that reach the adapter."""
        faults, rng = self.faults, self._rng
        shares = np.cumsum([faults.lost, faults.corrupt, faults.truncated, faults.late])
        kind = int(np.searchsorted(shares, rng.random(), side="right"))
        if kind == 0:
            return b""
        if kind == 1:
            at, other = int(rng.integers(len(answer))), int(rng.integers(1, 256))
            return answer[:at] + bytes((answer[at] ^ other,)) + answer[at + 1 :]
        if kind == 2:
            return answer[: int(rng.integers(1, len(answer)))]
        if kind == 3:
            self._held_until = begin + faults.delay
        return answer

    def _receive(self, begin: float, data: bytes, byte_time: float) -> None:
        """Deliver bytes to the adapter, which forwards them when it is full or its timer ends."""
        done, last = 0, begin + len(data) * byte_time
        if self._adapter and last < self._deadline and len(self._adapter) + len(data) < USB_PAYLOAD:
            self._adapter += data  # the adapter is not full and its timer has not ended
            return
        while done < len(data):
            first = begin + (done + 1) * byte_time
            self._flush_until(first)
            room = USB_PAYLOAD - len(self._adapter)
            deadline = self._deadline if self._adapter else self._timer_after(first)
            in_time = max(1, ceil((deadline - begin) / byte_time - 1e-9) - 1 - done)
            take = min(room, in_time, len(data) - done)
            self._deadline = deadline
            self._adapter += data[done : done + take]
            done += take
            if len(self._adapter) == USB_PAYLOAD:
                self._flush(begin + done * byte_time)

    def _timer_after(self, time: float) -> float:
        """Next end of the adapter's timer [s], which restarts with every transfer."""
        period = self.timing.latency_timer
        return self._flushed + period * max(1, ceil((time - self._flushed) / period))

    def _flush(self, time: float) -> None:
        arrival = max(time + self.timing.usb_delay, self._held_until)
        self._inbox.append((arrival, bytes(self._adapter)))
        self._adapter.clear()
        self._flushed = time

    def _flush_until(self, time: float) -> None:
        if self._adapter and self._deadline <= time:
            self._flush(self._deadline)

    def _cut(self, time: float) -> None:
        """Drop the bytes that have not reached the adapter yet."""
        self._inbox = deque(entry for entry in self._inbox if entry[0] - self.timing.usb_delay <= time)
        self._adapter.clear()
        self._devices_end = time
        whole = [(begin, int((time - begin) * self.baud / BITS_PER_BYTE + 1e-6), data) for begin, data in self._spoken]
        self._spoken = [(begin, data[:count]) for begin, count, data in whole if count > 0]

    def _write_frame(self, begin: float, direction: Direction, data: bytes) -> None:
        if self._file is not None:
            self._file.write(f"{begin:.7f} {direction} {data.hex(' ')}\n")

    def flush_frames(self) -> None:
        """Record the answers sent since the last instruction."""
        for begin, data in self._spoken:
            self._write_frame(begin, "<", data)
        self._spoken.clear()

    def close(self) -> None:
        """Finish the file of frames, if there is one."""
        if self._file is not None:
            self.flush_frames()
            self._file.close()

    @property
    def next_arrival(self) -> float:
        """Time at which the computer receives its next bytes [s]; infinite if none are in transit."""
        if self._ready:
            return 0.0
        if self._inbox:
            return self._inbox[0][0]
        if self._adapter:
            return max(self._deadline + self.timing.usb_delay, self._held_until)
        return inf

    def available(self, now: float) -> int:
        """Number of bytes that the computer can read."""
        self._flush_until(now)
        inbox, ready = self._inbox, self._ready
        while inbox and inbox[0][0] <= now:
            ready += inbox.popleft()[1]
        return len(ready)

    def take(self, length: int, now: float) -> bytes:
        """At most this number of the bytes that the computer can read."""
        if len(self._ready) < length:
            self.available(now)
        taken = bytes(self._ready[:length])
        del self._ready[:length]
        return taken

    def discard(self, now: float) -> None:
        """Discard the bytes that the computer can read."""
        self.available(now)
        self._ready.clear()
