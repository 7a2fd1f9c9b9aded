"""A physics in twenty lines: wheels on servos. It shows what the bus asks of a physics, and it is fast."""

import numpy as np
from dynamixel_sdk import PacketHandler

from op3.deploy.emulator import EmulatedRobot, VirtualPort
from op3.deploy.registers import OPEN_CR_ID
from op3.stand_in.sensors import Sensors
from tests.op3_table import OP3


class Wheels:
    """Twenty free wheels: inertia 0.01 kg m^2, 2 N m/A, 0.1 N m s/rad, and a trunk that hangs still."""

    def __init__(self):
        self.known, self.supply = OP3, None
        self.position, self.velocity = np.zeros(20), np.zeros(20)
        self.current = np.zeros(20)
        self.temperature = np.full(20, 30.0)
        self.tilt = np.zeros(3)
        self.rates = np.zeros(3)
        self.force = np.array([0.0, 0.0, 9.80665])

    def drive(self, enabled, current):
        self.current = current * enabled

    def advance(self, duration):
        for _ in range(round(duration / 0.001)):
            self.velocity += 0.001 * (2 * self.current - 0.1 * self.velocity) / 0.01
            self.position += 0.001 * self.velocity

    def read(self):
        voltage = np.full(20, 12.0 if self.supply is None else self.supply)
        return Sensors(
            self.position, self.velocity, self.current, voltage, self.temperature, self.tilt, self.rates, self.force
        )


class Bench:
    """A robot in process with the SDK's objects around it."""

    def __init__(self, physics=None, *, power=True, **options):
        self.physics = physics or Wheels()
        self.robot = EmulatedRobot(self.physics, **options)
        self.clock = self.robot.clock
        self.port, self.packets = VirtualPort(self.robot), PacketHandler(2.0)
        assert self.port.setBaudRate(2_000_000)
        if power:
            assert self.write(OPEN_CR_ID, 24, 1, 1) == (0, 0)
            self.clock.sleep(0.1)

    def write(self, device, address, size, value):
        """Result and error of a write."""
        data = list(value.to_bytes(size, "little", signed=value < 0))
        return self.packets.writeTxRx(self.port, device, address, size, data)

    def read(self, device, address, size, signed=False):
        """The value of a register that must be readable."""
        data, result, error = self.packets.readTxRx(self.port, device, address, size)
        assert (result, error & 0x7F) == (0, 0)
        return int.from_bytes(bytes(data), "little", signed=signed)

    def error(self, device):
        """The error byte of an answer."""
        return self.packets.readTxRx(self.port, device, 70, 1)[2]

    def energise(self, device, current=0):
        """Current mode, a goal current, torque on."""
        for address, size, value in ((64, 1, 0), (11, 1, 0), (102, 2, current), (64, 1, 1)):
            assert self.write(device, address, size, value) == (0, 0)
