"""A live view of the robot in the terminal."""

from __future__ import annotations

import shutil
import sys
import threading
from contextlib import suppress
from queue import Queue
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from op3.deploy.limits import Command
from op3.deploy.monitors import MonitorResult
from op3.deploy.registers import Units
from op3.deploy.robot_state import RobotState
from op3.deploy.ticker import PERIOD, Ticker
from op3.robot import Robot

RECENT = 1250
"""Number of ticks whose lateness is shown, ten seconds."""


class StatusPanel:
    """Rewrites a block of text a few times a second, if the output is a terminal. A separate thread writes it, so that
    a stalled terminal, for example on a slow network, does not block the loop. Updates that it cannot show in time are
    skipped; messages appear above the block and remain.

    Args:
        wanted: whether to show the block; messages always appear.
    """

    def __init__(self, robot: Robot, wanted: bool = True, stream: TextIO | None = None, every: int = 31):
        self._joints, self._unit = robot.joints, Units(robot).current
        self._stream = stream or sys.stdout
        self._every = every
        self._ticks = self._lines = 0
        self._waiting: Queue[list[str] | str | None] = Queue()
        self._thread: threading.Thread | None = None
        self.enabled = wanted and self._stream.isatty()

    def __call__(
        self,
        phase: str,
        state: RobotState,
        command: Command,
        counts: NDArray[Any],
        verdict: MonitorResult,
        ticker: Ticker,
    ) -> None:
        """Show a tick if an update is due."""
        self._ticks += 1
        if self.enabled and self._ticks % self._every == 1 and self._waiting.empty():
            self._put(self.text(phase, state, command, counts * self._unit, verdict, ticker))

    def say(self, line: str) -> None:
        """Print a line that remains; immediately if no block is shown."""
        if self._thread is None:
            self._print(line)
        else:
            self._put(line)

    def close(self, patience: float = 1.0) -> None:
        """Write the remaining text, if the terminal accepts it within a time [s]."""
        if self._thread is not None:
            self._waiting.put(None)
            self._thread.join(patience)
            self._thread = self._thread if self._thread.is_alive() else None

    def _put(self, item: list[str] | str) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._serve, daemon=True)
            self._thread.start()
        self._waiting.put(item)

    def _serve(self) -> None:
        with suppress(OSError, ValueError):  # the terminal is gone
            for item in iter(self._waiting.get, None):
                if isinstance(item, str):
                    self._print(item)
                    self._lines = 0  # the next block begins below
                else:
                    self._write(item)

    def _print(self, line: str) -> None:
        self._stream.write(line + "\n")
        self._stream.flush()

    def _write(self, lines: list[str]) -> None:
        # Wrapped lines and lines above the window cannot be rewritten in place.
        columns, rows = shutil.get_terminal_size()
        shown = lines if len(lines) < rows else [*lines[: rows - 2], lines[-1]]
        lines = [line[: columns - 1] for line in shown]
        up = f"\x1b[{self._lines}A" if self._lines else ""
        self._stream.write(up + "".join(f"\x1b[2K{line}\n" for line in lines))
        self._stream.flush()
        self._lines = len(lines)

    def text(
        self,
        phase: str,
        state: RobotState,
        command: Command,
        goal: NDArray[Any],
        verdict: MonitorResult,
        ticker: Ticker,
    ) -> list[str]:
        """One row per joint, between time and attitude above and deadlines and warnings below; currents in A."""
        timing, attitude = ticker.timing(last=RECENT), ""
        if state.orientation is not None:
            attitude = "roll {:6.1f} pitch {:6.1f} deg   ".format(*np.rad2deg(state.orientation[:2]))
        lines = [
            f"{phase:8s} {timing.ticks * PERIOD:8.1f} s   {attitude}{state.supply_voltage:.1f} V",
            f"{'joint':12s} {'target':>8s} {'angle':>8s} {'Kp':>6s} {'goal A':>7s} {'is A':>7s} {'C':>4s}",
        ]
        columns = (command.position, state.position, command.p_gain, goal, state.current, state.temperature)
        for name, answered, *row in zip(self._joints, state.answered, *columns, strict=True):
            numbers = "{:8.3f} {:8.3f} {:6.2f} {:7.2f} {:7.2f} {:4.0f}".format(*row)
            lines.append(f"{name:12s} {numbers}{'' if answered else '  no answer'}")
        late = f"late p99 {1e3 * timing.p99:.2f} max {1e3 * timing.max:.2f} ms, missed {timing.misses}"
        return [*lines, f"{late}: {verdict.note or 'ok'}"]
