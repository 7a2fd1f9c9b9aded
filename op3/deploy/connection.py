"""Operations on a robot at a port: run a policy or a motion, read only, set up, calibrate."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from op3.deploy.dynamixel_bus import Bus
from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.limits import Limits
from op3.deploy.operator import Console, Operator
from op3.deploy.panel import StatusPanel
from op3.deploy.phases import GainRamp, HoldPose, Move, Phase, Relax, Watch
from op3.deploy.policy_runner import FollowPolicy
from op3.deploy.robot_state import Calibration
from op3.deploy.safety import Onlooker, Safety
from op3.deploy.serial_port import SerialPort
from op3.deploy.session import Logs, Session, SessionOutcome
from op3.deploy.start_checks import UNTOUCHED
from op3.deploy.ticker import PERIOD, POLICY_TICKS, MonotonicClock
from op3.policy.actions import D_GAIN, HELD_GAIN
from op3.robot import DEFAULT, Robot, load_robot
from op3.rollout import Metadata

if TYPE_CHECKING:
    from op3.deploy.emulator import EmulatedRobot

EMULATED = "emulated"
"""Name of the port that starts an emulated robot in this process."""

HANG_SCALE = 0.5
"""Share of the peak currents allowed on a suspended robot."""

SETTLE_TIME = 1.5
"""Time for which the start pose is held before a motion or a policy begins [s]."""

POLICY_RATE = 1 / (PERIOD * POLICY_TICKS)
"""Policy steps per second [Hz]."""

Report = Callable[[str], None]


@dataclass(frozen=True)
class Connection:
    """A robot on a port, its operator, and the metadata of its logs.

    Attributes:
        kind: `real` or `emulated`.
        emulated: the emulated robot in this process, if there is one; `seed` is its seed.
    """

    bus: Bus
    operator: Operator
    kind: str
    mount: str
    extra: dict[str, Any] = field(default_factory=dict)
    seed: int | None = None
    emulated: EmulatedRobot | None = None

    def close(self) -> None:
        """Close the port, and finish the recording of an emulated robot's frames."""
        self.bus.close()
        if self.emulated is not None:
            self.emulated.close()


def connect(
    port: str,
    *,
    robot: str | Robot,
    mount: str = "floor",
    confirm: bool = True,
    calibration: str | Path | None = None,
    **emulation: Any,
) -> Connection:
    """Open a robot's port.

    Args:
        port: a device such as /dev/ttyUSB0, a pty, or `emulated`.
        robot: a name in `assets/robots`, or the path of its file.
        mount: `floor` or `stand`.
        confirm: whether to ask before torque is switched on; never for an emulated robot.
        calibration: file with the joints' offsets; None for none.
        emulation: options of `op3.deploy.emulated.emulate`, for `port="emulated"`.

    Raises:
        ValueError: if an argument is invalid.
        Unplugged: if the port cannot be opened.
    """
    if mount not in ("floor", "stand"):
        raise ValueError(f"mount must be floor or stand, got {mount!r}")
    if not port:
        raise ValueError("port is empty: give a device such as port=/dev/ttyUSB0, or port=emulated")
    known = load_robot(robot)
    offsets = None if calibration is None else Calibration.load(calibration, known)
    if port == EMULATED:
        # These import MuJoCo, which a robot's computer does not need.
        from op3.deploy.emulated import emulate
        from op3.deploy.emulator import VirtualPort

        scene = emulation.pop("scene", None) or mount
        emulated, hands, identity = emulate(known, scene=scene, **emulation)
        bus = Bus(VirtualPort(emulated), emulated.clock, known, calibration=offsets)
        seed = emulation.get("seed", 0)
        return Connection(bus, hands, "emulated", mount, {"world": identity}, seed, emulated)
    kind = "emulated" if port.startswith("/dev/pts/") else "real"
    bus = Bus(SerialPort(port), MonotonicClock(), known, calibration=offsets)
    return Connection(bus, Console() if confirm else Operator(), kind, mount)


@dataclass(frozen=True)
class Plan:
    """Settings of a run, except those of its main phase.

    Attributes:
        dry: whether torque stays off; the loop runs without sending its currents.
        current_scale: allowed share of the peak currents.
        end_pose: pose in which torque is switched off; None: the robot's pose "rest", or home without one.
        folder: folder of the logs; None: no logs.
        panel: whether to show the live view in a terminal.
    """

    limits: Limits = field(default_factory=Limits)
    dry: bool = False
    current_scale: float = 1.0
    end_pose: str | None = None
    folder: Path | None = None
    panel: bool = True


