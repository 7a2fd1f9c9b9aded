"""The robot on a pseudo-terminal: the same bytes for any program, in wall time."""

import termios
import time

import pytest
from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler
from serial import SerialException
from wheels import Wheels

from op3.deploy.emulator import EmulatedRobot, Faults, PtyServer, Unplug
from op3.deploy.protocol import Error
from op3.deploy.registers import OPEN_CR_ID


def patiently(attempt, seconds=20.0):
    """Wall time on a busy machine: an answer may come after the SDK has given up."""
    end = time.monotonic() + seconds
    while True:
        outcome = attempt()
        if outcome is not None or time.monotonic() > end:
            return outcome
        time.sleep(0.05)


class PtyBench:
    """The SDK's own port on the pseudo-terminal."""

    def __init__(self, server, robot):
        self.robot = robot
        self.port, self.packets = PortHandler(server.path), PacketHandler(2.0)
        assert self.port.setBaudRate(2_000_000)

    def write(self, device, address, size, value):
        data = list(value.to_bytes(size, "little"))

        def attempt():
            result, error = self.packets.writeTxRx(self.port, device, address, size, data)
            return error if result == 0 else None

        return patiently(attempt)

    def read(self, device, address, size):
        def attempt():
            data, result, _ = self.packets.readTxRx(self.port, device, address, size)
            return int.from_bytes(bytes(data), "little") if result == 0 else None

        return patiently(attempt)


def test_the_unmodified_sdk_drives_it():
    """Power, registers, errors, sync reads and writes, and a watchdog that trips; at another speed nothing answers."""
    robot = EmulatedRobot(Wheels())
    with PtyServer(robot) as server:
        bench = PtyBench(server, robot)
        assert bench.port.setBaudRate(1_000_000)
        assert bench.packets.ping(bench.port, OPEN_CR_ID)[1] != 0
        assert bench.port.setBaudRate(2_000_000)
        assert bench.write(OPEN_CR_ID, 24, 1, 1) == 0
        time.sleep(0.2)
        assert patiently(lambda: bench.packets.ping(bench.port, 7)[0] or None) == 1020
        for address, size, value in ((11, 1, 0), (102, 2, 0), (64, 1, 1)):
            assert bench.write(7, address, size, value) == 0
        assert bench.write(7, 11, 1, 3) == Error.ACCESS
        reader, writer = (
            GroupSyncRead(bench.port, bench.packets, 132, 4),
            GroupSyncWrite(bench.port, bench.packets, 65, 1),
        )
        for number in range(1, 21):
            reader.addParam(number)
            writer.addParam(number, [1])
        assert patiently(lambda: True if reader.txRxPacket() == 0 else None)
        assert {reader.getData(number, 132, 4) for number in range(1, 21)} == {2048}
        writer.txPacket()
        time.sleep(0.05)
        assert {bench.read(number, 65, 1) for number in (1, 20)} == {1}
        assert bench.write(7, 98, 1, 5) == 0
        time.sleep(0.3)
        assert bench.read(7, 98, 1) == 255
        bench.port.closePort()


def test_a_pulled_plug_reaches_the_program():
    """The SDK's port fails, with pyserial's exception or with that of the call that it makes of the terminal."""
    robot = EmulatedRobot(Wheels(), faults=Faults(scheduled=(Unplug(0.3),)))
    with PtyServer(robot) as server:
        bench = PtyBench(server, robot)
        time.sleep(0.6)
        with pytest.raises((SerialException, OSError, termios.error)):
            bench.packets.ping(bench.port, 200)
