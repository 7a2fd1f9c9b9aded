"""What is watched in every tick, and when it coasts, damps or ends the run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.limits import Limits
from op3.deploy.registers import HardwareError
from op3.deploy.state import State
from op3.robot import JOINTS
from op3.robot.servo_make import load_servo
from op3.robot.units import POSITION_UNIT

CONFIRMED = 3
"""Readings in a row that confirm a temperature; a single reading may be a glitch."""

ALIVE_COUNTS = 50
"""A servo that answers has at least 5 V; one that says less has started anew and lost its indirect addresses."""

FASTEST = 3.0 * load_servo("xm430-w350").limits.no_load_speed.si
"""No joint moves this fast [rad/s], even when it is pushed: three times the servo's speed without load."""

LEAST_JUMP = 0.1
"""A position that differs by less from reading to reading has not jumped [rad]."""

SAG_READINGS = 10
"""Readings in a row that confirm a low supply; a step of load makes it sag for some milliseconds."""


@dataclass(frozen=True)
class Verdict:
    """What a tick may do.

    Attributes:
        damp: whether the joints are damped instead of driven.
        silent: how long the most silent servo or the IMU has not answered [ticks].
        note: what the operator should know, empty if all is well.
    """

    damp: bool = False
    silent: int = 0
    note: str = ""


class Monitor:
    """Judges one reading after the other.

    Args:
        limits: when to act.
        period: of the loop [s].
    """

    def __init__(self, limits: Limits, period: float):
        self._limits = limits
        self._loss_ticks = round(limits.loss_time / period)
        self._period = period
        self._last_heard = np.full(len(JOINTS) + 1, -1)
        self._last_position: NDArray[np.float64] | None = None
        self._upright = 0.0
        self._started = False
        self._block: bytes | None = None
        self._repeats = 1
        self._hot = 0
        self._low = 0

    def judge(self, tick: int, time: float, state: State) -> Verdict:
        """Judge the reading of one tick.

        Args:
            tick: number of the deadline.
            time: of the deadline [s].
            state: the reading.

        Raises:
            Stop: where the run has to end; `Stop.damp` says whether the joints are damped first.
        """
        if not self._started:
            self._started, self._upright = True, time
            self._last_heard[:] = tick - 1
        self._check_shutdown(state)
        self._check_jump(tick, state)
        verdict = self._check_silence(tick, state)
        self._check_imu(state)
        self._check_fall(time, state)
        self._check_heat(state)
        self._check_supply(state)
        return verdict

    def _check_shutdown(self, state: State) -> None:
        bad = np.flatnonzero((state.hardware_error != 0) | state.alert)
        if bad.size:
            causes = [f"{JOINTS[i]} ({HardwareError.describe(int(state.hardware_error[i]))})" for i in bad]
            if (state.hardware_error[bad] == HardwareError.INPUT_VOLTAGE).all():
                # By itself this bit does not switch the servo off (register `shutdown`).
                raise Stop(ExitCode.VOLTAGE, f"out of the voltage range: {', '.join(causes)}", damp=True)
            raise Stop(
                ExitCode.SERVO_SHUTDOWN,
                f"shut down by itself: {', '.join(causes)}; mend the cause, then switch the power off and on",
            )
        fresh = np.flatnonzero(state.answered & (state.counts.voltage < ALIVE_COUNTS))
        if fresh.size:
            names = ", ".join(JOINTS[i] for i in fresh)
            raise Stop(ExitCode.SERVO_SHUTDOWN, f"restarted by itself: {names}; check its cable and the battery")

    def _check_jump(self, tick: int, state: State) -> None:
        """A controller that believes a position which cannot be drives the joint with all it has."""
        before, self._last_position = self._last_position, state.position
        if before is None:
            return
        jump = np.where(state.answered, state.position - before, 0.0)
        limit = LEAST_JUMP + FASTEST * self._period * np.maximum(tick - self._last_heard[:-1], 1)
        if (np.abs(jump) > limit).any():
            joint = int((np.abs(jump) / limit).argmax())
            raise Stop(
                ExitCode.POSITION_JUMP,
                f"the position of {JOINTS[joint]} jumped by {jump[joint]:+.3f} rad ({jump[joint] / POSITION_UNIT:+.0f}"
                " counts), faster than the servo can move: it lost a turn or its counter was reset; check its cable"
                " and horn, then switch the power off and on",
            )

    def _check_silence(self, tick: int, state: State) -> Verdict:
        heard = np.append(state.answered, state.imu_answered)
        self._last_heard[heard] = tick
        silent = tick - self._last_heard
        worst = int(silent.max())
        if worst == 0:
            return Verdict()
        names = [*JOINTS, "the IMU"]
        who = ", ".join(names[i] for i in np.flatnonzero(silent == worst)) if (silent == 0).any() else "nothing"
        if who == "nothing":
            note = f"no answer from anything on the bus for {worst} ticks"
        else:
            note = f"no answer from {who} for {worst} ticks"
        if worst >= self._loss_ticks:
            seconds = self._limits.loss_time
            raise Stop(ExitCode.BUS_LOSS, f"{note} ({1e3 * seconds:.0f} ms); check cables and power")
        return Verdict(damp=worst > self._limits.coast_ticks, silent=worst, note=note)

    def _check_imu(self, state: State) -> None:
        if not state.imu_answered:
            return
        block = state.counts.imu.tobytes()
        self._repeats = self._repeats + 1 if block == self._block else 1
        self._block = block
        if self._repeats >= self._limits.imu_repeats:
            reason = f"the IMU sent {self._repeats} identical blocks; it is frozen: switch the power off and on"
            raise Stop(ExitCode.IMU_FROZEN, reason, damp=True)

    def _check_fall(self, time: float, state: State) -> None:
        tilt = np.rad2deg(np.abs(state.orientation[:2]).max())
        if tilt <= self._limits.fall_angle_deg:
            self._upright = time
        elif time - self._upright >= self._limits.fall_time - 1e-9:
            raise Stop(ExitCode.FALL, f"the trunk is tilted by {tilt:.0f} deg: the robot has fallen", damp=True)

    def _check_heat(self, state: State) -> None:
        hot = state.temperature >= self._limits.temperature
        self._hot = self._hot + 1 if hot.any() else 0
        if self._hot >= CONFIRMED:
            joint = int(state.temperature.argmax())
            reason = f"{JOINTS[joint]} has {state.temperature[joint]:.0f} C; let it cool"
            raise Stop(ExitCode.TEMPERATURE, reason, damp=True)

    def _check_supply(self, state: State) -> None:
        lowest = min(float(state.voltage.min()), state.supply_voltage)
        self._low = self._low + 1 if lowest <= self._limits.voltage + 1e-9 else 0
        if self._low >= SAG_READINGS:
            raise Stop(ExitCode.VOLTAGE, f"the supply is down to {lowest:.1f} V; charge the battery", damp=True)
