"""The robot's bus, accessed by joint name through the unmodified dynamixel-sdk.

Reading needs only a `Bus`. Writing needs the only `Writer` of a bus, so that one object decides what is sent.

This module adds functions that the SDK does not have. Status packets are parsed one by one to detect the ALERT bit and
the loss of a single servo. A wait ends a few milliseconds after the last byte instead of after 34 ms. The lock of an
interrupted call is cleared, and a disconnected port raises the single error `Unplugged`.
"""

from __future__ import annotations

import os
import termios
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import dynamixel_sdk
import dynamixel_sdk.port_handler
import numpy as np
import serial
from numpy.typing import ArrayLike

from op3.deploy.protocol import ALERT, Instruction, Parser, fast_answers
from op3.deploy.registers import DYNAMIXEL_X, FIRST_INDIRECT_ADDRESS, OPEN_CR, OPEN_CR_ID, Register, Units
from op3.deploy.robot_state import BLOCKS, BOARD_ADDRESS, BOARD_LENGTH, POINTERS, Block, Calibration, RobotState
from op3.deploy.serial_port import SerialPort
from op3.deploy.ticker import Clock
from op3.robot import Robot, load_robot

BAUD_RATE = 2_000_000
"""Baud rate of the bus [bit/s]."""

BOARD = "opencr"
"""Name of the board with IMU and power switch."""

FIRST_ANSWER = 4.0
"""Longest wait for the first byte of an answer [ms]; the USB adapter alone delays by up to 1 ms."""

GAP = 2.0
"""Longest pause between bytes of consecutive answers [ms]."""

SLOW_ANSWER = 24.0
"""Both limits for a USB adapter with the default latency timer of 16 ms, for example after replugging [ms]."""

ATTEMPTS = 3
"""Attempts of a single read or write."""


class BusError(RuntimeError):
    """A failure on the bus; the message names the device."""


class NoAnswer(BusError):
    """A device did not answer, or its answer was corrupt."""


class Refused(BusError):
    """A device answered with an error."""


class Unplugged(BusError):
    """The serial port disappeared."""


