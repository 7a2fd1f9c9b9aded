"""The emulated robot: devices, line and physics on one clock."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from math import floor, inf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from serial import SerialException

from op3.deploy.emulator.device import Device, OpenCR
from op3.deploy.emulator.faults import (
    RESET_VOLTAGE,
    BrownOut,
    Faults,
    FrozenImu,
    HardwareFault,
    Overheat,
    Silent,
    Unplug,
)
from op3.deploy.emulator.instructions import Dispatcher
from op3.deploy.emulator.line import Line, LineTiming
from op3.deploy.emulator.physics import PERIOD, Physics
from op3.deploy.emulator.servo import BOOT_TIME, WATCHDOG_ERROR, Servo
from op3.deploy.protocol import BROADCAST_ID, Instruction, Packet
from op3.deploy.registers import CURRENT_MODE, DYNAMIXEL_X, POSITION_ZERO, HardwareError, Units

USUAL_SETTINGS: dict[str, int] = {"baud_rate": 4, "return_delay_time": 0}
"""EEPROM values of a robot's servos that differ from factory values: 2 Mbit/s, no return delay."""

CHECK_PERIOD = 0.01
"""Interval at which servos check their voltage and temperature [s] (inferred)."""

_WRITES = (Instruction.WRITE, Instruction.SYNC_WRITE)
"""Instructions that need no measurements; all others update them."""

_FIRST, _LAST = DYNAMIXEL_X["realtime_tick"].address, DYNAMIXEL_X["present_temperature"].end
_PRESENT = np.dtype([(register.name, register.kind) for register in DYNAMIXEL_X if _FIRST <= register.address < _LAST])


def _shared_memory(servos: Sequence[Servo]) -> NDArray[np.uint8]:
    """Memory of all servos [servo, address], so that all measurements are written at once."""
    memory = np.array([np.frombuffer(servo.memory, np.uint8) for servo in servos])
    for row, servo in zip(memory, servos, strict=True):
        servo.memory = memoryview(row)
    return memory


class EmulatedClock:
    """Time of the emulated world; `advance` simulates until a time [s]."""

    def __init__(self, advance: Callable[[float], None]):
        self._advance, self._now = advance, 0.0

    def now(self) -> float:
        """Time since the robot was created [s]."""
        return self._now

    def sleep(self, duration: float) -> None:
        """Let time pass [s]."""
        self.sleep_until(self._now + duration)

    def sleep_until(self, time: float) -> None:
        """Let time pass until a time [s]; a past time has no effect."""
        if time > self._now:
            self._now = time
            self._advance(time)


