"""The port of a real robot, or of a pty."""

from __future__ import annotations

from time import monotonic

import dynamixel_sdk
import serial

WRITE_TIMEOUT = 0.05
"""Longest time that the computer's buffer may refuse bytes [s]; a hanging adapter would otherwise block the program."""


class SerialPort(dynamixel_sdk.PortHandler):
    """The SDK's port on a real device or a pty, waiting for bytes instead of polling for them.

    Only one program may open it: a second one would disturb the answers to the first.
    """

    def setupPort(self, cflag_baud: int) -> bool:
        """Open the port exclusively; reads wait for up to a millisecond."""
        super().setupPort(cflag_baud)
        assert self.ser is not None
        self.ser.timeout = 0.001
        self.ser.write_timeout = WRITE_TIMEOUT
        try:
            self.ser.exclusive = True
        except serial.SerialException as error:
            self.closePort()
            raise serial.SerialException("another program has opened it; end that program first") from error
        return True

    def writePort(self, packet: list[int]) -> int:
        """Send bytes; discard those that a hanging adapter did not accept, so that they are not sent later."""
        assert self.ser is not None
        try:
            return self.ser.write(bytes(packet)) or 0
        except serial.SerialTimeoutException:
            self.ser.reset_output_buffer()
            raise

    def getCurrentTime(self) -> float:
        """Time in ms; the SDK's clock would jump when the computer's clock is set."""
        return 1e3 * monotonic()
