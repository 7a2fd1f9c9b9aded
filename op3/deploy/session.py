"""A run from start checks to torque off, whatever happens in between."""

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

from op3.deploy.bus import Bus, BusError, Unplugged
from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.loop import Loop
from op3.deploy.operator import Operator, told
from op3.deploy.phases import Phase
from op3.deploy.safety import Guard, Release, Safety
from op3.deploy.ticker import Timing
from op3.rollout import LogError, Metadata, Recorder, Rollout

LOG_NAMES = ("approach", "run", "after")
"""Logs that a run can leave."""

Phases = Callable[[Loop], Sequence[Phase]]
"""Makes the phases of a run; the loop is there for those that go on from its last targets."""


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        code: of the process.
        reason: one sentence.
        release: what became of switching torque off; None where it was never on.
        timing: how well deadlines were kept.
        logs: finished logs by name.
        ended_in: the log in which the run ended early; None if it did not.
    """

    code: ExitCode
    reason: str
    release: Release | None
    timing: Timing
    logs: dict[str, Rollout] = field(default_factory=dict)
    ended_in: str | None = None


class Logs:
    """The logs of a run, one folder per name.

    Args:
        folder: where they are written.
        metadata: what is known at the start.
        only: names that are written; None for all.
    """

    def __init__(self, folder: Path, metadata: Metadata, only: Sequence[str] | None = None):
        self._folder, self._metadata, self._only = folder, metadata, only
        self._recorders: dict[str, Recorder] = {}
        self._start: float | None = None

    def open(self) -> None:
        """Make the folders now: a disk may take longer for that than a running loop has time."""
        for name in LOG_NAMES if self._only is None else self._only:
            self._recorder(name)

    def _recorder(self, name: str) -> Recorder:
        if name not in self._recorders:
            label = name if self._metadata.recording is None else f"{self._metadata.recording}/{name}"
            self._recorders[name] = Recorder(self._folder / name, self._metadata.replace(recording=label))
        return self._recorders[name]

    def __call__(self, name: str, row: dict[Any, Any]) -> None:
        """Add a row to a log. Time counts from the first row of the run."""
        if self._only is not None and name not in self._only:
            return
        if self._start is None:
            self._start = row["time"]
        row["time"] = row["time"] - self._start
        self._recorder(name).append(row)

    def close(self, fell_in: str | None, extra: dict[str, Any]) -> dict[str, Rollout]:
        """Finish all logs; one that cannot be finished stays behind as a crash would leave it.

        Args:
            fell_in: the log in which the robot fell; None if it did not.
            extra: further metadata.
        """
        done = {}
        for name, recorder in self._recorders.items():
            try:
                done[name] = recorder.close(fallen=name == fell_in, extra={**self._metadata.extra, **extra})
            except (LogError, OSError) as error:
                if recorder.rows:  # one without rows takes its folder away
                    print(f"log {name}: {error}", file=sys.stderr)
        return done


_CODES = {
    signal.SIGINT: ExitCode.INTERRUPTED,
    signal.SIGTERM: ExitCode.TERMINATED,
    signal.SIGHUP: ExitCode.HANGUP,
    signal.SIGQUIT: ExitCode.QUIT,
}


class StopSignals:
    """While it is entered, the first signal raises `Stop` wherever the program is; later ones are only counted.

    So an impatient second Ctrl-C cannot interrupt switching off. `hush` says that from now on even the first signal
    is only counted: the exit path has begun. In a thread other than the main one signals are left alone.

    Foreign code may swallow what is raised in it, as a finaliser or a bare `except` does; `check` raises it again.

    Attributes:
        count: signals so far.
    """

    def __init__(self) -> None:
        self.count = 0
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
        self._before = {}

    def hush(self) -> None:
        """Let no signal interrupt what follows."""
        self._quiet = True

    def check(self) -> None:
        """Raise the first signal's `Stop` once more, if there was a signal and the program still goes on."""
        if self._stop is not None and not self._quiet:
            raise self._stop

    def _receive(self, number: int, _: FrameType | None) -> None:
        self.count += 1
        if self.count > 1 or self._quiet:
            return
        name = signal.Signals(number)
        self._stop = Stop(_CODES[name], f"stopped by {name.name}")
        raise self._stop