class Bus:
    """The servos of a robot, and its board if it has one.

    Args:
        port: a port handler of dynamixel-sdk or an equivalent object, which is opened if necessary.
        robot: robot on the bus: a name in `assets/robots`, or the path of its file.

    Attributes:
        ids: bus ids of all devices, by joint and `BOARD`.

    Raises:
        Unplugged: if the port cannot be opened.
        ValueError: if the robot has servos that this bus does not support.
    """

    def __init__(self, port: Any, clock: Clock, robot: str | Robot, *, calibration: Calibration | None = None) -> None:
        # The SDK waits two latency timers beyond the time on the wire; its default is an adapter's 16 ms.
        dynamixel_sdk.port_handler.LATENCY_TIMER = 1
        self.port, self.clock, self.port_name = port, clock, str(getattr(port, "port_name", "port"))
        self.robot = load_robot(robot)
        self.units = Units(self.robot)
        self.calibration = calibration or Calibration(robot=self.robot)
        self.board = self.robot.file.board is not None
        self.joints = self.robot.joints
        self.ids = {**self.robot.bus_ids, **({BOARD: OPEN_CR_ID} if self.board else {})}
        self.names = {number: name for name, number in self.ids.items()}
        self.block: Block = BLOCKS[-1]
        self._sdk: Any = dynamixel_sdk.PacketHandler(2.0)
        self._writer: Writer | None = None
        self._servo_ids = [self.ids[name] for name in self.joints]
        self._order = list(self._servo_ids)
        self._missed = False
        self._first_answer, self._gap = FIRST_ANSWER, GAP
        self._data: dict[int, bytes] = {}
        self._imu = bytes(BOARD_LENGTH)
        if not getattr(port, "is_open", False):
            self.open()

    def open(self) -> None:
        """Open or reopen the port; raises `Unplugged`."""
        try:
            with self._plugged():
                opened = self.port.setBaudRate(BAUD_RATE)
        except Unplugged as error:
            code = getattr(error.__cause__, "errno", None)  # the error's text repeats the port and the reason
            raise Unplugged(
                f"the port {self.port_name} cannot be opened ({os.strerror(code) if code else error.__cause__});"
                " plug the adapter in, or name another port with port="
            ) from error.__cause__
        if not opened:
            raise Unplugged(f"the port {self.port_name} cannot be opened at {BAUD_RATE} bit/s")

    def close(self) -> None:
        """Close the port."""
        with suppress(Unplugged), self._plugged():
            self.port.closePort()

    @contextmanager
    def patience(self, first_answer: float, gap: float) -> Iterator[None]:
        """Set the timeouts for the first byte of an answer, and between answers [ms]."""
        usual, sdk = (self._first_answer, self._gap), dynamixel_sdk.port_handler
        timer, self._first_answer, self._gap = sdk.LATENCY_TIMER, first_answer, gap
        sdk.LATENCY_TIMER = max(timer, first_answer / 2 - 1)  # it waits for two of them and 2 ms
        try:
            yield
        finally:
            (self._first_answer, self._gap), sdk.LATENCY_TIMER = usual, timer

    def clear(self) -> None:
        """Unlock a port after an interrupted call; otherwise the SDK sends nothing."""
        self.port.is_using = False

    def writer(self) -> Writer:
        """The only write handle; it can be requested once."""
        if self._writer is not None:
            raise RuntimeError("the bus already has a writer; only one object may write")
        self._writer = Writer(self)
        return self._writer

    def ping(self, name: str) -> int:
        """Model number of a device; raises `NoAnswer`."""
        return self._try(name, "a ping", lambda: self._sdk.ping(self.port, self.ids[name]))

    def ping_all(self) -> dict[str, int]:
        """Model number of every device that answers, by name. A missing one takes 4 ms instead of 0.8 s."""
        found = {}
        for name in self.ids:
            with suppress(NoAnswer):
                found[name] = self.ping(name)
        return found

    def answers_protocol_1(self, name: str) -> bool:
        """Whether a device that does not answer protocol 2.0 answers a ping of protocol 1.0."""
        instruction = [0, 0, self.ids[name], 2, dynamixel_sdk.INST_PING, 0]
        with self._plugged():
            _, result, _ = dynamixel_sdk.PacketHandler(1.0).txRxPacket(self.port, instruction)
        return result == dynamixel_sdk.COMM_SUCCESS

    def read(self, name: str, register: str, *, attempts: int = ATTEMPTS) -> int:
        """Signed value of one register of one device, with retries; raises `NoAnswer` or `Refused`."""
        entry = self._register(name, register)
        place = (self.ids[name], entry.address, entry.size)
        return entry.decode(self._try(name, f"a read of {register}", lambda: self._read_once(*place), attempts))

    def sync_read(self, register: str) -> dict[str, int]:
        """Signed values of one register of all servos; servos that do not answer are omitted."""
        entry = DYNAMIXEL_X[register]
        data, _ = self._read_many(entry.address, entry.size, fast=False)
        return {self.names[number]: entry.decode(value) for number, value in data.items()}

    def read_state(self) -> RobotState:
        """The readings of one tick. Devices that do not answer keep their last values; see `RobotState.answered`."""
        # In a fast answer a lost part hides the later parts, so one servo of twenty could miss several ticks in a row.
        # After a loss every servo answers in a separate packet: slower, but each loss affects one servo.
        fast = self.block.fast and not self._missed
        data, alerts = self._read_many(self.block.address, self.block.length, fast=fast, order=self._order)
        self._missed = len(data) < len(self._order)
        if missing := [number for number in self._order if number not in data]:
            # A servo answers after the previous one, so a silent servo hides all later ones: from now on it is read
            # last.
            self._order.remove(missing[0])
            self._order.append(missing[0])
        self._data.update(data)
        imu = self.board and self._read_board()
        answered, alert = (np.array([number in found for number in self._servo_ids]) for found in (data, alerts))
        registers = self.block.unpack([self._data.get(number, bytes(self.block.length)) for number in self._servo_ids])
        if "hardware_error" not in registers:
            registers["hardware_error"] = self._errors_of(alert)
        seen = {"time": self.clock.now(), "alert": alert, "answered": answered, "imu_answered": imu}
        board = self._imu if self.board else None
        return RobotState.of(registers, self.units, self.calibration.offset, board, **seen)

    def _errors_of(self, alert: np.ndarray) -> np.ndarray:
        """Hardware errors [joint], read from servos that raise the alert if the block does not contain them."""
        errors = np.zeros(len(self.joints), dtype=np.int64)
        for index in np.flatnonzero(alert):
            with suppress(BusError):
                errors[index] = self.read(self.joints[index], "hardware_error_status")
        return errors

    def _read_once(self, number: int, address: int, length: int) -> tuple[bytes, int, int]:
        """Data, result and error of a read. The SDK's function would accept any packet from the device."""
        with self._plugged():
            sent = self._sdk.readTx(self.port, number, address, length)
        if sent != dynamixel_sdk.COMM_SUCCESS:
            return b"", sent, 0
        answers = self._receive([number], length)
        if number not in answers:
            return b"", dynamixel_sdk.COMM_RX_TIMEOUT, 0
        error, data = answers[number]
        return data, dynamixel_sdk.COMM_SUCCESS, error

    def _read_board(self) -> bool:
        """Refresh the IMU block; returns whether it was received. OpenCR does not support fast sync reads."""
        data, result, error = self._read_once(OPEN_CR_ID, BOARD_ADDRESS, BOARD_LENGTH)
        if result != dynamixel_sdk.COMM_SUCCESS or error & ~ALERT:
            return False
        self._imu = data
        return True

    def _read_many(
        self, address: int, length: int, *, fast: bool, order: Sequence[int] | None = None
    ) -> tuple[dict[int, bytes], set[int]]:
        """Bytes by id of the servos that answered, and the ids that raised the alert."""
        ids = list(order or self._servo_ids)
        with self._plugged():
            sent = self._sdk.syncReadTx(self.port, address, length, ids, len(ids), fast)
        if sent != dynamixel_sdk.COMM_SUCCESS:
            return {}, set()
        if fast:
            answers = fast_answers(self._collect(8 + len(ids) * (length + 4)), ids, length)
        else:
            answers = self._receive(ids, length)
        found = {i: data for i, (error, data) in answers.items() if not error & ~ALERT and len(data) == length}
        return found, {i for i, (error, _) in answers.items() if error & ALERT}

    def _receive(self, ids: Sequence[int], length: int) -> dict[int, tuple[int, bytes]]:
        """Error and data of each of these devices, until all have answered or no more bytes arrive.

        Other answers, such as late answers to an earlier instruction, are ignored.
        """
        parser, answers = Parser(), {}
        for chunk in self._chunks(len(ids) * (11 + length)):
            for packet in parser.feed(chunk):
                if packet.device not in ids or packet.instruction != Instruction.STATUS or not packet.parameters:
                    continue
                if len(packet.data) == length or packet.error:
                    answers[packet.device] = packet.parameters[0], packet.data
            if len(answers) == len(ids):
                break
        return answers

    def _collect(self, expected: int) -> bytes:
        """The bytes of one answer, until the expected number has arrived or no more arrive."""
        data = b""
        for chunk in self._chunks(expected):
            data += chunk
            if len(data) >= expected:
                break
        return data

    def _chunks(self, expected: int) -> Iterator[bytes]:
        """Received bytes until the line is silent, because stuffing may add bytes. The wait is limited, because a
        disturbed line may never be silent.
        """
        got = 0
        try:
            with self._plugged():
                end = self.port.getCurrentTime() + 2 * self._first_answer + 4 * expected * self.port.tx_time_per_byte
                self.port.setPacketTimeoutMillis(self._first_answer)
                while self.port.getCurrentTime() < end:
                    chunk = bytes(self.port.readPort(max(1, expected - got)))
                    if chunk:
                        got += len(chunk)
                        self.port.setPacketTimeoutMillis(self._gap)
                        yield chunk
                    elif self.port.isPacketTimeout():
                        return
        finally:
            self.port.is_using = False

    def _try(self, name: str, what: str, call: Any, attempts: int = ATTEMPTS) -> Any:
        """The value of an SDK call that returns value, result and error; it is repeated if there is no answer."""
        result = dynamixel_sdk.COMM_RX_TIMEOUT
        for _ in range(attempts):
            with self._plugged():
                try:
                    value, result, error = call()
                except IndexError:  # the SDK fails on truncated packets
                    self.clear()
                    result = dynamixel_sdk.COMM_RX_CORRUPT
                    continue
            if result == dynamixel_sdk.COMM_SUCCESS:
                if error & ~ALERT:
                    text = self._sdk.getRxPacketError(error & ~ALERT).removeprefix("[RxPacketError] ")
                    raise Refused(f"{name} (id {self.ids[name]}) refused {what}: {text}")
                return value
        text = self._sdk.getTxRxResult(result).removeprefix("[TxRxResult] ")
        raise NoAnswer(f"{name} (id {self.ids[name]}) did not answer {what}: {text}")

    def _register(self, name: str, register: str) -> Register:
        return (OPEN_CR if name == BOARD else DYNAMIXEL_X)[register]

    @contextmanager
    def _plugged(self) -> Iterator[None]:
        """Convert the exceptions of a disconnected port to `Unplugged`."""
        try:
            yield
        except (serial.SerialException, OSError, termios.error, TypeError, AttributeError) as error:
            never_open = isinstance(self.port, SerialPort) and self.port.ser is None
            if isinstance(error, TypeError | AttributeError) and not never_open:
                raise  # without its device the SDK fails on None; elsewhere these exceptions are errors in op3
            self.clear()
            raise Unplugged(f"the port {self.port_name} disappeared ({error}); check the USB cable") from error


