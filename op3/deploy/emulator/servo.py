"""One XM430: what its registers do when they are written, and when something goes wrong.

Rules of the ROBOTIS e-Manual ("XM430-W350", "DYNAMIXEL Protocol 2.0"). What it leaves open is decided for the worse of
the plausible behaviours, and marked (inferred).
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from struct import unpack_from

from op3.deploy.emulator.device import Device
from op3.deploy.emulator.firmware import Firmware
from op3.deploy.protocol import Error
from op3.deploy.registers import (
    DYNAMIXEL_X,
    FIRST_INDIRECT_ADDRESS,
    FIRST_INDIRECT_DATA,
    INDIRECT_COUNT,
    WATCHDOG_UNIT,
    OperatingMode,
    Register,
)

BOOT_TIME = 0.08
"""From power or a reboot to the first answer [s] (inferred: ROBOTIS' op3_manager waits 0.1 s)."""

WATCHDOG_ERROR = -1
"""Value of `bus_watchdog` once it has tripped."""

_GOALS = ("goal_pwm", "goal_current", "goal_velocity", "goal_position")
_GAINS = ("position_p_gain", "position_i_gain", "position_d_gain", "velocity_p_gain", "velocity_i_gain")
_FIRMWARE = {*_GOALS, *_GAINS, "profile_velocity", "torque_enable", "operating_mode", "current_limit", "pwm_limit"}
_RESET_BY_MODE = (*_GAINS, "feedforward_1st_gain", "feedforward_2nd_gain", "profile_velocity", "profile_acceleration")
_GOAL_CURRENT, _CURRENT_LIMIT = DYNAMIXEL_X["goal_current"].address, DYNAMIXEL_X["current_limit"].address
_FULL_CURRENT = DYNAMIXEL_X["goal_current"].high or 0
_MODE, _WATCHDOG = DYNAMIXEL_X["operating_mode"].address, DYNAMIXEL_X["bus_watchdog"].address
_PROTOCOL = DYNAMIXEL_X["protocol_version"].address
_TORQUE, _HARDWARE_ERROR = DYNAMIXEL_X["torque_enable"].address, DYNAMIXEL_X["hardware_error_status"].address
_END_FIRST_DATA = FIRST_INDIRECT_DATA + INDIRECT_COUNT


class Servo(Device):
    """One servo's registers.

    Args:
        index: its place in the firmware's arrays.
        firmware: the control loops of all servos, which this one's registers feed.
        settings: values of its EEPROM, by register name, where they differ from the factory's.

    Attributes:
        watchdog: time without packets after which the servo frees itself [s]; infinite while it is off.
        booted: when it last got power or was told to reboot [s].
        measure: brings the registers that hold measurements up to date.
    """

    def __init__(self, device_id: int, index: int, firmware: Firmware, model: int, settings: dict[str, int]):
        super().__init__(DYNAMIXEL_X, device_id)
        self.put("model_number", model)
        self.index = index
        self._firmware = firmware
        for name, value in settings.items():
            if not self.table[name].eeprom:
                raise ValueError(f"servo settings are registers of the EEPROM, but {name} is not one")
            self.put(name, value)
        self.ready = inf
        self.watchdog = inf
        self.booted = 0.0
        self.measure: Callable[[], None] = lambda: None
        self._looked_up = b"", 0, 0
        self._places: tuple[int, ...] = ()

    @property
    def alert(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether there is a hardware error."""
        return self.memory[_HARDWARE_ERROR] != 0

    @property
    def protocol(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Version that it speaks; of 1.0 it knows pings alone."""
        return self.memory[_PROTOCOL]

    @property
    def torque(self) -> bool:
        """Whether torque is enabled."""
        return self.memory[_TORQUE] != 0

    def power(self, on: bool, now: float) -> None:
        """Give it power, or take it away: the RAM area forgets everything, indirect addresses and errors too."""
        self.ready = now + BOOT_TIME if on else inf
        self.booted = now if on else self.booted
        for register in self.table:
            if register.address >= 64 and register.initial is not None:
                self.put(register.name, register.initial)
        self.put("goal_current", self.get("current_limit"))
        self.put("goal_pwm", self.get("pwm_limit"))
        self.watchdog = inf
        self._inform()

    def fail(self, error: int) -> None:
        """A hardware error: it stays until a reboot, and shuts the servo down if `shutdown` says so."""
        self.memory[_HARDWARE_ERROR] |= error
        if self.memory[_HARDWARE_ERROR] & self.get("shutdown"):
            self.memory[_TORQUE] = 0
            self._inform()

    def trip(self) -> None:
        """The bus has been silent for too long: free-running, with goals that are read-only until it is cleared."""
        self.put("bus_watchdog", WATCHDOG_ERROR)
        self.watchdog = inf
        self._inform()

    def _inform(self) -> None:
        self._firmware.load(self.index, self.get, tripped=self.get("bus_watchdog") == WATCHDOG_ERROR)

    def _pointed(self, address: int) -> int:
        """Where an address of indirect data points; any other address points at itself."""
        for pointers, data, _ in self.table.indirect:
            if data <= address < data + INDIRECT_COUNT:
                at = pointers + 2 * (address - data)
                return self.memory[at] | self.memory[at + 1] << 8
        return address

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Error and data of a read, through indirect addresses where there are any."""
        end = address + length
        if length < 1 or end > self.table.size:
            return Error.ACCESS, b""
        if end <= FIRST_INDIRECT_DATA:
            return Error.NONE, bytes(self.memory[address:end])
        if end <= _END_FIRST_DATA and address >= FIRST_INDIRECT_DATA:
            return Error.NONE, self._read_first_block(address - FIRST_INDIRECT_DATA, length)
        memory = self.memory
        return Error.NONE, bytes([memory[self._pointed(at)] for at in range(address, end)])

    def _read_first_block(self, first: int, length: int) -> bytes:
        """The same, for the block that is read in every tick: where its bytes lie is looked up once."""
        pointers = bytes(self.memory[FIRST_INDIRECT_ADDRESS:FIRST_INDIRECT_DATA])
        if (pointers, first, length) != self._looked_up:
            self._looked_up = pointers, first, length
            self._places = unpack_from(f"<{length}H", pointers, 2 * first)
        memory = self.memory
        return bytes([memory[at] for at in self._places])

    def write(self, address: int, data: bytes) -> int:
        """Write registers; if one of them is refused none is written. Returns the error."""
        if address == _GOAL_CURRENT and len(data) == 2 and self.memory[_MODE] == OperatingMode.CURRENT:
            return self._write_goal_current(data)
        if address + len(data) > FIRST_INDIRECT_DATA:
            return self._write_bytes([self._pointed(at) for at in range(address, address + len(data))], data)
        return super().write(address, data)

    def _write_goal_current(self, data: bytes) -> int:
        """The same as any write, for the one register that is written in every tick."""
        value = int.from_bytes(data, "little", signed=True)
        memory = self.memory
        if memory[_WATCHDOG] == 0xFF or not -_FULL_CURRENT <= value <= _FULL_CURRENT:
            return Error.DATA_RANGE
        if abs(value) > (memory[_CURRENT_LIMIT] | memory[_CURRENT_LIMIT + 1] << 8):
            return Error.DATA_LIMIT
        memory[_GOAL_CURRENT : _GOAL_CURRENT + 2] = data
        self._firmware.set_goal_current(self.index, value)
        return Error.NONE

    def check(self, register: Register, value: int) -> int:
        """The error of writing a value to a register; `Error.NONE` if it may be written."""
        name = register.name
        if register.eeprom and self.torque:
            return Error.ACCESS
        if error := super().check(register, value):
            return error
        tripped = self.get("bus_watchdog") == WATCHDOG_ERROR
        if tripped and (name in _GOALS or (name == "bus_watchdog" and value != 0)):
            return Error.DATA_RANGE
        if name == "operating_mode" and value not in set(OperatingMode):
            return Error.DATA_RANGE
        if name == "torque_enable" and value and self.memory[_HARDWARE_ERROR] & self.get("shutdown"):
            return Error.RESULT_FAIL  # (inferred) only a reboot brings torque back; the manual names no error
        return self._check_limit(name, value)

    def _check_limit(self, name: str, value: int) -> int:
        if name in ("goal_current", "goal_pwm", "goal_velocity"):
            beyond = abs(value) > self.get(f"{name.removeprefix('goal_')}_limit")
        elif name == "goal_position" and self.get("operating_mode") == OperatingMode.POSITION:
            beyond = not self.get("min_position_limit") <= value <= self.get("max_position_limit")
        else:
            beyond = False
        return Error.DATA_LIMIT if beyond else Error.NONE

    def written(self, register: Register, value: int) -> None:
        """What follows from a write."""
        name = register.name
        if name == "operating_mode":
            # (inferred) also where the mode stays as it was; the manual speaks of switching
            for other in _RESET_BY_MODE:
                self.put(other, self.table[other].initial or 0)
            self.put("goal_pwm", self.get("pwm_limit"))
            self.put("goal_current", self.get("current_limit"))
        elif name == "torque_enable" and value and not self._firmware.enabled[self.index]:
            # (inferred) a position servo holds where it is when it is switched on
            self.measure()
            self.put("goal_position", self.get("present_position"))
            self.put("goal_velocity", 0)
        elif name == "bus_watchdog":
            self.watchdog = value * WATCHDOG_UNIT if value else inf
        if register.eeprom or name in _FIRMWARE or name == "bus_watchdog":
            self._inform()