class Session:
    """One run of phases on the robot.

    Args:
        bus: the robot's.
        safety: the guard that writes, or an onlooker that only reads.
        operator: asked before torque goes on.
        logs: takes every tick; None for no log.
        show: live panel; see `Loop`.
        report: where lines for the operator go.
        sysfs: where the kernel shows serial adapters.
    """

    def __init__(
        self,
        bus: Bus,
        safety: Guard,
        operator: Operator,
        *,
        logs: Logs | None = None,
        show: Callable[..., None] | None = None,
        report: Callable[[str], None] = print,
        sysfs: Path | None = None,
    ):
        self._bus, self._safety, self._operator = bus, safety, operator
        self._logs, self._report, self._sysfs = logs, told(report), sysfs
        self._signals = StopSignals()
        self._loop = Loop(bus, safety, log=logs, show=show, check=self._signals.check)
        self._release: Release | None = None

    def run(self, phases: Phases) -> Outcome:
        """Check, energise, run the phases, switch off; whatever ends it is in the outcome.

        Anything that is no `Exception` (such as `SystemExit`) passes on after torque has been switched off.
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
                # A signal may have come between the end of the work and `hush`; only the first one raises.
                self._let_go()
            logs = self._close_logs(code, reason)
        if code in (ExitCode.UNPLUGGED, ExitCode.BUS_LOSS) and not self._loop.timing().ticks and self._release is None:
            code = ExitCode.START_CHECK  # the bus failed on the way to the first tick, with nothing energised
        if self._release is not None and not self._release.ok:
            code, reason = ExitCode.NOT_VERIFIED, f"{reason}; {self._release}"
        timing = self._loop.timing()
        if timing.ticks:
            self._report(str(timing))
        self._report(f"{code.name.lower()} ({int(code)}): {reason}")
        return Outcome(code, reason, self._release, timing, logs, self._loop.ended_in)

    def _work(self, phases: Phases) -> None:
        safety = self._safety
        armed = isinstance(safety, Safety) and safety.torque
        if isinstance(safety, Safety):
            safety.check_start(**({} if self._sysfs is None else {"sysfs": self._sysfs}))
            safety.prepare()
            if armed and not self._operator.confirm("The robot is about to move. Hold it, keep hands off its joints."):
                raise Stop(ExitCode.DECLINED, "not confirmed")
        # Whatever takes time is done before torque: from then on the watchdogs allow no pause of 100 ms.
        made = phases(self._loop)
        if self._logs is not None:
            self._logs.open()
        self._read_all()
        with _collected_garbage():
            if armed:
                assert isinstance(safety, Safety)
                self._signals.check()
                safety.energise()
            self._loop.run(made)

    def _read_all(self) -> None:
        """Readings until everything has answered once, so that no value is made up."""
        heard, imu = None, False
        for _ in range(20):
            state = self._bus.read_state()
            heard = state.answered if heard is None else heard | state.answered
            imu = imu or state.imu_answered
            if heard.all() and imu:
                return
        raise Stop(ExitCode.START_CHECK, "not everything on the bus answers a reading; check cables and power")

    def _let_go(self) -> None:
        if isinstance(self._safety, Safety) and self._safety.touched and self._release is None:
            self._bus.clear()
            self._release = self._safety.release()

    def _close_logs(self, code: ExitCode, reason: str) -> dict[str, Rollout]:
        if self._logs is None:
            return {}
        timing = self._loop.timing()
        extra: dict[str, Any] = {
            "exit": code.name.lower(),
            "reason": reason,
            "ticks": timing.ticks,
            "missed_ticks": timing.misses,
            "lateness_p50": timing.p50,
            "lateness_p99": timing.p99,
            "lateness_max": timing.max,
        }
        if isinstance(self._safety, Safety):
            extra["largest_load"] = float(np.max(self._safety.load))
        return self._logs.close(self._loop.ended_in if code == ExitCode.FALL else None, extra)


@contextmanager
def _collected_garbage() -> Iterator[None]:
    """Take everything that is there out of the garbage collector's sight.

    A full collection in a process with torch and MuJoCo loaded takes longer than a tick, and grows with what is loaded.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
