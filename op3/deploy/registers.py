"""Register tables of the devices on a robot's bus, as data, and the units of a robot's servos.

`DYNAMIXEL_X`: ROBOTIS e-Manual, "XM430-W350", control tables of the EEPROM and the RAM area; the XM430-W210 has the
same. `OPEN_CR`: the OP3's firmware of the OpenCR board (`opencr_op3`, ROBOTIS-GIT/OpenCR).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from op3.robot import Robot
from op3.robot.robot_file import BOARD_ID

Array = NDArray[np.float64]

POSITION_ZERO = 2048
"""Reading of the encoder where a joint's angle is zero."""

PWM_UNIT = 1 / 885
"""One unit of PWM, as a duty cycle."""

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
        name: as in the manual, in lower case.
        address: of its first byte.
        size: bytes, least significant first.
        initial: factory value; None where the device fills it in.
        low: smallest value that may be written; None where there is no bound.
        high: largest value that may be written.
        signed: whether it is in two's complement.
        writable: whether it may be written at all.
        eeprom: whether it outlives power and can be written only with torque off.
    """

    name: str
    address: int
    size: int
    initial: int | None = None
    low: int | None = None
    high: int | None = None
    signed: bool = False
    writable: bool = False
    eeprom: bool = False

    @property
    def end(self) -> int:
        """Address behind its last byte."""
        return self.address + self.size

    @property
    def kind(self) -> str:
        """Numpy's name of its type."""
        return f"<{'i' if self.signed else 'u'}{self.size}"

    def encode(self, value: int) -> bytes:
        """The bytes of a value.

        Raises:
            ValueError: if it does not fit.
        """
        try:
            return int(value).to_bytes(self.size, "little", signed=self.signed or value < 0)
        except OverflowError:
            raise ValueError(f"register {self.name} has {self.size} bytes, which cannot hold {value}") from None

    def decode(self, data: bytes | bytearray) -> int:
        """The value of bytes."""
        return int.from_bytes(data, "little", signed=self.signed)


class ControlTable:
    """The registers of one kind of device.

    Args:
        device: what it is called.
        size: addresses from 0 to below this one can be read.
        registers: in the order of their addresses.
    """

    def __init__(self, device: str, size: int, *registers: Register):
        for before, after in pairwise(registers):
            if after.address < before.end:
                raise ValueError(f"{device}: register {after.name} overlaps {before.name}")
        self.device, self.size, self.registers = device, size, registers
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


def _ro(name: str, address: int, size: int, initial: int | None = None, **extra: Any) -> Register:
    return Register(name, address, size, initial, **extra)


def _rw(name: str, address: int, size: int, initial: int, low: int, high: int, **extra: Any) -> Register:
    return Register(name, address, size, initial, low, high, signed=low < 0, writable=True, **extra)


def _rom(name: str, address: int, size: int, initial: int, low: int, high: int) -> Register:
    return _rw(name, address, size, initial, low, high, eeprom=True)


_REV = 1_048_575
"""Farthest goal of extended position control, 256 turns."""

FIRST_INDIRECT_ADDRESS, FIRST_INDIRECT_DATA = 168, 224
SECOND_INDIRECT_ADDRESS, SECOND_INDIRECT_DATA = 578, 634
INDIRECT_COUNT = 28
"""Indirect registers come in two blocks of this many."""

INDIRECT_TARGETS = (64, 661)
"""Addresses that an indirect address may point at: the RAM area."""


def _indirect(first_address: int, first_data: int, first_number: int) -> Iterator[Register]:
    numbers = range(INDIRECT_COUNT)
    for i in numbers:
        name = f"indirect_address_{first_number + i}"
        yield _rw(name, first_address + 2 * i, 2, first_data + i, *INDIRECT_TARGETS)
    yield from (_rw(f"indirect_data_{first_number + i}", first_data + i, 1, 0, 0, 255) for i in numbers)


