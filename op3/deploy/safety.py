"""The one object that may write to the servos.

No other object has a write handle, so every current that reaches a servo has passed these limits, and every end of the
program passes through `Safety.release`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray

from op3.deploy.dynamixel_bus import (
    ATTEMPTS,
    FIRST_ANSWER,
    GAP,
    SLOW_ANSWER,
    Bus,
    BusError,
    NoAnswer,
    Unplugged,
    Writer,
)
from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.limits import Command, CurrentLimiter, Limits
from op3.deploy.monitors import Monitor, MonitorResult
from op3.deploy.operator import quietly
from op3.deploy.registers import CURRENT_MODE, WATCHDOG_UNIT
from op3.deploy.robot_state import RobotState
from op3.deploy.start_checks import StartChecks
from op3.deploy.ticker import PERIOD, Tick

WATCHDOG = 5
"""Bus watchdog in register units: a servo that receives nothing for 100 ms switches its torque off."""

RECOVERY_TIME = 0.25
"""Time over which P gains return after damping because of lost answers [s]."""

RELEASE_WRITES = 3
"""Number of times that zero current and torque off are sent before they are read back."""

RELEASE_PATIENCE = 5.0
"""Time for which torque off is retried on a silent bus [s]."""

ASKED = 40
"""Smallest goal current at which a measured current is expected [counts]."""

LET_GO = 5
"""Ticks without current after which the servo's torque register is read."""

SILENT = 25
"""Ticks without current after which the run ends although torque is on."""


@dataclass(frozen=True)
class Release:
    """Result of switching torque off.

    Attributes:
        verified: joints whose torque reads off.
        failed: joints whose torque reads on, or that do not answer, with details.
    """

    verified: tuple[str, ...]
    failed: dict[str, str]

    @property
    def ok(self) -> bool:
        """Whether every servo's torque reads off."""
        return not self.failed

    def __str__(self) -> str:
        count = f"torque off verified {len(self.verified)}/{len(self.verified) + len(self.failed)}"
        if self.ok:
            return count
        who = ", ".join(f"{name} ({why})" for name, why in self.failed.items())
        return f"{count}; NOT VERIFIED: {who}. Switch the robot's power off by hand"


class Onlooker:
    """The loop's interface to the safety guard; this class has no write handle and does nothing.

    Attributes:
        torque: whether torque may be switched on at all.
        touched: whether a servo may have torque.
    """

    torque = False
    touched = False

    def __init__(self, bus: Bus, limits: Limits | None = None, report: Callable[[str], None] = print):
        self.bus, self.limits, self._joints = bus, limits or Limits(), bus.joints
        self._report = quietly(report)

    @property
    def load(self) -> NDArray[np.float64]:
        """[joint] mean square current over the square of the continuous rating."""
        return np.zeros(len(self._joints))

    def _checks(self, writer: Writer | None) -> StartChecks:
        return StartChecks(self.bus, writer, self.limits, lambda check: self._report(str(check)))

    def check_start(self) -> None:
        """Run the start checks and report the results."""
        self._checks(None).run()

    def prepare(self) -> None:
        """Choose how a tick is read; needs no torque."""

    def energise(self) -> None:
        """Switch torque on."""

    def assess(self, tick: Tick, state: RobotState) -> MonitorResult:
        """Check a reading: nothing is driven, so everything is allowed, but losses are reported."""
        silent = [self._joints[i] for i in np.flatnonzero(~state.answered)]
        return MonitorResult(note=f"no answer from {', '.join(silent)}" if silent else "")

    def write(self, state: RobotState, command: Command, verdict: MonitorResult) -> tuple[NDArray[np.int64], Command]:
        """Execute a command; returns goal currents [joint] in counts, and the executed command."""
        return np.zeros(len(self._joints), dtype=np.int64), command

    def release(self) -> Release:
        """Switch torque off and read it back."""
        return Release((), {})


