"""What all devices on the bus have in common: registers in memory, and the rules for reading and writing them."""

from __future__ import annotations

from op3.deploy.protocol import Error
from op3.deploy.registers import BAUD_RATES, ControlTable, Register

RETURN_DELAY_UNIT = 2e-6
"""Unit of the register `return_delay_time` [s]."""


class Device:
    """One device on the bus.

    Attributes:
        table: its registers.
        memory: their bytes.
        ready: time from which it answers [s]; infinite while it has no power.
        pending: a registered write that waits for an action: address and data.
    """

    def __init__(self, table: ControlTable, device_id: int):
        self.table = table
        self.memory: bytearray | memoryview = bytearray(table.size)
        self.ready = 0.0
        self.pending: tuple[int, bytes] | None = None
        self._slices = {register.name: slice(register.address, register.end) for register in table}
        self._baud_at = table["baud_rate"].address
        self._delay_at = table["return_delay_time"].address
        self._level_at = table["status_return_level"].address
        self._owner: list[Register | None] = [None] * table.size
        for register in table:
            self._owner[register.address : register.end] = [register] * register.size
            if register.initial is not None:
                self.put(register.name, register.initial)
        self.put("id", device_id)

    @property
    def id(self) -> int:
        """Its bus id."""
        return self.get("id")

    @property
    def baud(self) -> int:
        """Speed that it listens at [bit/s]; 0 for a value that is none."""
        return BAUD_RATES.get(self.memory[self._baud_at], 0)

    @property
    def return_delay(self) -> float:
        """Pause that it makes before it answers [s]."""
        return self.memory[self._delay_at] * RETURN_DELAY_UNIT

    @property
    def return_level(self) -> int:
        """Which instructions it answers: 0 pings, 1 reads too, 2 all."""
        return self.memory[self._level_at]

    @property
    def alert(self) -> bool:
        """Whether its answers carry the alert bit."""
        return False

    def get(self, name: str) -> int:
        """A register's value."""
        return int.from_bytes(self.memory[self._slices[name]], "little", signed=self.table[name].signed)

    def put(self, name: str, value: int) -> None:
        """Set a register, whatever the rules say."""
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
        """Write registers; if one of them is refused none is written. Returns the error."""
        register = self.table.at(address)
        if register is None or register.size != len(data):
            return self._write_many(self._targets(address, len(data)), data)
        return self._write_one(register, data)

    def _write_one(self, register: Register, data: bytes) -> int:
        value = register.decode(data)
        error = self.check(register, value)
        if not error:
            self.memory[register.address : register.end] = data
            self.written(register, value)
        return error

    def _targets(self, address: int, length: int) -> list[int]:
        """Where the bytes of a write go."""
        return list(range(address, address + length))

    def _write_many(self, targets: list[int], data: bytes) -> int:
        parts: dict[Register, dict[int, int]] = {}
        for target, byte in zip(targets, data, strict=True):
            register = self._owner[target] if target < self.table.size else None
            if register is None:
                return Error.ACCESS
            parts.setdefault(register, {})[target] = byte
        if not parts or any(len(part) != register.size for register, part in parts.items()):
            return Error.DATA_LENGTH
        whole = {register: bytes(part[at] for at in sorted(part)) for register, part in parts.items()}
        for register, content in whole.items():
            error = self.check(register, register.decode(content))
            if error:
                return error
        for register, content in whole.items():
            self._write_one(register, content)
        return Error.NONE

    def check(self, register: Register, value: int) -> int:
        """The error of writing a value to a register; `Error.NONE` if it may be written."""
        if not register.writable:
            return Error.ACCESS
        if (register.low is not None and value < register.low) or (register.high is not None and value > register.high):
            return Error.DATA_RANGE
        return Error.NONE

    def written(self, register: Register, value: int) -> None:
        """What follows from a write."""
