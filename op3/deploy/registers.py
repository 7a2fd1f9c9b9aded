"""Registers of the devices on a robot's bus, from `assets/buses`, and the units of a robot's servos."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntFlag
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from op3.common.settings import read_yaml
from op3.robot import Robot, asset_path
from op3.robot.robot_file import BOARD_ID

Array = NDArray[np.float64]

POSITION_ZERO = 2048
"""Encoder reading at joint angle zero."""

OPERATING_MODES = (0, 1, 3, 4, 5, 16)
"""Values of the register `operating_mode`: current, velocity, position, extended and current-based position, PWM."""

CURRENT_MODE = OPERATING_MODES[0]
"""The operating mode for current commands."""

WATCHDOG_UNIT = 0.02
"""Unit of the register `bus_watchdog` [s]."""

RETURN_DELAY_UNIT = 2e-6
"""Unit of the register `return_delay_time` [s]."""

BAUD_RATES: dict[int, int] = dict(
    enumerate((9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000))
)
"""Bits per second by value of a baud rate register."""


@dataclass(frozen=True)
class Register:
    """One entry of a control table.

    Attributes:
        name: name in the manual, in lower case.
        address: address of the first byte.
        size: number of bytes, least significant first.
        initial: factory value; None if the device sets it.
        low: smallest value that may be written; None if it is read-only.
        high: largest value that may be written.
        signed: whether it is in two's complement.
        eeprom: whether it keeps its value without power and can only be written with torque off.
    """

    name: str
    address: int
    size: int
    initial: int | None = None
    low: int | None = None
    high: int | None = None
    signed: bool = False
    eeprom: bool = False

    @property
    def writable(self) -> bool:
        """Whether it can be written."""
        return self.low is not None

    @property
    def end(self) -> int:
        """Address after its last byte."""
        return self.address + self.size

    @property
    def kind(self) -> str:
        """Numpy's name of its type."""
        return f"<{'i' if self.signed else 'u'}{self.size}"

    def encode(self, value: int) -> bytes:
        """The bytes of a value; raises a ValueError if it does not fit."""
        try:
            return int(value).to_bytes(self.size, "little", signed=self.signed or value < 0)
        except OverflowError:
            raise ValueError(f"register {self.name} has {self.size} bytes, which cannot hold {value}") from None

    def decode(self, data: bytes | bytearray) -> int:
        """The value of bytes."""
        return int.from_bytes(data, "little", signed=self.signed)


INDIRECT_COUNT = 28
"""Number of indirect registers in each of the two blocks."""

INDIRECT_TARGETS = (64, 661)
"""Addresses that an indirect address may point at: the RAM area."""


class ControlTable:
    """The registers of one kind of device.

    Args:
        name: name of the file in `assets/buses`.

    Attributes:
        indirect: first address, first data and number of each block of indirect registers.
    """

    def __init__(self, name: str):
        content = read_yaml(asset_path(f"buses/{name}.yaml"))
        self.device, self.size = content["device"], content["size"]
        registers = [Register(name, **entry) for name, entry in content["registers"].items()]
        self.indirect: list[tuple[int, int, int]] = content.get("indirect", [])
        for addresses, data, first in self.indirect:
            for i in range(INDIRECT_COUNT):
                pointer = Register(f"indirect_address_{first + i}", addresses + 2 * i, 2, data + i, *INDIRECT_TARGETS)
                registers += [pointer, Register(f"indirect_data_{first + i}", data + i, 1, 0, 0, 255)]
        self.registers = sorted(registers, key=lambda register: register.address)
        for before, after in pairwise(self.registers):
            if after.address < before.end:
                raise ValueError(f"{self.device}: register {after.name} overlaps {before.name}")
        self._by_name = {register.name: register for register in registers}
        self._by_address = {register.address: register for register in registers}

    def __getitem__(self, name: str) -> Register:
        """The register of this name."""
        if name not in self._by_name:
            raise KeyError(f"the {self.device} has no register {name!r}")
        return self._by_name[name]

    def __iter__(self) -> Iterator[Register]:
        """All registers in the order of their addresses."""
        return iter(self.registers)

    def at(self, address: int) -> Register | None:
        """The register that begins at an address."""
        return self._by_address.get(address)


DYNAMIXEL_X, OPEN_CR = ControlTable("dynamixel-x"), ControlTable("opencr")

FIRST_INDIRECT_ADDRESS = DYNAMIXEL_X["indirect_address_1"].address
FIRST_INDIRECT_DATA = DYNAMIXEL_X["indirect_data_1"].address

OPEN_CR_ID = BOARD_ID
"""Bus id of the OpenCR."""

OPEN_CR_MODEL = 0x7400
"""Model number in its answer to a ping."""

OPEN_CR_AXES = np.array([-1.0, -1.0, 1.0])
"""Factors from the OpenCR's readings of x, y, z (roll, pitch, yaw) to the robot's axes."""


class Units:
    """Size of a register unit of each servo, [joint] in SI units, from the servo files.

    Raises:
        ValueError: if the bus does not support a servo.
    """

    def __init__(self, robot: Robot):
        self.models: dict[str, int] = {}
        for name, make in zip(robot.joints, robot.servos, strict=True):
            if make.bus != "dynamixel-x" or make.model_number is None or make.loop != "current":
                raise ValueError(
                    f"{robot.name}: the bus supports only Dynamixel X servos in current mode, but {name} has a"
                    f" {make.name} (loop: {make.loop}); for other servos import logs (docs/logs.md) or use source=model"
                )
            self.models[name] = make.model_number
        makes = robot.servos
        self.position: Array = np.array([make.position_unit for make in makes])
        self.velocity: Array = np.array([make.unit("velocity") for make in makes])
        self.current: Array = np.array([make.unit("current") for make in makes])
        self.voltage: Array = np.array([make.unit("voltage") for make in makes])
        self.fastest: Array = np.array([make.limits.no_load_speed.si for make in makes])
        self.peak: Array = robot.peak_currents / self.current
        self.continuous = np.array([make.continuous_current for make in makes]) / self.current


class HardwareError(IntFlag):
    """Bits of the registers `hardware_error_status` and `shutdown`."""

    INPUT_VOLTAGE = 0x01
    OVERHEATING = 0x04
    MOTOR_ENCODER = 0x08
    ELECTRICAL_SHOCK = 0x10
    OVERLOAD = 0x20

    @classmethod
    def describe(cls, status: int) -> str:
        """The errors of a status as text; "none" for 0."""
        return ", ".join(str(bit.name).lower().replace("_", " ") for bit in cls if status & bit) or "none"
