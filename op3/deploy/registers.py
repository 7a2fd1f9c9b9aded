"""Register tables of the devices on the OP3's bus, as data.

`XM430_W350`: ROBOTIS e-Manual, "XM430-W350", control tables of the EEPROM and the RAM area. `OPEN_CR`: the OP3's
firmware of the OpenCR board (`opencr_op3`, ROBOTIS-GIT/OpenCR). Units are those of the registers; `Register.to_si` and
`Register.from_si` convert.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from op3.robot.units import (
    ACCELERATION_UNIT,
    ANGLE_UNIT,
    CURRENT_UNIT,
    GYRO_UNIT,
    POSITION_UNIT,
    VELOCITY_UNIT,
    VOLTAGE_UNIT,
)

POSITION_ZERO = 2048
"""Reading of the encoder where the OP3's joint angle is zero."""

PWM_UNIT = 1 / 885
"""One unit of PWM, as a duty cycle."""

BAUD_RATES: dict[int, int] = {
    0: 9600,
    1: 57600,
    2: 115200,
    3: 1_000_000,
    4: 2_000_000,
    5: 3_000_000,
    6: 4_000_000,
    7: 4_500_000,
}
"""Bits per second by value of a baud rate register."""


@dataclass(frozen=True)
class Register:
    """One entry of a control table.

    Attributes:
        name: as in the manual, in lower case.
        address: of its first byte.
        size: bytes, least significant first.
        signed: whether it is in two's complement.
        writable: whether it may be written at all.
        eeprom: whether it outlives power and can be written only with torque off.
        initial: factory value; None where the device fills it in.
        low: smallest value that may be written; None where there is no bound.
        high: largest value that may be written.
        scale: SI units per unit of the register.
        zero: the register's value at zero SI.
        unit: SI unit, "-" for a number without one.
    """

    name: str
    address: int
    size: int
    signed: bool = False
    writable: bool = False
    eeprom: bool = False
    initial: int | None = None
    low: int | None = None
    high: int | None = None
    scale: float = 1.0
    zero: int = 0
    unit: str = "-"

    @property
    def end(self) -> int:
        """Address behind its last byte."""
        return self.address + self.size

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

    def to_si(self, value: Any) -> Any:
        """A register's value in `unit`; of a number, or of every number in an array."""
        return (value - self.zero) * self.scale

    def from_si(self, value: float) -> int:
        """The nearest register value to a number in `unit`."""
        return round(value / self.scale) + self.zero


@dataclass(frozen=True)
class ControlTable:
    """The registers of one kind of device.

    Attributes:
        device: what it is called.
        model_number: what it answers to a ping.
        size: addresses from 0 to below this one can be read.
        registers: in the order of their addresses.
    """

    device: str
    model_number: int
    size: int
    registers: tuple[Register, ...]

    def __post_init__(self):
        for before, after in zip(self.registers, self.registers[1:], strict=False):
            if after.address < before.end:
                raise ValueError(f"{self.device}: register {after.name} overlaps {before.name}")
        object.__setattr__(self, "_by_name", {register.name: register for register in self.registers})
        object.__setattr__(self, "_by_address", {register.address: register for register in self.registers})

    def __getitem__(self, name: str) -> Register:
        """The register of this name.

        Raises:
            KeyError: if there is none.
        """
        try:
            return self._by_name[name]  # type: ignore[attr-defined]
        except KeyError:
            raise KeyError(f"the {self.device} has no register {name!r}") from None

    def __iter__(self) -> Iterator[Register]:
        """All registers in the order of their addresses."""
        return iter(self.registers)

    def at(self, address: int) -> Register | None:
        """The register that begins at an address."""
        return self._by_address.get(address)  # type: ignore[attr-defined]


def _ro(name: str, address: int, size: int, initial: int | None = None, **extra: Any) -> Register:
    return Register(name, address, size, initial=initial, **extra)


def _rw(name: str, address: int, size: int, initial: int, low: int, high: int, **extra: Any) -> Register:
    return Register(name, address, size, writable=True, initial=initial, low=low, high=high, **extra)


def _rom(name: str, address: int, size: int, initial: int, low: int, high: int, **extra: Any) -> Register:
    return _rw(name, address, size, initial, low, high, eeprom=True, **extra)


