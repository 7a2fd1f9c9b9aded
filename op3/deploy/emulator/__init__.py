"""An emulated robot on a Dynamixel Protocol 2.0 bus, to the byte."""

from op3.deploy.emulator.emulated_robot import USUAL_SETTINGS, EmulatedRobot
from op3.deploy.emulator.faults import (
    BrownOut,
    Faults,
    FrozenImu,
    HardwareFault,
    Overheat,
    Silent,
    Unplug,
)
from op3.deploy.emulator.line import Frame, LineTiming, read_frames
from op3.deploy.emulator.physics import Physics, StandInPhysics
from op3.deploy.emulator.port import VirtualPort
from op3.deploy.emulator.pty_server import PtyServer
from op3.deploy.emulator.sim_physics import SimPhysics

__all__ = [
    "USUAL_SETTINGS",
    "BrownOut",
    "EmulatedRobot",
    "Faults",
    "Frame",
    "FrozenImu",
    "HardwareFault",
    "LineTiming",
    "Overheat",
    "Physics",
    "PtyServer",
    "Silent",
    "SimPhysics",
    "StandInPhysics",
    "Unplug",
    "VirtualPort",
    "read_frames",
]