class Writer:
    """The write handle of a bus; `Bus.writer` gives it out once."""

    def __init__(self, bus: Bus):
        self._bus = bus

    def write(self, name: str, register: str, value: int) -> None:
        """Write one register of one device; raises `NoAnswer` or `Refused`."""
        bus, entry = self._bus, self._bus._register(name, register)
        data = list(entry.encode(value))

        def call() -> tuple[None, int, int]:
            return None, *bus._sdk.writeTxRx(bus.port, bus.ids[name], entry.address, entry.size, data)

        bus._try(name, f"{value} for {register}", call)

    def sync_write(self, register: str, values: Mapping[str, int] | int) -> None:
        """Write one register of servos in one packet, by joint or with one value for all. There is no answer, so read
        it back."""
        entry = DYNAMIXEL_X[register]
        if isinstance(values, int):
            values = dict.fromkeys(self._bus.joints, values)
        self._send(entry.address, entry.size, ((name, entry.encode(value)) for name, value in values.items()))

    def write_currents(self, counts: ArrayLike) -> None:
        """Goal currents [joint] of all servos in counts, in one packet."""
        values = np.asarray(counts).astype(int).tolist()
        self.sync_write("goal_current", dict(zip(self._bus.joints, values, strict=True)))

    def prepare_block(self) -> Block:
        """Choose the shortest block that the servos support for `Bus.read_state`, and set up its indirect addresses."""
        bus = self._bus
        for block in BLOCKS:
            if block.indirect and not self._point():
                continue
            for _ in range(ATTEMPTS):
                data, _ = bus._read_many(block.address, block.length, fast=block.fast)
                if len(data) == len(bus.joints):
                    bus.block = block
                    bus._data.clear()
                    return block
        raise NoAnswer("the servos do not answer a sync read of any block; check cables and ids")

    def _point(self) -> bool:
        """Set up the indirect addresses; whether all servos have them. An answer may be lost."""
        joints, place = self._bus.joints, (FIRST_INDIRECT_ADDRESS, len(POINTERS))
        for _ in range(ATTEMPTS):
            self._send(*place, ((name, POINTERS) for name in joints))
            there, _ = self._bus._read_many(*place, fast=False)
            if len(there) == len(joints) and all(data == POINTERS for data in there.values()):
                return True
        return False

    def _send(self, address: int, size: int, values: Iterable[tuple[str, bytes]]) -> None:
        bus = self._bus
        parameters: list[int] = []
        for name, data in values:
            parameters += [bus.ids[name], *data]
        with bus._plugged():
            bus._sdk.syncWriteTxOnly(bus.port, address, size, parameters, len(parameters))