DYNAMIXEL_X = ControlTable(
    "Dynamixel X servo",
    662,
    _ro("model_number", 0, 2, 1020),
    _ro("model_information", 2, 4, 0),
    _ro("firmware_version", 6, 1, 45),
    _rom("id", 7, 1, 1, 0, 252),
    _rom("baud_rate", 8, 1, 1, 0, 7),
    _rom("return_delay_time", 9, 1, 250, 0, 254),
    _rom("drive_mode", 10, 1, 0, 0, 5),
    _rom("operating_mode", 11, 1, 3, 0, 16),
    _rom("secondary_id", 12, 1, 255, 0, 255),
    _rom("protocol_version", 13, 1, 2, 1, 2),
    _rom("homing_offset", 20, 4, 0, -1_044_479, 1_044_479),
    _rom("moving_threshold", 24, 4, 10, 0, 1023),
    _rom("temperature_limit", 31, 1, 80, 0, 100),
    _rom("max_voltage_limit", 32, 2, 160, 95, 160),
    _rom("min_voltage_limit", 34, 2, 95, 95, 160),
    _rom("pwm_limit", 36, 2, 885, 0, 885),
    _rom("current_limit", 38, 2, 1193, 0, 1193),
    _rom("acceleration_limit", 40, 4, 32767, 0, 32767),
    _rom("velocity_limit", 44, 4, 350, 0, 1023),
    _rom("max_position_limit", 48, 4, 4095, 0, 4095),
    _rom("min_position_limit", 52, 4, 0, 0, 4095),
    _rom("shutdown", 63, 1, 52, 0, 255),
    _rw("torque_enable", 64, 1, 0, 0, 1),
    _rw("led", 65, 1, 0, 0, 1),
    _rw("status_return_level", 68, 1, 2, 0, 2),
    _ro("registered_instruction", 69, 1, 0),
    _ro("hardware_error_status", 70, 1, 0),
    _rw("velocity_i_gain", 76, 2, 1920, 0, 16383),
    _rw("velocity_p_gain", 78, 2, 100, 0, 16383),
    _rw("position_d_gain", 80, 2, 0, 0, 16383),
    _rw("position_i_gain", 82, 2, 0, 0, 16383),
    _rw("position_p_gain", 84, 2, 800, 0, 16383),
    _rw("feedforward_2nd_gain", 88, 2, 0, 0, 16383),
    _rw("feedforward_1st_gain", 90, 2, 0, 0, 16383),
    Register("bus_watchdog", 98, 1, 0, 0, 127, signed=True, writable=True),
    _rw("goal_pwm", 100, 2, 885, -885, 885),
    _rw("goal_current", 102, 2, 1193, -1193, 1193),
    _rw("goal_velocity", 104, 4, 0, -1023, 1023),
    _rw("profile_acceleration", 108, 4, 0, 0, 32767),
    _rw("profile_velocity", 112, 4, 0, 0, 32767),
    _rw("goal_position", 116, 4, 0, -_REV, _REV),
    _ro("realtime_tick", 120, 2),
    _ro("moving", 122, 1, 0),
    _ro("moving_status", 123, 1, 0),
    _ro("present_pwm", 124, 2, signed=True),
    _ro("present_current", 126, 2, signed=True),
    _ro("present_velocity", 128, 4, signed=True),
    _ro("present_position", 132, 4, signed=True),
    _ro("velocity_trajectory", 136, 4, signed=True),
    _ro("position_trajectory", 140, 4, signed=True),
    _ro("present_input_voltage", 144, 2),
    _ro("present_temperature", 146, 1),
    *_indirect(FIRST_INDIRECT_ADDRESS, FIRST_INDIRECT_DATA, 1),
    *_indirect(SECOND_INDIRECT_ADDRESS, SECOND_INDIRECT_DATA, 29),
)
"""Firmware 45 is the first with fast reads; bounds that depend on other registers are not here."""

OPEN_CR = ControlTable(
    "OpenCR",
    51,
    _ro("model_number", 0, 2, 0x7400),
    _ro("firmware_version", 2, 1, 2),
    _rom("id", 3, 1, BOARD_ID, 0, 252),
    _rom("baud_rate", 4, 1, 4, 0, 7),
    _rom("return_delay_time", 5, 1, 0, 0, 254),
    _rom("status_return_level", 16, 1, 2, 0, 2),
    _rom("roll_offset", 18, 2, 0, -32768, 32767),
    _rom("pitch_offset", 20, 2, 0, -32768, 32767),
    _rom("yaw_offset", 22, 2, 0, -32768, 32767),
    _rw("dynamixel_power", 24, 1, 0, 0, 1),
    _rw("led", 25, 1, 0, 0, 7),
    _rw("led_rgb", 26, 2, 0x1F, 0, 32767),
    _rw("buzzer", 28, 2, 0, 0, 65535),
    _ro("button", 30, 1, 0),
    _ro("present_voltage", 31, 1),
    *(_ro(f"gyro_{axis}", 32 + 2 * i, 2, signed=True) for i, axis in enumerate("xyz")),
    *(_ro(f"acceleration_{axis}", 38 + 2 * i, 2, signed=True) for i, axis in enumerate("xyz")),
    *(_ro(axis, 44 + 2 * i, 2, signed=True) for i, axis in enumerate(("roll", "pitch", "yaw"))),
    _rw("imu_control", 50, 1, 0, 0, 15),
)
"""The OP3's IMU and power board."""

OPEN_CR_ID = BOARD_ID
"""Bus id of the OpenCR."""

OPEN_CR_MODEL = 0x7400
"""What it answers to a ping."""

OPEN_CR_AXES = np.array([-1.0, -1.0, 1.0])
"""Factors from the OpenCR's readings of x, y, z (roll, pitch, yaw) to the robot's axes."""


class Units:
    """What one unit of a register of each servo is worth, [joint] in SI, as their makes' files say.

    Args:
        robot: whose servos they are.

    Raises:
        ValueError: if a make is not one of those that the bus knows.
    """

    def __init__(self, robot: Robot):
        self.models: dict[str, int] = {}
        for name, make in zip(robot.joints, robot.servos, strict=True):
            if make.bus != "dynamixel-x" or make.model_number is None:
                raise ValueError(
                    f"{robot.name}: the bus speaks to Dynamixel X servos in current mode, and the {make.name} of {name}"
                    " is none; for other servos bring logs (docs/logs.md), or play the robot with source=model"
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


class OperatingMode(IntEnum):
    """Values of the register `operating_mode`."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16


class HardwareError(IntFlag):
    """Bits of the registers `hardware_error_status` and `shutdown`."""

    INPUT_VOLTAGE = 0x01
    OVERHEATING = 0x04
    MOTOR_ENCODER = 0x08
    ELECTRICAL_SHOCK = 0x10
    OVERLOAD = 0x20

    @classmethod
    def describe(cls, status: int) -> str:
        """The errors of a status in words; "none" for 0."""
        return ", ".join(str(bit.name).lower().replace("_", " ") for bit in cls if status & bit) or "none"