class Safety(Onlooker):
    """Checks, energises, limits, watches and releases the robot.

    Args:
        current_scale: share of the peak currents that is allowed, for a suspended robot or first trials.
        torque: whether torque may be switched on at all; if not, currents are computed but not sent.
    """

    def __init__(
        self,
        bus: Bus,
        limits: Limits | None = None,
        *,
        current_scale: float = 1.0,
        torque: bool = True,
        report: Callable[[str], None] = print,
    ):
        super().__init__(bus, limits, report)
        if not 0 < current_scale <= 1:
            raise ValueError(f"current_scale must be above 0 and at most 1, got {current_scale}")
        self.torque, self._writer = torque, bus.writer()
        self._limiter = CurrentLimiter(self.limits, bus.robot, PERIOD, current_scale)
        self._monitor = Monitor(self.limits, bus.robot, PERIOD)
        self._gain_share = 1.0
        self._damped = False
        self._written = np.zeros(len(bus.joints), dtype=np.int64)
        self._write_time: float | None = None
        self._without = np.zeros(len(bus.joints), dtype=np.int64)

    @property
    def load(self) -> NDArray[np.float64]:
        """See `CurrentLimiter.load`."""
        return self._limiter.load

    def check_start(self, *, whole: bool = True) -> None:
        """Run the start checks, or only the checks required for writing.

        Raises:
            Stop: if a check fails; nothing is energised.
        """
        checks = self._checks(self._writer)
        last = checks.run() if whole else checks.run_power()
        if not last.ok:
            raise Stop(ExitCode.START_CHECK, f"{last.name}: {last.detail}")

    def prepare(self) -> None:
        """Choose how a tick is read, and report it."""
        block = self._writer.prepare_block()
        way = "fast sync read" if block.fast else "sync read"
        self._report(f"reading {block.length} bytes per servo by {way}")

    def write_settings(self, values: Mapping[str, int | dict[str, int]]) -> None:
        """Write the registers that differ on any servo, after switching torque off.

        Raises:
            Stop: if a servo does not accept a value.
        """
        for register, value in ({"torque_enable": 0} | dict(values)).items():
            self._set(register, value)

    def energise(self) -> None:
        """Switch torque on in the only safe order.

        A change of the operating mode sets the goal current to the current limit, so the goal is written afterwards,
        and read back from every servo before torque is switched on. A tripped watchdog makes the goals read-only, so it
        is cleared first; it is armed last, because from then on the loop must run.

        Raises:
            Stop: if a servo does not accept a value.
        """
        self.touched = True
        peak = np.floor(self._limiter.limit).astype(int)
        current_limits = {name: int(value) for name, value in zip(self._joints, peak, strict=True)}
        self.write_settings({"bus_watchdog": 0, "operating_mode": CURRENT_MODE, "current_limit": current_limits})
        self._set("goal_current", 0, always=True)
        self._set("torque_enable", 1)
        self._set("bus_watchdog", WATCHDOG)
        self._write_time = self.bus.clock.now()
        self._report("torque on, watchdog armed")

    def _set(self, register: str, values: dict[str, int] | int, *, always: bool = False) -> None:
        """Write a register of all servos until it reads back; values already there are not written again.

        EEPROM wears out, so a servo that already has the value is skipped unless `always`.
        """
        wanted = dict.fromkeys(self._joints, values) if isinstance(values, int) else values
        try:
            if always:
                self._writer.sync_write(register, wanted)
            for attempt in range(2 * ATTEMPTS + 1):
                there = self.bus.sync_read(register)
                wrong = {name: value for name, value in wanted.items() if there.get(name) != value}
                if not wrong:
                    return
                if attempt < 2 * ATTEMPTS:
                    self._writer.sync_write(register, wrong)
        except BusError as error:
            raise Stop(ExitCode.ENERGISE, str(error)) from error
        what = ", ".join(f"{name} ({there.get(name, 'no answer')})" for name in wrong)
        raise Stop(ExitCode.ENERGISE, f"{register} could not be set on {what}")

    def assess(self, tick: Tick, state: RobotState) -> MonitorResult:
        """Check a reading; raises `Stop` if the run must end."""
        self._check_gap()
        verdict = self._monitor.judge(tick.index, tick.deadline, state)
        if self.torque and self._damped and not verdict.damp:
            self._check_torque()
        self._damped = verdict.damp
        if self.torque:
            self._check_letting_go(state)
        return verdict

    def _check_letting_go(self, state: RobotState) -> None:
        """Detect a servo whose torque another program switched off: it answers as before but delivers no current. A
        fast-moving servo is not checked, because little voltage remains for a current.
        """
        slow = np.abs(state.velocity) < 0.5 * self.bus.robot.speed_limits
        asked = state.answered & slow & (np.abs(self._written) >= ASKED)
        without = asked & (np.abs(state.raw["current"]) < 0.1 * np.abs(self._written))
        self._without = np.where(without, self._without + 1, 0)
        if not (self._without >= LET_GO).any():
            return
        joint = self._joints[int(self._without.argmax())]
        ticks = int(self._without.max())
        goal = abs(int(self._written[int(self._without.argmax())]))
        said = f"{joint} delivers no current for {ticks} ticks at a goal of {goal} counts"
        off = False
        with suppress(NoAnswer):
            off = ticks % LET_GO == 0 and not self.bus.read(joint, "torque_enable", attempts=1)
        if off:
            reason = f"torque of {joint} was switched off by another program: {said}; end that program"
            raise Stop(ExitCode.TORQUE_LOST, reason)
        if ticks >= SILENT:
            raise Stop(ExitCode.TORQUE_LOST, f"{said}, although its torque is on; check its motor and its driver")

    def _check_gap(self) -> None:
        """Stop after a pause that tripped the servos' watchdogs, which then ignore all goals."""
        if not self.torque or self._write_time is None:
            return
        gap = self.bus.clock.now() - self._write_time
        if gap >= WATCHDOG * WATCHDOG_UNIT:
            reason = (
                f"nothing was written for {1e3 * gap:.0f} ms, so the servos' watchdogs have switched their torque off"
            )
            raise Stop(ExitCode.OVERRUN, f"{reason}; stop other programs on this computer")

    def _check_torque(self) -> None:
        """After a long silence, check for servos that have restarted and have no torque."""
        off = [name for name, value in self.bus.sync_read("torque_enable").items() if not value]
        if off:
            raise Stop(
                ExitCode.SERVO_SHUTDOWN,
                f"torque is off in {', '.join(off)} after an unexpected restart; check the power supply",
            )

    def write(self, state: RobotState, command: Command, verdict: MonitorResult) -> tuple[NDArray[np.int64], Command]:
        """Apply PD and all limits, and send the goal currents.

        A servo that did not answer keeps its goal while coasting, and gets zero current while damping.

        Returns:
            Goal currents [joint] in counts, and the executed command.

        Raises:
            Stop: if a number is not finite, or the robot would hit itself at the commanded angles; nothing is written.
            Unplugged: if the port has disappeared.
        """
        command = command.limited(self.bus.robot)
        self._monitor.judge_command(state, command)
        if verdict.damp:
            self._gain_share = 0.0
            command = command.damped(self.limits.damp_gain)
        elif self._gain_share < 1:
            self._gain_share = min(1.0, self._gain_share + PERIOD / RECOVERY_TIME)
            command = Command(command.position, self._gain_share * command.p_gain, command.d_gain)
        silent = 0 if verdict.damp else self._written
        self._written = np.where(state.answered, self._limiter.counts(state, command), silent)
        self._check_gap()
        if self.torque:
            self._writer.write_currents(self._written)
        self._write_time = self.bus.clock.now()
        self._limiter.account(self._written, state)
        return self._written, command

    def release(self, patience: float = RELEASE_PATIENCE) -> Release:
        """Switch torque off and read it back; tries for `patience` [s] on a bus that does not answer.

        Faults of the bus raise no exception; they are in the report.
        """
        clock = self.bus.clock
        end = clock.now() + patience
        for attempt in count():
            # Alternates between a tick's timeouts and those of a replugged adapter.
            waits = (SLOW_ANSWER, SLOW_ANSWER) if attempt % 2 else (FIRST_ANSWER, GAP)
            with self.bus.patience(*waits):
                result = self._release_once()
            if result.ok or clock.now() >= end:
                break
            clock.sleep_until(clock.now() + 0.05)
        if result.ok:
            self.touched = False
            # A tripped watchdog freezes the goals. With torque off it is safe to clear, and the goals are then
            # zero for the next program that switches torque on.
            self._attempt(lambda: self._writer.sync_write("bus_watchdog", 0))
            self._attempt(lambda: self._writer.sync_write("goal_current", 0))
        self._report(str(result))
        return result

    def _release_once(self) -> Release:
        for _ in range(RELEASE_WRITES):
            self.bus.clear()
            self._attempt(lambda: self._writer.sync_write("goal_current", 0))
            self._attempt(lambda: self._writer.sync_write("torque_enable", 0))
        there: dict[str, int] = {}
        self._attempt(lambda: there.update(self.bus.sync_read("torque_enable")))
        for name in self._joints:
            # A silent servo hides later servos from a sync read.
            if name not in there:
                self._attempt(lambda name=name: there.update({name: self.bus.read(name, "torque_enable", attempts=1)}))
        failed = {name: "still on" if name in there else "no answer" for name in self._joints if there.get(name) != 0}
        return Release(tuple(name for name in self._joints if name not in failed), failed)

    def _attempt(self, call: Callable[[], object]) -> None:
        """Call a function of the bus; if the port has disappeared, try to reopen it."""
        with suppress(BusError):
            try:
                call()
            except Unplugged:
                self.bus.open()