def run(
    connection: Connection,
    make: Callable[[], Phase],
    plan: Plan | None = None,
    *,
    start: ArrayLike | None = None,
    p_gain: ArrayLike = HELD_GAIN,
    d_gain: ArrayLike = D_GAIN,
    recording: str | None = None,
    report: Report | None = None,
    **metadata: Any,
) -> SessionOutcome:
    """Check, energise, ramp, move to the start pose, wait for the operator, run, sit down, switch off.

    Args:
        start: start pose [joint] in rad; by default home.
        p_gain: P gains while moving to the start pose [A/rad].
        d_gain: D gains while moving to the start pose [A s/rad].
        report: receives lines for the operator; None: the terminal, above the live view.
    """
    plan, robot = plan or Plan(), connection.bus.robot
    first = robot.home if start is None else np.asarray(start, dtype=float)
    rest = robot.pose(plan.end_pose or ("rest" if "rest" in robot.file.poses else "home"))
    panel = StatusPanel(robot, plan.panel)
    say = report or panel.say

    def phases(session: Session) -> list[Phase]:
        driver = make()
        if isinstance(driver, FollowPolicy):
            driver.on_begin, driver.on_end = connection.operator.begins, connection.operator.ends
        if plan.dry:
            return [driver]

        return [
            GainRamp(p_gain, d_gain),
            Move(first, p_gain, d_gain, start=lambda: session.issued),
            HoldPose(first, p_gain, d_gain, until=lambda: connection.operator.said_go(say)),
            HoldPose(first, p_gain, d_gain, duration=SETTLE_TIME),
            driver,
            Move(rest, start=lambda: session.issued, log="after"),
            Relax(rest),
        ]

    scale, torque = plan.current_scale, not plan.dry
    safety = Safety(connection.bus, plan.limits, current_scale=scale, torque=torque, report=say)
    logs = _logs(connection, plan, recording, **metadata)
    with closing(panel):
        return Session(connection.bus, safety, connection.operator, logs=logs, show=panel, report=say).run(phases)


def read_only(
    connection: Connection, duration: float, plan: Plan | None = None, *, report: Report | None = None
) -> SessionOutcome:
    """Show and record the robot's sensors without writing to the robot."""
    plan, bus = plan or Plan(), connection.bus
    panel = StatusPanel(bus.robot, plan.panel)
    say = report or panel.say
    guard, logs = Onlooker(bus, plan.limits, say), _logs(connection, plan, None)
    with closing(panel):
        session = Session(bus, guard, connection.operator, logs=logs, show=panel, report=say)
        return session.run(lambda session: [Watch(duration)])


def _logs(connection: Connection, plan: Plan, recording: str | None, **metadata: Any) -> Logs | None:
    """The logs to write, with the metadata of the run."""
    if plan.folder is None:
        return None
    bus, robot = connection.bus, connection.bus.robot
    extra = {**connection.extra, **metadata.pop("extra", {}), "limits": vars(plan.limits)}
    makes = {make.name for make in robot.servos}
    facts = Metadata(
        joints=bus.joints,
        robot=connection.kind,
        robot_file=None if robot.reference == DEFAULT else robot.reference,  # logs of the OP3 name no file
        mount=connection.mount,
        rate=1 / PERIOD,
        battery=robot.supply,
        servo=makes.pop() if len(makes) == 1 else None,
        recording=recording,
        seed=connection.seed,
        extra={**extra, "offset_rad": bus.calibration.offset.tolist()},
        **metadata,
    )
    return Logs(plan.folder, facts)


SETTINGS = {"return_delay_time": 0, **UNTOUCHED}
"""Registers that are set once per robot."""


def setup(connection: Connection, *, report: Report = print) -> ExitCode:
    """Write the settings that the start checks require, with torque off."""
    text = ", ".join(f"{name} = {value}" for name, value in SETTINGS.items())
    if not connection.operator.confirm(
        f"Torque will be switched off, and {text} will be written to the EEPROM of all servos."
    ):
        report("not confirmed; nothing was written")
        return ExitCode.DECLINED
    safety = Safety(connection.bus, report=report)
    try:
        safety.check_start(whole=False)
        safety.write_settings(SETTINGS)
    except Stop as stop:
        report(stop.reason)
        return stop.code
    report(f"{text} on {len(connection.bus.joints)} servos")
    return ExitCode.OK


SAMPLES = 50
"""Number of averaged readings of a pose."""


def calibrate(connection: Connection, path: str | Path, *, pose_name: str = "zero", report: Report = print) -> ExitCode:
    """Write the joints' offsets: the mean of `SAMPLES` readings of a torque-free robot held in a pose."""
    bus = connection.bus
    held, bus.calibration = bus.robot.pose(pose_name), Calibration(robot=bus.robot)
    if not connection.operator.confirm(f"Hold the robot exactly in the pose {pose_name!r}."):
        report("not confirmed; nothing was written")
        return ExitCode.DECLINED
    if on := [name for name, value in bus.sync_read("torque_enable").items() if value]:
        report(f"torque is on at {', '.join(on)}; switch the power off and on")
        return ExitCode.START_CHECK
    sums, counts = np.zeros(len(held)), np.zeros(len(held))
    for _ in range(SAMPLES):
        state = bus.read_state()
        sums += np.where(state.answered, state.position, 0.0)
        counts += state.answered
        bus.clock.sleep_until(bus.clock.now() + PERIOD)
    if not counts.all():
        silent = ", ".join(bus.joints[i] for i in np.flatnonzero(counts == 0))
        report(f"no answer from {silent}; check the cables and switch the servos' supply on")
        return ExitCode.START_CHECK
    calibration = Calibration(held - sums / counts, robot=bus.robot)
    calibration.save(path)
    worst = int(np.abs(calibration.offset).argmax())
    report(f"{path}: offsets up to {calibration.offset[worst]:+.4f} rad ({bus.joints[worst]})")
    return ExitCode.OK
