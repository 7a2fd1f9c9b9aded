"""An emulated robot with cheap joints, and a run on it, for the tests of safety, loop and session."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from op3.deploy.dynamixel_bus import Bus
from op3.deploy.emulator import EmulatedRobot, Faults, LineTiming, VirtualPort, read_frames
from op3.deploy.limits import Limits
from op3.deploy.operator import Operator
from op3.deploy.phases import GainRamp, HoldPose, Move, Phase
from op3.deploy.protocol import Instruction, Packet, Parser
from op3.deploy.registers import DYNAMIXEL_X
from op3.deploy.safety import Safety
from op3.deploy.session import Logs, Session, SessionOutcome
from op3.robot import pose
from op3.rollout import Metadata
from op3.stand_in.sensors import Sensors
from tests.op3_table import JOINTS, OP3, SERVO_IDS

NAMES = {number: name for name, number in SERVO_IDS.items()}


class CheapPhysics:
    """Twenty damped inertias, each with a constant load, and a trunk that tilts when told.

    Each joint moves exactly as J dv/dt = K i - b v - load between two calls, so a second costs next to nothing.
    """

    constant, inertia, damping = 1.8, 0.02, 0.4  # N m/A, kg m^2, N m s/rad

    def __init__(self, position: np.ndarray | None = None, load: float = 0.3):
        self.known = OP3
        self.supply: float | None = None
        self.position = pose("stand", "op3") if position is None else np.array(position, dtype=float)
        self.velocity = np.zeros(len(JOINTS))
        self.load = load * np.where(np.arange(len(JOINTS)) % 2, -1.0, 1.0)
        self.clamped = True
        self.time = 0.0
        self.tilt_from = np.inf
        self.tilt = np.deg2rad(60)
        self._current = np.zeros(len(JOINTS))
        self._rng = np.random.default_rng(1)

    def drive(self, enabled: np.ndarray, current: np.ndarray) -> None:
        """Currents from now on. Until torque is on once, the joints are held where they are."""
        self._current = np.where(enabled, current, 0.0)
        self.clamped &= not enabled.any()

    def advance(self, duration: float) -> None:
        self.time += duration
        if self.clamped:
            return
        final = (self.constant * self._current - self.load) / self.damping
        rate = self.damping / self.inertia
        decay = np.exp(-rate * duration)
        self.position = self.position + final * duration + (self.velocity - final) * (1 - decay) / rate
        self.velocity = final + (self.velocity - final) * decay

    def read(self) -> Sensors:
        count = len(JOINTS)
        roll = self.tilt if self.time >= self.tilt_from else 0.0
        volts = 12.0 if self.supply is None else self.supply
        return Sensors(
            position=self.position,
            velocity=self.velocity,
            current=self._current,
            voltage=np.full(count, volts),
            temperature=np.full(count, 30.0),
            orientation=np.array([roll, 0.0, 0.0]),
            angular_velocity=0.005 * self._rng.standard_normal(3),
            linear_acceleration=np.array([0.0, 0.0, 9.81]) + 0.02 * self._rng.standard_normal(3),
        )


@dataclass
class Rig:
    """An emulated robot, its bus and what a run on it printed.

    Attributes:
        physics: behind the bus.
        robot: the emulated one.
        bus: of the deploying side.
        lines: what was reported to the operator.
        frames_file: every frame on the wire.
    """

    physics: CheapPhysics
    robot: EmulatedRobot
    bus: Bus
    frames_file: Path
    lines: list[str] = field(default_factory=list)

    def register(self, name: str) -> list[int]:
        """A register of all servos, in the order of the joints."""
        return [self.robot.servos[joint].get(name) for joint in JOINTS]

    def run(
        self,
        phases: Sequence[Phase] | Callable[[Session], Sequence[Phase]] | None = None,
        *,
        limits: Limits | None = None,
        operator: Operator | None = None,
        folder: Path | None = None,
        duration: float = 1.0,
        torque: bool = True,
        current_scale: float = 1.0,
    ) -> SessionOutcome:
        """A session; by default ramp, move to the stand pose, hold it."""
        stand = pose("stand", "op3")
        logs = None
        if folder is not None:
            logs = Logs(folder, Metadata(joints=JOINTS, robot="emulated", mount="stand", rate=125.0))
        self.safety = Safety(self.bus, limits, current_scale=current_scale, torque=torque, report=self.lines.append)
        who, say = operator or Operator(), self.lines.append
        session = Session(self.bus, self.safety, who, logs=logs, report=say)

        def make(loop: Session) -> Sequence[Phase]:
            if phases is None:
                move = Move(stand, start=lambda: loop.issued)
                return [GainRamp(), move, HoldPose(stand, duration=duration, log="run")]
            return phases(loop) if callable(phases) else phases

        return session.run(make)

    def packets(self) -> list[tuple[float, Packet]]:
        """Time and content of every packet that the computer sent."""
        self.robot.bus._file.flush()
        found = []
        for frame in read_frames(self.frames_file):
            if frame.direction == ">":
                found += [(frame.time, packet) for packet in Parser().feed(frame.data)]
        return found

    def written(self, register: str) -> list[tuple[float, dict[str, int]]]:
        """Time and values by joint of every sync write of a register."""
        entry = DYNAMIXEL_X[register]
        result = []
        for time, packet in self.packets():
            if packet.instruction != Instruction.SYNC_WRITE:
                continue
            address, size = (int.from_bytes(packet.parameters[i : i + 2], "little") for i in (0, 2))
            if address != entry.address:
                continue
            rest = packet.parameters[4:]
            parts = [rest[i : i + size + 1] for i in range(0, len(rest), size + 1)]
            result.append((time, {NAMES[part[0]]: entry.decode(part[1:]) for part in parts}))
        return result


def make_rig(
    folder: Path,
    *,
    faults: Faults | None = None,
    timing: LineTiming | None = None,
    settings: dict[str, int] | None = None,
    seed: int = 0,
    prepare: Callable[[EmulatedRobot], Any] | None = None,
    position: np.ndarray | None = None,
    record: bool = True,
) -> Rig:
    """A rig whose frames are recorded in `folder`."""
    physics, file = CheapPhysics(position), folder / "frames.txt"
    robot = EmulatedRobot(
        physics, seed=seed, faults=faults, timing=timing, settings=settings, record=file if record else None
    )
    if prepare is not None:
        prepare(robot)
    return Rig(physics, robot, Bus(VirtualPort(robot), robot.clock, "op3"), file)
