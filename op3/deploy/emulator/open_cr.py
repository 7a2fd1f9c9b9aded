"""The OpenCR: IMU, buttons, battery voltage, and the switch that gives the servos power.

After the OP3's firmware of the board (`opencr_op3`, ROBOTIS-GIT/OpenCR): it answers pings, reads and writes, sync and
bulk ones too, and no fast reads, registered writes, reboots or resets; writes to read-only bytes are accepted and do
nothing.
"""

from __future__ import annotations

import numpy as np

from op3.deploy.emulator.device import Device
from op3.deploy.emulator.physics import Readings
from op3.deploy.protocol import Error, Instruction
from op3.deploy.registers import OPEN_CR, OPEN_CR_AXES, OPEN_CR_ID, Register
from op3.robot.units import ACCELERATION_UNIT, ANGLE_UNIT, GYRO_UNIT

INSTRUCTIONS = (
    Instruction.PING,
    Instruction.READ,
    Instruction.WRITE,
    Instruction.SYNC_READ,
    Instruction.SYNC_WRITE,
    Instruction.BULK_READ,
    Instruction.BULK_WRITE,
)
"""What the board understands."""

BUTTONS: tuple[str, ...] = ("mode", "start", "user", "reset")
"""Names of the buttons by their bit. Held for 0.1 s, the last one cuts the servos' power."""

_IMU = slice(32, 50)
_VOLTAGE, _BUTTON = 31, 30

_UNITS = np.repeat([GYRO_UNIT, ACCELERATION_UNIT, ANGLE_UNIT], 3)
# The firmware cuts off the fraction of an angle; a reading on the grid must not fall below it by rounding.
_COUNTS_PER_SI = np.tile(OPEN_CR_AXES, 3) / _UNITS * np.repeat([1.0, 1.0, 1 + 1e-9], 3)


class OpenCR(Device):
    """The board's registers.

    Attributes:
        frozen: whether the IMU has stopped; its registers keep what they hold.
    """

    def __init__(self) -> None:
        super().__init__(OPEN_CR, OPEN_CR_ID)
        self.frozen = False
        self._counts = np.zeros(9)

    @property
    def power(self) -> bool:
        """Whether the servos have power."""
        return self.get("dynamixel_power") == 1

    def press(self, button: str, held: bool) -> None:
        """Hold a button, or let go of it.

        Raises:
            ValueError: if there is no such button.
        """
        if button not in BUTTONS:
            raise ValueError(f"there is no button {button!r}; the buttons are {', '.join(BUTTONS)}")
        bit = 1 << BUTTONS.index(button)
        self.memory[_BUTTON] = self.memory[_BUTTON] | bit if held else self.memory[_BUTTON] & ~bit

    def feel(self, readings: Readings, voltage: float) -> None:
        """Take what the sensors say, and the battery's voltage [V]."""
        self.memory[_VOLTAGE] = max(0, min(255, round(voltage * 10)))
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
        np.minimum(np.maximum(counts, -32768, out=counts), 32767, out=counts)
        self.memory[_IMU] = counts.astype("<i2").tobytes()

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Error and data of a read."""
        error, data = super().read(address, length)
        return (Error.DATA_LENGTH, b"") if error else (error, data)

    def write(self, address: int, data: bytes) -> int:
        """Write bytes one by one, leaving out those that are read-only."""
        if not data or address >= self.table.size:
            return Error.DATA_LENGTH
        for at, byte in enumerate(data, address):
            register = self._owner[at] if at < self.table.size else None
            if register is not None and register.writable:
                self.memory[at] = byte
        return Error.NONE

    def check(self, register: Register, value: int) -> int:
        """The board checks no values."""
        return Error.NONE
