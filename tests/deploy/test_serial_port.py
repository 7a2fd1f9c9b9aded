"""The port on a real device or a pty: what a hung adapter, a second program or a wrong clock must not do."""

import os
import pty
import time
import tty

import pytest

from op3.deploy.dynamixel_bus import Bus, Unplugged
from op3.deploy.limits import Limits
from op3.deploy.safety import Safety
from op3.deploy.serial_port import SerialPort
from op3.deploy.ticker import MonotonicClock


@pytest.fixture
def terminal():
    """Both ends of a pty on which nobody answers."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    for end in (master, slave):
        os.close(end)


def test_a_hung_adapter_does_not_hold_up_switching_off(terminal):
    """Where the adapter takes no more bytes, `release` gives up after its patience."""
    _, path = terminal
    bus = Bus(SerialPort(path), MonotonicClock(), "op3")
    safety = Safety(bus, Limits(), report=lambda _: None)

    def fill():
        for _ in range(100_000):
            safety._writer.sync_write("led", 1)

    with pytest.raises(Unplugged, match="Write timeout"):
        fill()
    before = time.monotonic()
    result = safety.release(patience=0.5)
    assert len(result.failed) == 20
    assert time.monotonic() - before < 10.0
    bus.close()


def test_one_program_at_a_time(terminal):
    """A second program that opens the port is refused; when the first one has ended it may."""
    _, path = terminal
    first = Bus(SerialPort(path), MonotonicClock(), "op3")
    with pytest.raises(Unplugged, match="another program has opened it"):
        Bus(SerialPort(path), MonotonicClock(), "op3")
    first.open()  # again, as after a pulled plug
    first.close()
    Bus(SerialPort(path), MonotonicClock(), "op3").close()


def test_timeouts_do_not_follow_the_computers_clock(monkeypatch):
    """A clock that is set forward by an hour while a tick waits costs no answer."""
    hours = iter(range(1000))
    monkeypatch.setattr(time, "time", lambda: 3600.0 * next(hours))
    port = SerialPort("/dev/ttyNOWHERE")
    port.setPacketTimeoutMillis(1e4)
    assert not port.isPacketTimeout()
