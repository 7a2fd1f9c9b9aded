"""The computer's end of the line, in virtual time: a port for the unmodified dynamixel-sdk."""

from __future__ import annotations

from dynamixel_sdk import PortHandler
from serial import SerialException

from op3.deploy.emulator.emulated_robot import EmulatedRobot

POLL = 5e-5
"""Virtual time that a poll of an empty port takes if the expected length is unknown [s]."""


class VirtualPort(PortHandler):
    """Replaces dynamixel-sdk's `PortHandler`: only waiting for bytes advances the emulated time. It fails with
    pyserial's exceptions, as a real port does.
    """

    def __init__(self, robot: EmulatedRobot):
        super().__init__("virtual")
        self._robot, self._clock = robot, robot.clock

    def setupPort(self, cflag_baud: int) -> bool:
        """Open the port at a baud rate."""
        self._robot.check_plugged()
        self._robot.bus.baud = cflag_baud
        self.is_open = True
        self._robot.bus.discard(self._clock.now())
        self.tx_time_per_byte = (1000.0 / self.baudrate) * 10.0
        return True

    def closePort(self) -> None:
        """Close the port."""
        self.is_open = False

    def _check(self) -> None:
        self._robot.check_plugged()
        if not self.is_open:
            raise SerialException(f"port {self.port_name} is not open: call openPort() first")

    def clearPort(self) -> None:
        """Discard received bytes."""
        self._check()
        self._robot.bus.discard(self._clock.now())

    def getBytesAvailable(self) -> int:
        """Number of received bytes."""
        self._check()
        if not self._robot.bus.available(self._clock.now()):
            self._clock.sleep(POLL)  # repeated polls must advance time
        return self._robot.bus.available(self._clock.now())

    def readPort(self, length: int) -> bytes:
        """At most this number of bytes; if there are none, time passes until some arrive or the timeout ends."""
        self._check()
        bus, clock = self._robot.bus, self._clock
        now = clock.now()
        data = bus.take(length, now)
        if data or length <= 0:
            return data
        deadline = (self.packet_start_time + self.packet_timeout) / 1000.0
        if self.packet_timeout <= 0 or deadline < now:
            deadline = now + POLL
        arrival = bus.next_arrival
        clock.sleep_until(arrival if arrival <= deadline else deadline + 1e-6)
        self._check()
        return bus.take(length, clock.now())

    def writePort(self, packet: bytes | list[int]) -> int:
        """Send bytes."""
        self._check()
        self._robot.bus.send(bytes(packet), self._clock.now())
        return len(packet)

    def getCurrentTime(self) -> float:
        """The emulated time in ms."""
        return self._clock.now() * 1000.0