_TURN: dict[str, Any] = {"scale": POSITION_UNIT, "unit": "rad"}
_ANGLE: dict[str, Any] = {**_TURN, "zero": POSITION_ZERO}
_SPEED: dict[str, Any] = {"scale": VELOCITY_UNIT, "unit": "rad/s"}
_AMPERE: dict[str, Any] = {"scale": CURRENT_UNIT, "unit": "A"}
_DUTY: dict[str, Any] = {"scale": PWM_UNIT}
_VOLT: dict[str, Any] = {"scale": VOLTAGE_UNIT, "unit": "V"}
_CELSIUS: dict[str, Any] = {"unit": "C"}
_REV = 1_048_575
"""Farthest goal of extended position control, 256 turns."""

FIRST_INDIRECT_ADDRESS, FIRST_INDIRECT_DATA = 168, 224
SECOND_INDIRECT_ADDRESS, SECOND_INDIRECT_DATA = 578, 634
INDIRECT_COUNT = 28
"""Indirect registers come in two blocks of this many."""

INDIRECT_TARGETS = (64, 661)
"""Addresses that an indirect address may point at: the RAM area."""


def _indirect(first_address: int, first_data: int, first_number: int) -> Iterator[Register]:
    low, high = INDIRECT_TARGETS
    for index in range(INDIRECT_COUNT):
        name = f"indirect_address_{first_number + index}"
        yield _rw(name, first_address + 2 * index, 2, first_data + index, low, high)
    for index in range(INDIRECT_COUNT):
        yield _rw(f"indirect_data_{first_number + index}", first_data + index, 1, 0, 0, 255)


XM430_W350 = ControlTable(
    device="XM430-W350",
    model_number=1020,
    size=662,
    registers=(
        _ro("model_number", 0, 2, 1020),
        _ro("model_information", 2, 4, 0),
        _ro("firmware_version", 6, 1, 45),
        _rom("id", 7, 1, 1, 0, 252),
        _rom("baud_rate", 8, 1, 1, 0, 7),
        _rom("return_delay_time", 9, 1, 250, 0, 254, scale=2e-6, unit="s"),
        _rom("drive_mode", 10, 1, 0, 0, 5),
        _rom("operating_mode", 11, 1, 3, 0, 16),
        _rom("secondary_id", 12, 1, 255, 0, 255),
        _rom("protocol_version", 13, 1, 2, 1, 2),
        _rom("homing_offset", 20, 4, 0, -1_044_479, 1_044_479, signed=True, **_TURN),
        _rom("moving_threshold", 24, 4, 10, 0, 1023, **_SPEED),
        _rom("temperature_limit", 31, 1, 80, 0, 100, **_CELSIUS),
        _rom("max_voltage_limit", 32, 2, 160, 95, 160, **_VOLT),
        _rom("min_voltage_limit", 34, 2, 95, 95, 160, **_VOLT),
        _rom("pwm_limit", 36, 2, 885, 0, 885, **_DUTY),
        _rom("current_limit", 38, 2, 1193, 0, 1193, **_AMPERE),
        _rom("acceleration_limit", 40, 4, 32767, 0, 32767),
        _rom("velocity_limit", 44, 4, 350, 0, 1023, **_SPEED),
        _rom("max_position_limit", 48, 4, 4095, 0, 4095, **_ANGLE),
        _rom("min_position_limit", 52, 4, 0, 0, 4095, **_ANGLE),
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
        _rw("bus_watchdog", 98, 1, 0, 0, 127, signed=True, scale=0.02, unit="s"),
        _rw("goal_pwm", 100, 2, 885, -885, 885, signed=True, **_DUTY),
        _rw("goal_current", 102, 2, 1193, -1193, 1193, signed=True, **_AMPERE),
        _rw("goal_velocity", 104, 4, 0, -1023, 1023, signed=True, **_SPEED),
        _rw("profile_acceleration", 108, 4, 0, 0, 32767),
        _rw("profile_velocity", 112, 4, 0, 0, 32767, **_SPEED),
        _rw("goal_position", 116, 4, 0, -_REV, _REV, signed=True, **_ANGLE),
        _ro("realtime_tick", 120, 2, scale=1e-3, unit="s"),
        _ro("moving", 122, 1, 0),
        _ro("moving_status", 123, 1, 0),
        _ro("present_pwm", 124, 2, signed=True, **_DUTY),
        _ro("present_current", 126, 2, signed=True, **_AMPERE),
        _ro("present_velocity", 128, 4, signed=True, **_SPEED),
        _ro("present_position", 132, 4, signed=True, **_ANGLE),
        _ro("velocity_trajectory", 136, 4, signed=True, **_SPEED),
        _ro("position_trajectory", 140, 4, signed=True, **_ANGLE),
        _ro("present_input_voltage", 144, 2, **_VOLT),
        _ro("present_temperature", 146, 1, **_CELSIUS),
        *_indirect(FIRST_INDIRECT_ADDRESS, FIRST_INDIRECT_DATA, 1),
        *_indirect(SECOND_INDIRECT_ADDRESS, SECOND_INDIRECT_DATA, 29),
    ),
)
"""The OP3's servo. Firmware 45 is the first with fast reads; bounds that depend on other registers are not here."""

