"""The control loop: read all, safety, command, PD, clamp, write - in every tick, in this order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from op3.deploy.bus import Bus
from op3.deploy.exit_codes import Stop
from op3.deploy.limits import Command
from op3.deploy.monitors import Verdict
from op3.deploy.phases import Phase
from op3.deploy.safety import Guard
from op3.deploy.state import State
from op3.deploy.ticker import PERIOD, Tick, Ticker, Timing

RAW = ("current", "velocity", "position", "hardware_error", "imu")
"""Registers that are kept as they came."""

IMU = ("orientation", "angular_velocity", "linear_acceleration")

LogRow = Callable[[str, dict[Any, Any]], None]
"""Takes the name of a log and a row of it."""


class Loop:
    """Runs phases one after the other, without a break between them.

    Args:
        bus: to read from.
        safety: judges and writes.
        log: takes every tick's row; None for no log.
        show: called at the end of every tick with phase, state, command, goal currents [joint], verdict and ticker.
        check: called at the beginning of every tick; raises `Stop` where something outside the loop asks for it.
        period: of a tick [s].
    """

    def __init__(
        self,
        bus: Bus,
        safety: Guard,
        *,
        log: LogRow | None = None,
        show: Callable[..., None] | None = None,
        check: Callable[[], None] | None = None,
        period: float = PERIOD,
    ):
        self._check = check
        self._bus, self._safety, self._log, self._show = bus, safety, log, show
        self._period = period
        self._ticker: Ticker | None = None
        self._phase = ""
        self._name = "approach"
        self._channels: dict[Any, Any] = {}
        self.target: NDArray[np.float64] | None = None
        """Targets of the last tick [joint] in rad."""
        self.ended_in: str | None = None
        """The log in which the run ended early; None while it has not."""

    def timing(self) -> Timing:
        """How well the deadlines have been kept so far."""
        return Timing() if self._ticker is None else self._ticker.timing()

    def run(self, phases: Sequence[Phase]) -> None:
        """Run the phases to their end.

        Raises:
            Stop: where the run has to end early; the joints have been damped then if they should be.
        """
        self._ticker = Ticker(self._bus.clock, self._period)
        waiting = list(phases)
        phase, began = waiting.pop(0), 0
        try:
            while True:
                tick = self._ticker.wait()
                if self._check is not None:
                    self._check()
                state = self._bus.read_state()
                verdict = self._safety.assess(tick, state)
                command = phase.command(tick.index - began, state)
                while command is None:
                    if not waiting:
                        return
                    phase, began = waiting.pop(0), tick.index
                    command = phase.command(0, state)
                self._phase, self._name, self._channels = phase.name, phase.log, phase.channels()
                self._end_tick(tick, state, command, verdict)
        except Stop as stop:
            self.ended_in = self._name
            if stop.damp and self._safety.torque:
                self._damp(stop)
            raise

    def _end_tick(self, tick: Tick, state: State, command: Command, verdict: Verdict) -> None:
        counts, issued = self._safety.write(state, command, verdict)
        self.target = issued.position
        self._keep(tick, state, issued, counts)
        if self._show is not None:
            self._show(self._phase, state, issued, counts, verdict, self._ticker)

    def _damp(self, reason: Stop) -> None:
        """Brake for a while before torque goes off; a graver reason in between cuts it short."""
        assert self._ticker is not None
        limits = self._safety.limits
        self._name, self._channels = "after", {}
        for _ in range(round(limits.damp_time / self._period)):
            tick = self._ticker.wait()
            state = self._bus.read_state()
            try:
                self._safety.assess(tick, state)
            except Stop as stop:
                if not stop.damp:
                    raise reason from stop
            command = Command.of(state.position if self.target is None else self.target, 0.0, 0.0)
            counts, issued = self._safety.write(state, command, Verdict(damp=True))
            self._keep(tick, state, issued, counts)

    def _keep(self, tick: Tick, state: State, command: Command, counts: NDArray[np.int64]) -> None:
        if self._log is None:
            return
        row: dict[Any, Any] = {
            "time": tick.deadline + tick.lateness,
            ("command", "position"): command.position,
            ("command", "p_gain"): command.p_gain,
            ("command", "d_gain"): command.d_gain,
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
        self._log(self._name, row)
