"""An emulated ROBOTIS-OP3 on a Dynamixel Protocol 2.0 bus, to the byte."""

from op3.deploy.emulator.faults import (
    BrownOut,
    Faults,
    FrozenImu,
    HardwareFault,
    Overheat,
    Silent,
    Unplug,
)
from op3.deploy.emulator.frames import Frame, read_frames
from op3.deploy.emulator.line import Timing
from op3.deploy.emulator.physics import Physics, Readings, StandInPhysics
from op3.deploy.emulator.port import Clock, VirtualPort
from op3.deploy.emulator.power import Battery, Windings
from op3.deploy.emulator.pty_server import PtyServer
from op3.deploy.emulator.robot import OP3_SETTINGS, EmulatedRobot
from op3.deploy.emulator.sim_physics import ImuNoise, SimPhysics

__all__ = [
    "OP3_SETTINGS",
    "Battery",
    "BrownOut",
    "Clock",
    "EmulatedRobot",
    "Faults",
    "Frame",
    "FrozenImu",
    "HardwareFault",
    "ImuNoise",
    "Overheat",
    "Physics",
    "PtyServer",
    "Readings",
    "Silent",
    "SimPhysics",
    "StandInPhysics",
    "Timing",
    "Unplug",
    "VirtualPort",
    "Windings",
    "read_frames",
]