_GYRO: dict[str, Any] = {"signed": True, "scale": GYRO_UNIT, "unit": "rad/s"}
_ACCELERATION: dict[str, Any] = {"signed": True, "scale": ACCELERATION_UNIT, "unit": "m/s^2"}
_TILT: dict[str, Any] = {"signed": True, "scale": ANGLE_UNIT, "unit": "rad"}

OPEN_CR = ControlTable(
    device="OpenCR",
    model_number=0x7400,
    size=51,
    registers=(
        _ro("model_number", 0, 2, 0x7400),
        _ro("firmware_version", 2, 1, 2),
        _rom("id", 3, 1, 200, 0, 252),
        _rom("baud_rate", 4, 1, 4, 0, 7),
        _rom("return_delay_time", 5, 1, 0, 0, 254, scale=2e-6, unit="s"),
        _rom("status_return_level", 16, 1, 2, 0, 2),
        _rom("roll_offset", 18, 2, 0, -32768, 32767, **_TILT),
        _rom("pitch_offset", 20, 2, 0, -32768, 32767, **_TILT),
        _rom("yaw_offset", 22, 2, 0, -32768, 32767, **_TILT),
        _rw("dynamixel_power", 24, 1, 0, 0, 1),
        _rw("led", 25, 1, 0, 0, 7),
        _rw("led_rgb", 26, 2, 0x1F, 0, 32767),
        _rw("buzzer", 28, 2, 0, 0, 65535),
        _ro("button", 30, 1, 0),
        _ro("present_voltage", 31, 1, **_VOLT),
        _ro("gyro_x", 32, 2, **_GYRO),
        _ro("gyro_y", 34, 2, **_GYRO),
        _ro("gyro_z", 36, 2, **_GYRO),
        _ro("acceleration_x", 38, 2, **_ACCELERATION),
        _ro("acceleration_y", 40, 2, **_ACCELERATION),
        _ro("acceleration_z", 42, 2, **_ACCELERATION),
        _ro("roll", 44, 2, **_TILT),
        _ro("pitch", 46, 2, **_TILT),
        _ro("yaw", 48, 2, **_TILT),
        _rw("imu_control", 50, 1, 0, 0, 15),
    ),
)
"""The OP3's IMU and power board. Its axes: x and y of the robot are minus its own, z is the same."""

OPEN_CR_ID = 200
"""Bus id of the OpenCR."""

OPEN_CR_AXES = np.array([-1.0, -1.0, 1.0])
"""Factors from the OpenCR's readings of x, y, z (roll, pitch, yaw) to the robot's axes."""


class OperatingMode:
    """Values of the register `operating_mode`."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16

    ALL = (CURRENT, VELOCITY, POSITION, EXTENDED_POSITION, CURRENT_BASED_POSITION, PWM)


class HardwareError:
    """Bits of the registers `hardware_error_status` and `shutdown`."""

    INPUT_VOLTAGE = 0x01
    OVERHEATING = 0x04
    MOTOR_ENCODER = 0x08
    ELECTRICAL_SHOCK = 0x10
    OVERLOAD = 0x20

    NAMES: dict[int, str] = {
        INPUT_VOLTAGE: "input voltage",
        OVERHEATING: "overheating",
        MOTOR_ENCODER: "motor encoder",
        ELECTRICAL_SHOCK: "electrical shock",
        OVERLOAD: "overload",
    }

    @classmethod
    def describe(cls, status: int) -> str:
        """The errors of a status in words; "none" for 0."""
        return ", ".join(name for bit, name in cls.NAMES.items() if status & bit) or "none"
