"""One Dynamixel X servo: effects of writes to its registers, and of faults.

Rules of the ROBOTIS e-Manual ("XM430-W350", "DYNAMIXEL Protocol 2.0"). Where it is silent, the worst plausible
behaviour is assumed and marked (inferred). Only current control drives the motor: in another mode it runs free.
"""

from __future__ import annotations

from math import inf

from op3.deploy.emulator.device import Device
from op3.deploy.protocol import Error
from op3.deploy.registers import (
    DYNAMIXEL_X,
    FIRST_INDIRECT_DATA,
    INDIRECT_COUNT,
    OPERATING_MODES,
    WATCHDOG_UNIT,
    Register,
)

BOOT_TIME = 0.08
"""Time from power-on or reboot to the first answer [s] (inferred: ROBOTIS' op3_manager waits 0.1 s)."""

WATCHDOG_ERROR = -1
"""Value of `bus_watchdog` once it has tripped."""

_GOALS = ("goal_pwm", "goal_current", "goal_velocity", "goal_position")
_PROTOCOL = DYNAMIXEL_X["protocol_version"].address
_TORQUE, _HARDWARE_ERROR = DYNAMIXEL_X["torque_enable"].address, DYNAMIXEL_X["hardware_error_status"].address


class Servo(Device):
    """One servo's registers.

    Args:
        settings: EEPROM values that differ from the factory values, by register name.

    Attributes:
        watchdog: time without packets after which the servo switches to free running [s]; infinite while it is off.
        booted: time of the last power-on or reboot [s].
    """

    def __init__(self, device_id: int, index: int, model: int, settings: dict[str, int]):
        super().__init__(DYNAMIXEL_X, device_id)
        self.put("model_number", model)
        for name, value in settings.items():
            if not self.table[name].eeprom:
                raise ValueError(f"servo settings are registers of the EEPROM, but {name} is not one")
            self.put(name, value)
        self.index, self.booted = index, 0.0
        self.ready = self.watchdog = inf
        self._places: dict[tuple[int, int], list[int]] = {}

    @property
    def alert(self) -> bool:
        """Whether there is a hardware error."""
        return self.memory[_HARDWARE_ERROR] != 0

    @property
    def protocol(self) -> int:
        """Protocol version; of 1.0 it supports only pings."""
        return self.memory[_PROTOCOL]

    @property
    def torque(self) -> bool:
        """Whether torque is enabled."""
        return self.memory[_TORQUE] != 0

    def power(self, on: bool, now: float) -> None:
        """Switch its power on or off: the RAM area is reset, with indirect addresses and errors."""
        self.ready = now + BOOT_TIME if on else inf
        self.booted = now if on else self.booted
        for register in self.table:
            if register.address >= 64 and register.initial is not None:
                self.put(register.name, register.initial)
        self.put("goal_current", self.get("current_limit"))
        self.watchdog = inf
        self._places.clear()

    def fail(self, error: int) -> None:
        """A hardware error: it remains until a reboot, and shuts the servo down if `shutdown` contains it."""
        self.memory[_HARDWARE_ERROR] |= error
        if self.memory[_HARDWARE_ERROR] & self.get("shutdown"):
            self.memory[_TORQUE] = 0

    def trip(self) -> None:
        """Trip the bus watchdog: the servo runs freely, and its goals are read-only until the watchdog is cleared."""
        self.put("bus_watchdog", WATCHDOG_ERROR)
        self.watchdog = inf

    def _pointed(self, address: int, end: int) -> list[int]:
        """Targets of these addresses: indirect data addresses refer to others, and all others to themselves."""
        key = address, end
        if key not in self._places:
            places = list(range(address, end))
            for pointers, data, _ in self.table.indirect:
                for at in range(max(address, data), min(end, data + INDIRECT_COUNT)):
                    first = pointers + 2 * (at - data)
                    places[at - address] = self.memory[first] | self.memory[first + 1] << 8
            self._places[key] = places
        return self._places[key]

    def read(self, address: int, length: int) -> tuple[int, bytes]:
        """Error and data of a read, with indirect addresses resolved."""
        end = address + length
        if end <= FIRST_INDIRECT_DATA or end > self.table.size:
            return super().read(address, length)
        memory = self.memory
        return Error.NONE, bytes([memory[at] for at in self._pointed(address, end)])

    def write(self, address: int, data: bytes) -> int:
        """Write registers; if one of them is refused none is written. Returns the error."""
        end = address + len(data)
        if end > FIRST_INDIRECT_DATA:
            return self._write_bytes(self._pointed(address, end), data)
        return super().write(address, data)

    def check(self, register: Register, value: int) -> int:
        """The error of writing a value to a register; `Error.NONE` if it may be written."""
        name = register.name
        if register.eeprom and self.torque:
            return Error.ACCESS
        if error := super().check(register, value):
            return error
        if (name in _GOALS or (name == "bus_watchdog" and value)) and self.get("bus_watchdog") == WATCHDOG_ERROR:
            return Error.DATA_RANGE
        if name == "operating_mode" and value not in OPERATING_MODES:
            return Error.DATA_RANGE
        if name == "torque_enable" and value and self.memory[_HARDWARE_ERROR] & self.get("shutdown"):
            return Error.RESULT_FAIL  # (inferred) only a reboot restores torque; the manual states no error
        beyond = name == "goal_current" and abs(value) > self.get("current_limit")
        return Error.DATA_LIMIT if beyond else Error.NONE

    def written(self, register: Register, value: int) -> None:
        """Apply the consequences of a write."""
        if register.name == "goal_current":
            return
        if register.name == "operating_mode":
            # (inferred) also if the mode does not change; the manual describes switching
            self.put("goal_current", self.get("current_limit"))
        elif register.name == "bus_watchdog":
            self.watchdog = value * WATCHDOG_UNIT if value else inf
        self._places.clear()