class EmulatedRobot:
    """A robot on its bus: its servos, its OpenCR if it has one, and a physics simulation.

    With an OpenCR the servos have no power until its register `dynamixel_power` is written. It does not use the wall
    clock: the same seed and the same calls give the same bytes.

    Args:
        settings: EEPROM registers of all servos by name, instead of `USUAL_SETTINGS`.
        record: file for all frames on the line; None: no file.

    Attributes:
        open_cr: the OpenCR; for a robot without one, an object that is not on the bus.

    Raises:
        ValueError: if the robot has servos that this bus does not support, or a fault names an unknown device.
    """

    def __init__(
        self,
        physics: Physics,
        *,
        seed: int = 0,
        faults: Faults | None = None,
        timing: LineTiming | None = None,
        settings: Mapping[str, int] | None = None,
        record: str | Path | None = None,
    ):
        self.physics = physics
        self.faults, timing = faults or Faults(), timing or LineTiming()
        known = physics.known
        self._units = Units(known)
        eeprom = dict(USUAL_SETTINGS if settings is None else settings)
        self.servos = {
            joint: Servo(known.bus_ids[joint], index, self._units.models[joint], eeprom)
            for index, joint in enumerate(known.joints)
        }
        self.open_cr = OpenCR()
        board = known.file.board is not None
        self._all = tuple(self.servos.values())
        self._memory = _shared_memory(self._all)
        devices: list[Device] = [*self._all, *([self.open_cr] if board else [])]
        self.faults.check_on([device.id for device in devices])
        self._dispatcher = Dispatcher(devices, timing.turnaround, self._hears)
        self.clock = EmulatedClock(self.advance)
        self.bus = Line(self._answers, timing, self.faults, np.random.default_rng([seed, 6]), record)
        self.time = self._refreshed = self._heard = 0.0
        self._ticks = 0
        self._stale = self._board_stale = True
        self.unplugged = self._powered = False
        self._silent: dict[int, float] = {}
        self._heat = np.zeros((2, len(self._all)))  # start [s] and rate [K/s] of a servo's heating
        self._present = np.zeros(len(self._all), dtype=_PRESENT)
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = count()
        self._schedule_faults()
        self.at(CHECK_PERIOD, self._check_servos)
        if not board:
            self.switch_on()

    def close(self) -> None:
        """Finish the file of frames, if there is one."""
        self.bus.close()

    def check_plugged(self) -> None:
        """Fail as pyserial does if the adapter is unplugged."""
        if self.unplugged:
            raise SerialException("device reports readiness to read but returned no data (device disconnected?)")

    def at(self, time: float, event: Callable[[], None]) -> None:
        """Schedule an action at a time [s]."""
        heapq.heappush(self._events, (time, next(self._numbers), event))

    def advance(self, time: float) -> None:
        """Simulate until a time [s]; past times have no effect."""
        while True:
            event, watchdog = (self._events[0][0] if self._events else inf), self._next_trip()
            due = min(event, watchdog)
            if due > time:
                break
            self._run(due)
            if event <= watchdog:
                heapq.heappop(self._events)[2]()
            else:
                self._trip(due)
        self._run(time)

    def _run(self, time: float) -> None:
        self.time = max(self.time, time)
        steps = floor(time / PERIOD + 1e-6) - self._ticks
        if steps <= 0:
            return
        self.physics.drive(self.driven, self._goal_current())
        self.physics.advance(steps * PERIOD)
        self._ticks += steps
        self._stale = self._board_stale = True

    def replace(self, physics: Physics) -> None:
        """Replace the physics behind the bus, for example to move the robot to another scene."""
        physics.supply = self.physics.supply
        self.physics, self._stale, self._board_stale = physics, True, True

    def _hears(self, device: Device) -> bool:
        silent = self._silent and device.id in self._silent
        return device.ready <= self.time and device.baud == self.bus.baud and not silent

    def _answers(self, packet: Packet, end: float) -> list[tuple[float, bytes]]:
        self.advance(end)
        if packet.instruction not in _WRITES:
            self._measure(packet)
        self._heard = end
        answers = self._dispatcher.answers(packet, end)
        if self.open_cr.power != self._powered:
            self._powered = self.open_cr.power
            self._power_servos(self._powered)
        return answers

    @property
    def driven(self) -> NDArray[np.bool_]:
        """Which motors regulate current [joint]; the others run freely."""
        running = (self._column("torque_enable") != 0) & (self._column("operating_mode") == CURRENT_MODE)
        return running & (self._column("bus_watchdog") != WATCHDOG_ERROR)

    def _column(self, name: str) -> NDArray[np.int64]:
        """A register of all servos, [joint]."""
        register = DYNAMIXEL_X[name]
        bytes_ = np.ascontiguousarray(self._memory[:, register.address : register.end])
        return bytes_.view(register.kind)[:, 0].astype(np.int64)

    def _goal_current(self) -> NDArray[np.float64]:
        """Currents that the servos regulate [joint] in A; the limit may have been lowered since the goal was
        written."""
        bound = self._column("current_limit")
        return self._column("goal_current").clip(-bound, bound) * self._units.current

    def _power_servos(self, on: bool) -> None:
        for servo in self._all:
            servo.power(on, self.time)

    def switch_on(self) -> None:
        """Switch the servos' power on, as the robot's power button does, and let them boot."""
        self.open_cr.put("dynamixel_power", 1)
        self._powered = True
        self._power_servos(True)
        self.clock.sleep(2 * BOOT_TIME)

    def _last_heard(self, servo: Servo) -> float:
        return min(self._heard, self._silent.get(servo.id, inf))

    def _next_trip(self) -> float:
        armed = [servo for servo in self._all if servo.watchdog < inf and servo.torque]
        return min((self._last_heard(servo) + servo.watchdog for servo in armed), default=inf)

    def _trip(self, now: float) -> None:
        for servo in self._all:
            if servo.torque and self._last_heard(servo) + servo.watchdog <= now:
                servo.trip()

    def _measure(self, packet: Packet) -> None:
        """Update the registers that an instruction may read."""
        board = self.open_cr.id
        if packet.device != board:
            self._refresh()
        # a sync or bulk read only includes the board if it names it
        named = packet.device == board or (packet.device == BROADCAST_ID and board in packet.parameters)
        if named and self._board_stale:
            self._board_stale = False
            readings = self.physics.read()
            self.open_cr.feel(readings, float(readings.voltage.max()))

    def _refresh(self) -> None:
        """Update the servos' registers from the physics."""
        if not self._stale:
            return
        self._stale, self._refreshed = False, self.time
        readings, present = self.physics.read(), self._present
        units = self._units
        booted = np.array([round(servo.booted / PERIOD) for servo in self._all])
        zero = POSITION_ZERO + self._column("homing_offset")
        present["realtime_tick"] = (self._ticks - booted) % 32768
        present["present_current"] = np.rint(readings.current / units.current)
        present["present_velocity"] = np.rint(readings.velocity / units.velocity)
        present["present_position"] = np.rint(readings.position / units.position) + zero
        present["present_input_voltage"] = np.rint(readings.voltage / units.voltage)
        begun, rate = self._heat
        temperature = readings.temperature + rate * (self.time - begun)
        present["present_temperature"] = np.minimum(np.rint(temperature), 255)
        self._memory[:, _FIRST:_LAST] = present.view(np.uint8).reshape(len(self._all), -1)

    def _check_servos(self) -> None:
        """Let the servos check their voltage and temperature."""
        self.at(self.time + CHECK_PERIOD, self._check_servos)
        if not self._powered:
            return
        if self.time - self._refreshed >= CHECK_PERIOD:
            self._stale = True
            self._refresh()
        volts, celsius = self._present["present_input_voltage"], self._present["present_temperature"]
        hot = celsius > self._column("temperature_limit")
        odd = (volts < self._column("min_voltage_limit")) | (volts > self._column("max_voltage_limit"))
        for index in np.flatnonzero(hot | odd):
            servo = self._all[index]
            error = HardwareError.OVERHEATING * int(hot[index]) | HardwareError.INPUT_VOLTAGE * int(odd[index])
            if servo.ready <= self.time and error & ~servo.get("hardware_error_status"):
                servo.fail(error)

    def _schedule_faults(self) -> None:
        for fault in self.faults.scheduled:
            self.at(fault.start, lambda fault=fault: self._begin(fault))
            end = getattr(fault, "end", inf)
            if end < inf:
                self.at(end, lambda fault=fault: self._end(fault))

    def _begin(self, fault: object) -> None:
        if isinstance(fault, Silent):
            self._silent[fault.device] = self._heard
        elif isinstance(fault, FrozenImu):
            self.open_cr.frozen = True
        elif isinstance(fault, Overheat):
            self._heat[:, [servo.id == fault.device for servo in self._all]] = [[fault.start], [fault.rate]]
        elif isinstance(fault, BrownOut):
            self.physics.supply = fault.voltage
            if fault.voltage < RESET_VOLTAGE:
                self._power_servos(False)
        elif isinstance(fault, HardwareFault):
            for servo in self._all:
                if servo.id == fault.device and servo.ready <= self.time:
                    servo.fail(fault.error)
        elif isinstance(fault, Unplug):
            self.unplugged = True

    def _end(self, fault: object) -> None:
        if isinstance(fault, Silent):
            self._silent.pop(fault.device, None)
        elif isinstance(fault, FrozenImu):
            self.open_cr.frozen = False
        elif isinstance(fault, BrownOut):
            self.physics.supply = None
            if fault.voltage < RESET_VOLTAGE:
                self._power_servos(self._powered)  # they restart if the OpenCR still supplies power
