"""Devices on the bus: registers in memory, the rules for reading and writing them, and the OpenCR."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from op3.deploy.protocol import Error, Instruction
from op3.deploy.registers import (
    BAUD_RATES,
    OPEN_CR,
    OPEN_CR_AXES,
    OPEN_CR_ID,
    RETURN_DELAY_UNIT,
    ControlTable,
    Register,
)
from op3.robot.register_units import ACCELERATION_UNIT, ANGLE_UNIT, GYRO_UNIT, VOLTAGE_UNIT
from op3.stand_in.sensors import Sensors

OPEN_CR_INSTRUCTIONS = (
    Instruction.PING,
    Instruction.READ,
    Instruction.WRITE,
    Instruction.SYNC_READ,
    Instruction.SYNC_WRITE,
    Instruction.BULK_READ,
)
"""Instructions that the board supports."""

_IMU = slice(OPEN_CR["gyro_x"].address, OPEN_CR["yaw"].end)
_VOLTAGE = OPEN_CR["present_voltage"].address
_UNITS = np.repeat([GYRO_UNIT, ACCELERATION_UNIT, ANGLE_UNIT], 3)
# The firmware truncates angles; rounding must not move a reading on the grid below it.
_COUNTS_PER_SI = np.tile(OPEN_CR_AXES, 3) / _UNITS * np.repeat([1.0, 1.0, 1 + 1e-9], 3)


class Device:
    """One device on the bus.

    Attributes:
        ready: time from which the device answers [s]; infinite without power.
    """

    def __init__(self, table: ControlTable, device_id: int):
        self.table = table
        self.memory: bytearray | memoryview = bytearray(table.size)
        self.ready = 0.0
        self._id_at, self._baud_at = table["id"].address, table["baud_rate"].address
        self._delay_at = table["return_delay_time"].address
        self._level_at = table["status_return_level"].address
        self._owner: list[Register | None] = [None] * table.size
        for register in table:
            self._owner[register.address : register.end] = [register] * register.size
            if register.initial is not None:
                self.put(register.name, register.initial)
        self.put("id", device_id)

    @property
    def alert(self) -> bool:
        """Whether its answers have the alert bit."""
        return False

    @property
    def protocol(self) -> int:
        """Version of the protocol that it speaks, 1 or 2."""
        return 2

    @property
    def id(self) -> int:
        """Its bus id."""
        return self.memory[self._id_at]

    @property
    def baud(self) -> int:
        """Baud rate [bit/s]; 0 for an invalid register value."""
        return BAUD_RATES.get(self.memory[self._baud_at], 0)

    @property
    def return_delay(self) -> float:
        """Delay before it answers [s]."""
        return self.memory[self._delay_at] * RETURN_DELAY_UNIT

    @property
    def return_level(self) -> int:
        """Which instructions it answers: 0: pings; 1: also reads; 2: all."""
        return self.memory[self._level_at]

    def get(self, name: str) -> int:
        """A register's value."""
        register = self.table[name]
        return register.decode(bytes(self.memory[register.address : register.end]))

    def put(self, name: str, value: int) -> None:
        """Set a register without checking the rules."""
        register = self.table[name]
        self.memory[register.address : register.end] = register.encode(value)

    def ping(self) -> bytes:
        """Model number and firmware version."""
        return self.get("model_number").to_bytes(2, "little") + bytes((self.get("firmware_version"),))

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Error and data of a read; bytes between registers read as zero."""
        if length < 1 or address + length > self.table.size:
            return Error.ACCESS, b""
        return Error.NONE, bytes(self.memory[address : address + length])

    def write(self, address: int, data: bytes) -> int:
        """Write all registers or, if one is refused, none; return the error."""
        register = self.table.at(address)
        if register is None or register.size != len(data):
            return self._write_bytes(range(address, address + len(data)), data)
        return self._write_whole({register: data})

    def _write_bytes(self, targets: Sequence[int], data: bytes) -> int:
        """Write each byte to its address; the bytes must form complete registers."""
        parts: dict[Register, dict[int, int]] = {}
        for target, byte in zip(targets, data, strict=True):
            register = self._owner[target] if target < self.table.size else None
            if register is None:
                return Error.ACCESS
            parts.setdefault(register, {})[target] = byte
        if not parts or any(len(part) != register.size for register, part in parts.items()):
            return Error.DATA_LENGTH
        return self._write_whole({register: bytes(part[at] for at in sorted(part)) for register, part in parts.items()})

    def _write_whole(self, contents: dict[Register, bytes]) -> int:
        values = {register: register.decode(data) for register, data in contents.items()}
        for register, value in values.items():
            if error := self.check(register, value):
                return error
        for register, value in values.items():
            if not self.check(register, value):  # an earlier write may have locked this register
                self.memory[register.address : register.end] = contents[register]
                self.written(register, value)
        return Error.NONE

    def check(self, register: Register, value: int) -> int:
        """The error of writing a value to a register; `Error.NONE` if it may be written."""
        if not register.writable:
            return Error.ACCESS
        return Error.NONE if (register.low or 0) <= value <= (register.high or 0) else Error.DATA_RANGE

    def written(self, register: Register, value: int) -> None:
        """Apply the consequences of a write."""


class OpenCR(Device):
    """IMU, battery voltage, and the power switch of the servos.

    It follows the OP3's board firmware (`opencr_op3`, ROBOTIS-GIT/OpenCR): it supports ping, read, write, sync read,
    sync write and bulk read, but not fast reads or reboots. Writes to read-only bytes are accepted without effect.

    Attributes:
        frozen: whether the IMU has stopped, so that its registers keep their values.
    """

    def __init__(self) -> None:
        super().__init__(OPEN_CR, OPEN_CR_ID)
        self.frozen = False
        self._counts = np.zeros(9)

    @property
    def power(self) -> bool:
        """Whether the servos have power."""
        return self.get("dynamixel_power") == 1

    def feel(self, readings: Sensors, voltage: float) -> None:
        """Store the readings of the sensors, and the battery's voltage [V]."""
        self.memory[_VOLTAGE] = max(0, min(255, round(voltage / VOLTAGE_UNIT)))
        if self.frozen or readings.orientation is None:
            return
        rates, force = readings.angular_velocity, readings.linear_acceleration
        assert rates is not None
        assert force is not None
        counts = self._counts
        counts[:3], counts[3:6], counts[6:] = rates, force, readings.orientation
        counts *= _COUNTS_PER_SI
        np.rint(counts[:6], out=counts[:6])
        np.trunc(counts[6:], out=counts[6:])
        self.memory[_IMU] = counts.clip(-32768, 32767).astype("<i2").tobytes()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Error and data of a read."""
        error, data = super().read(address, length)
        return (Error.DATA_LENGTH, b"") if error else (error, data)

    def write(self, address: int, data: bytes) -> int:
        """Write bytes one by one without checking values; read-only bytes are skipped."""
        if not data or address >= self.table.size:
            return Error.DATA_LENGTH
        for at, byte in enumerate(data, address):
            register = self._owner[at] if at < self.table.size else None
            if register is not None and register.writable:
                self.memory[at] = byte
        return Error.NONE
