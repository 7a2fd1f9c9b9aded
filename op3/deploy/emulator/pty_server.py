"""The emulated robot behind a pseudo-terminal, in wall time: a serial port for any program."""

from __future__ import annotations

import gc
import os
import pty
import select
import termios
import threading
import time
import tty

from op3.deploy.emulator.emulated_robot import EmulatedRobot

PATIENCE = 0.002
"""Longest interval between synchronisations with the wall clock [s]."""

READ_SIZE = 4096
"""Number of bytes read from the terminal at once."""

_SPEEDS: dict[int, int] = {
    getattr(termios, f"B{speed}"): speed
    for speed in (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
    if hasattr(termios, f"B{speed}")
}
"""Baud rate by the terminal's code [bit/s]."""


class PtyServer:
    """Serves a robot on a pseudo-terminal in a separate thread.

    Answers arrive when the bus would deliver them, or later on a busy machine. While it serves, no other code may
    advance the robot's time.

    Args:
        baud: speed of the line until a program sets one [bit/s].

    Attributes:
        longest_lag: largest lag of the emulated time behind the wall clock [s].
    """

    def __init__(self, robot: EmulatedRobot, baud: int = 2_000_000):
        self._robot = robot
        robot.bus.baud = baud
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self.longest_lag = 0.0
        self.error: Exception | None = None
        self._stopping = False
        self._thread = threading.Thread(target=self._serve, name="emulated robot", daemon=True)

    def __enter__(self) -> PtyServer:
        """Start serving."""
        # garbage collection after the imports takes longer than a tick
        gc.collect()
        gc.freeze()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def alive(self) -> bool:
        """Whether it is serving."""
        return self._thread.is_alive()

    def wait(self, timeout: float | None = None) -> None:
        """Wait until the server ends, or for a time [s].

        Raises:
            RuntimeError: if the physics diverged.
        """
        self._thread.join(timeout)
        if self.error is not None:
            raise self.error

    def close(self) -> None:
        """Stop serving and remove the port."""
        self._stopping = True
        if self._thread.is_alive():
            self._thread.join()

    def _serve(self) -> None:
        try:
            self._loop()
        except Exception as error:
            self.error = error
        finally:
            # closed once, by this thread: the descriptors may be reused afterwards
            for end in (self._master, self._slave):
                os.close(end)

    def _loop(self) -> None:
        robot, bus = self._robot, self._robot.bus
        start = time.monotonic() - robot.clock.now()
        pending = b""
        while not (self._stopping or robot.unplugged):
            now = time.monotonic() - start
            wait = min(PATIENCE, max(0.0, bus.next_arrival - now))
            readable, _, _ = select.select([self._master], [], [], wait)
            now = time.monotonic() - start
            if self._master in readable:
                data = self._read()
                if data:
                    self._follow_speed()
                    bus.send(data, now)
            robot.clock.sleep_until(now)
            self.longest_lag = max(self.longest_lag, time.monotonic() - start - now)
            pending += bus.take(READ_SIZE, now)
            if pending:
                pending = pending[self._write(pending) :]

    def _read(self) -> bytes:
        try:
            return os.read(self._master, READ_SIZE)
        except OSError:  # no program has opened the port
            return b""

    def _write(self, data: bytes) -> int:
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0

    def _follow_speed(self) -> None:
        """Adopt the baud rate that a program sets on the terminal; an unknown rate is ignored."""
        speed = _SPEEDS.get(termios.tcgetattr(self._slave)[4])
        if speed is not None and speed != self._robot.bus.baud:
            self._robot.bus.baud = speed
