"""A run from start checks to torque off, which is reached whatever happens.

In every tick, the loop reads all devices, checks the readings, takes the command, computes PD and limits, and writes.
"""

from __future__ import annotations

import gc
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from op3.deploy.dynamixel_bus import Bus, BusError, Unplugged
from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.limits import Command
from op3.deploy.monitors import MonitorResult
from op3.deploy.operator import Operator, quietly
from op3.deploy.phases import Phase
from op3.deploy.robot_state import RobotState
from op3.deploy.safety import Onlooker, Release
from op3.deploy.ticker import PERIOD, Tick, Ticker, Timing
from op3.rollout import LogError, Metadata, Recorder, Rollout

LOG_NAMES = ("approach", "run", "after")
"""Logs that a run may write."""

RAW = ("current", "velocity", "position", "hardware_error", "imu")
"""Registers that are logged unconverted."""

IMU = ("orientation", "angular_velocity", "linear_acceleration")
"""Further registers of a robot with an IMU."""


@dataclass(frozen=True)
class SessionOutcome:
    """How a run ended: exit code and reason, finished logs by name, and statistics of the deadlines.

    Attributes:
        release: result of switching torque off; None if it was never on.
        ended_in: the log in which the run ended early; None if it ended normally.
    """

    code: ExitCode
    reason: str
    release: Release | None
    timing: Timing
    logs: dict[str, Rollout] = field(default_factory=dict)
    ended_in: str | None = None


class Logs:
    """The logs of a run, one folder per name."""

    def __init__(self, folder: Path, metadata: Metadata):
        self._folder, self._metadata = folder, metadata
        self._recorders: dict[str, Recorder] = {}
        self._start: float | None = None

    def open(self) -> None:
        """Create the folders before the loop starts, because this takes too long for a tick."""
        for name in LOG_NAMES:
            label = name if self._metadata.recording is None else f"{self._metadata.recording}/{name}"
            self._recorders[name] = Recorder(self._folder / name, self._metadata.replace(recording=label))

    def __call__(self, name: str, row: dict[Any, Any]) -> None:
        """Add a row to a log. Time counts from the first row of the run."""
        if self._start is None:
            self._start = row["time"]
        row["time"] = row["time"] - self._start
        self._recorders[name].append(row)

    def close(self, fell_in: str | None, extra: dict[str, Any]) -> dict[str, Rollout]:
        """Finish all logs; a log that cannot be finished remains as after a crash.

        `fell_in` is the log in which the robot fell, if it did.
        """
        done = {}
        for name, recorder in self._recorders.items():
            try:
                done[name] = recorder.close(fallen=name == fell_in, extra={**self._metadata.extra, **extra})
            except (LogError, OSError) as error:
                if recorder.rows:  # a recorder without rows removes its folder
                    print(f"log {name}: {error}", file=sys.stderr)
        return done


_CODES = {
    signal.SIGINT: ExitCode.INTERRUPTED,
    signal.SIGTERM: ExitCode.TERMINATED,
    signal.SIGHUP: ExitCode.HANGUP,
    signal.SIGQUIT: ExitCode.QUIT,
}


class StopSignals:
    """Within this context, the first signal raises `Stop` wherever the program is; later signals are ignored.

    A second Ctrl-C therefore cannot interrupt switching off. After `hush` even the first signal is ignored, because the
    exit path has begun. In threads other than the main one, signals are unchanged.

    A finaliser or a bare `except` may swallow the exception; `check` raises it again.
    """

    def __init__(self) -> None:
        self._stop: Stop | None = None
        self._quiet = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._receive) for number in _CODES}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def hush(self) -> None:
        """Ignore all signals from now on."""
        self._quiet = True

    def check(self) -> None:
        """Raise the first signal's `Stop` again, if there was a signal and the program is still running."""
        if self._stop is not None and not self._quiet:
            raise self._stop

    def _receive(self, number: int, _: FrameType | None) -> None:
        if self._stop is not None or self._quiet:
            return
        name = signal.Signals(number)
        self._stop = Stop(_CODES[name], f"stopped by {name.name}")
        raise self._stop


class Session:
    """One run of phases on the robot.

    Args:
        safety: the safety guard that writes, or an onlooker that only reads.
        logs: logs that receive every tick; None: no log.
        show: function called at the end of every tick with phase, state, command, goal currents [joint], verdict and
            ticker.

    Attributes:
        issued: the executed command of the last tick; None before the first.
    """

    def __init__(
        self,
        bus: Bus,
        safety: Onlooker,
        operator: Operator,
        *,
        logs: Logs | None = None,
        show: Callable[..., None] | None = None,
        report: Callable[[str], None] = print,
    ):
        self._bus, self._safety, self._operator = bus, safety, operator
        self._logs, self._show, self._report = logs, show, quietly(report)
        self._signals = StopSignals()
        self._release: Release | None = None
        self._ticker: Ticker | None = None
        self._log, self._channels = LOG_NAMES[0], {}
        self._ended_in: str | None = None
        self.issued: Command | None = None

    @property
    def timing(self) -> Timing:
        """Statistics of the deadlines so far."""
        return Timing() if self._ticker is None else self._ticker.timing()

    def run(self, phases: Phases) -> SessionOutcome:
        """Check, energise, run the phases, switch off; the outcome states what ended the run.

        `SystemExit` and the like are raised again after torque has been switched off.
        """
        code, reason = ExitCode.OK, "done"
        with self._signals as signals:
            try:
                try:
                    self._work(phases)
                finally:
                    signals.hush()
                    self._let_go()
            except Stop as stop:
                code, reason = stop.code, stop.reason
            except Unplugged as error:
                code, reason = ExitCode.UNPLUGGED, str(error)
            except BusError as error:
                code, reason = ExitCode.BUS_LOSS, str(error)
            except Exception as error:
                traceback.print_exc()
                code, reason = ExitCode.ERROR, f"{type(error).__name__}: {error}"
            finally:
                # A signal may have arrived between the end of the phases and `hush`; only the first signal raises.
                self._let_go()
            logs = self._close_logs(code, reason)
        timing = self.timing
        if code in (ExitCode.UNPLUGGED, ExitCode.BUS_LOSS) and not timing.ticks and self._release is None:
            code = ExitCode.START_CHECK  # the bus failed before the first tick, and nothing was energised
        if self._release is not None and not self._release.ok:
            code, reason = ExitCode.NOT_VERIFIED, f"{reason}; {self._release}"
        if timing.ticks:
            self._report(str(timing))
        self._report(f"{code.name.lower()} ({int(code)}): {reason}")
        return SessionOutcome(code, reason, self._release, timing, logs, self._ended_in)

    def _work(self, phases: Phases) -> None:
        safety = self._safety
        safety.check_start()
        safety.prepare()
        question = "The robot is about to move. Hold it, and keep your hands off its joints."
        if safety.torque and not self._operator.confirm(question):
            raise Stop(ExitCode.DECLINED, "not confirmed")
        # Slow work is done before torque: afterwards the watchdogs allow no pause of 100 ms.
        made = phases(self)
        if self._logs is not None:
            self._logs.open()
        self._read_all()
        with _collected_garbage():
            if safety.torque:
                self._signals.check()
                safety.energise()
            try:
                self._loop(made)
            except Stop as stop:
                self._ended_in = self._log
                if stop.damp and safety.torque:
                    self._damp(stop)
                raise

    def _read_all(self) -> None:
        """Read until every device has answered once, so that no value is invented."""
        heard: Any = False
        for _ in range(20):
            state = self._bus.read_state()
            heard = heard | np.append(state.answered, state.imu_answered is not False)
            if heard.all():
                return
        raise Stop(ExitCode.START_CHECK, "some devices on the bus do not answer; check cables and power")

    def _loop(self, phases: Sequence[Phase]) -> None:
        """Run the phases to their end without a pause between them."""
        self._ticker = Ticker(self._bus.clock)
        waiting = list(phases)
        phase, began = waiting.pop(0), 0
        while True:
            tick = self._ticker.wait()
            self._signals.check()
            state = self._bus.read_state()
            verdict = self._safety.assess(tick, state)
            command = phase.command(tick.index - began, state)
            while command is None:
                if not waiting:
                    return
                phase, began = waiting.pop(0), tick.index
                command = phase.command(0, state)
            self._log, self._channels = phase.log, phase.channels()
            counts, self.issued = self._carry_out(tick, state, command, verdict)
            if self._show is not None:
                self._show(phase.name, state, self.issued, counts, verdict, self._ticker)

    def _damp(self, reason: Stop) -> None:
        """Damp the joints for some time before torque is switched off; a more severe event ends the damping."""
        assert self._ticker is not None
        self._log, self._channels = "after", {}
        for _ in range(round(self._safety.limits.damp_time / PERIOD)):
            tick = self._ticker.wait()
            state = self._bus.read_state()
            try:
                self._safety.assess(tick, state)
            except Stop as stop:
                if not stop.damp:
                    raise reason from stop
            command = Command.of(state.position if self.issued is None else self.issued.position, 0.0, 0.0)
            self._carry_out(tick, state, command, MonitorResult(damp=True))

    def _carry_out(
        self, tick: Tick, state: RobotState, command: Command, verdict: MonitorResult
    ) -> tuple[NDArray[np.int64], Command]:
        """Write a command and log the tick; see `Onlooker.write`."""
        counts, issued = self._safety.write(state, command, verdict)
        if self._logs is None:
            return counts, issued
        row: dict[Any, Any] = {
            "time": tick.deadline + tick.lateness,
            ("command", "position"): issued.position,
            ("command", "p_gain"): issued.p_gain,
            ("command", "d_gain"): issued.d_gain,
            ("joint", "position"): state.position,
            ("joint", "velocity"): state.velocity,
            ("joint", "current"): state.current,
            ("joint", "voltage"): state.voltage,
            ("joint", "temperature"): state.temperature,
            ("raw", "goal_current"): counts,
            ("raw", "answered"): state.answered,
            ("raw", "lateness"): tick.lateness,
            **{("raw", name): state.raw[name] for name in RAW if name in state.raw},
            **{("imu", name): getattr(state, name) for name in IMU if state.orientation is not None},
            **self._channels,
        }
        if not self._safety.torque:
            row["command", "torque_enable"] = np.zeros(len(counts))
        self._logs(self._log, row)
        return counts, issued

    def _let_go(self) -> None:
        if self._safety.touched and self._release is None:
            self._bus.clear()
            self._release = self._safety.release()

    def _close_logs(self, code: ExitCode, reason: str) -> dict[str, Rollout]:
        if self._logs is None:
            return {}
        timing, load = self.timing, float(np.max(self._safety.load))
        extra = {"exit": code.name.lower(), "reason": reason, "ticks": timing.ticks, "missed_ticks": timing.misses}
        extra |= {f"lateness_{name}": getattr(timing, name) for name in ("p50", "p99", "max")} | {"largest_load": load}
        return self._logs.close(self._ended_in if code == ExitCode.FALL else None, extra)


Phases = Callable[[Session], Sequence[Phase]]
"""Builds the phases of a run; phases that continue from the last targets read them from the session."""


@contextmanager
def _collected_garbage() -> Iterator[None]:
    """Exclude all existing objects from garbage collection.

    A full collection in a process with torch and MuJoCo takes longer than a tick.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
