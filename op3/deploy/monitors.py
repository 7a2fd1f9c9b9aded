"""Monitors that check every tick and coast, damp the joints or end the run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.limits import Command, Limits
from op3.deploy.registers import HardwareError, Units
from op3.deploy.robot_state import RobotState
from op3.robot import Robot
from op3.robot.self_collision import Gap, SelfCollision

CONFIRMED = 3
"""Consecutive readings that confirm a temperature; a single one may be a glitch."""

ALIVE_COUNTS = 50
"""A servo that answers has at least 5 V; at less, it has restarted and lost its indirect addresses."""

FASTEST = 3.0
"""Largest speed of a joint, even when pushed, as a multiple of its servo's no-load speed."""

LEAST_JUMP = 0.1
"""Smallest difference of consecutive positions that counts as a jump [rad]."""

SAG_READINGS = 10
"""Consecutive readings that confirm a low supply; a load step makes it sag for some milliseconds."""


@dataclass(frozen=True)
class MonitorResult:
    """Whether the joints are damped instead of driven, and a note to the operator, empty if all is well."""

    damp: bool = False
    note: str = ""


class Monitor:
    """Checks the readings of every `period` [s]."""

    def __init__(self, limits: Limits, robot: Robot, period: float):
        self._limits, self._period = limits, period
        self._joints, self._limits_of_joints = robot.joints, robot.limits.T
        self._units, self._parts = Units(robot), SelfCollision(robot, margin=0.0)
        self._loss_ticks = round(limits.loss_time / period)
        self._last_heard: np.ndarray | None = None
        self._last_position: np.ndarray | None = None
        self._upright = 0.0
        self._block: bytes | None = None
        self._repeats = 1
        self._hot = self._low = 0

    def judge(self, tick: int, time: float, state: RobotState) -> MonitorResult:
        """Check the reading of a tick, given its number and the time of its deadline [s].

        Raises:
            Stop: if the run must end; `Stop.damp` states whether the joints are damped first.
        """
        heard = state.answered if state.imu_answered is None else np.append(state.answered, state.imu_answered)
        if self._last_heard is None:
            self._upright, self._last_heard = time, np.full(len(heard), tick - 1)
        self._check_shutdown(state)
        self._check_jump(tick - self._last_heard[: len(self._joints)], state)
        self._last_heard[heard] = tick
        verdict = self._check_silence(tick - self._last_heard)
        if state.orientation is not None and state.imu_answered:
            self._check_imu(state.raw["imu"].tobytes())
        if state.orientation is not None:
            self._check_fall(time, float(np.rad2deg(np.abs(state.orientation[:2]).max())))
        self._check_heat(state)
        self._check_supply(state)
        limits = self._limits
        gap = self._parts.measured(state.position, state.velocity, limits.overlap, limits.overlap_ahead)
        self._check_parts("measured", gap)
        return verdict

    def judge_command(self, state: RobotState, command: Command) -> None:
        """Check a command before it is executed.

        Raises:
            Stop: if it makes parts of the robot collide.
        """
        gap = self._parts.commanded(state.position, command.position, command.p_gain, self._limits.overlap_ahead)
        self._check_parts("commanded", gap)

    def _check_shutdown(self, state: RobotState) -> None:
        errors = state.raw["hardware_error"]
        bad = np.flatnonzero((errors != 0) | state.alert)
        if bad.size:
            causes = ", ".join(f"{self._joints[i]} ({HardwareError.describe(int(errors[i]))})" for i in bad)
            if (errors[bad] == HardwareError.INPUT_VOLTAGE).all():
                # This bit alone does not switch the servo off (register `shutdown`).
                raise Stop(ExitCode.VOLTAGE, f"out of the voltage range: {causes}", damp=True)
            reason = f"shut down: {causes}; remove the cause, then switch the power off and on"
            raise Stop(ExitCode.SERVO_SHUTDOWN, reason)
        fresh = state.answered & (state.raw["voltage"] < ALIVE_COUNTS)
        if fresh.any():
            names = ", ".join(self._joints[i] for i in np.flatnonzero(fresh))
            reason = f"restarted unexpectedly: {names}; check the servo cables and the battery"
            raise Stop(ExitCode.SERVO_SHUTDOWN, reason)

    def _check_jump(self, silent: np.ndarray, state: RobotState) -> None:
        """Detect impossible positions, on which a controller would drive the joint with full current."""
        before, self._last_position = self._last_position, state.position
        if before is None:  # the start checks confirmed that all joints are within their limits
            before = np.clip(state.position, *self._limits_of_joints)
        jump = np.where(state.answered, state.position - before, 0.0)
        limit = LEAST_JUMP + FASTEST * self._units.fastest * self._period * np.maximum(silent, 1)
        if (np.abs(jump) > limit).any():
            joint = int((np.abs(jump) / limit).argmax())
            counts = jump[joint] / self._units.position[joint]
            raise Stop(
                ExitCode.POSITION_JUMP,
                f"the position of {self._joints[joint]} jumped by {jump[joint]:+.3f} rad ({counts:+.0f} counts), faster"
                " than the servo can move: it lost a turn or its counter was reset; check its cable and horn, then"
                " switch the power off and on",
            )

    def _check_silence(self, silent: np.ndarray) -> MonitorResult:
        worst = int(silent.max())
        if worst == 0:
            return MonitorResult()
        names = [*self._joints, "the IMU"]
        who = ", ".join(names[i] for i in np.flatnonzero(silent == worst))
        note = f"no answer from {who if (silent == 0).any() else 'anything on the bus'} for {worst} ticks"
        if worst >= self._loss_ticks:
            raise Stop(ExitCode.BUS_LOSS, f"{note} ({1e3 * self._limits.loss_time:.0f} ms); check cables and power")
        return MonitorResult(damp=worst > self._limits.coast_ticks, note=note)

    def _check_imu(self, block: bytes) -> None:
        self._repeats = self._repeats + 1 if block == self._block else 1
        self._block = block
        if self._repeats >= self._limits.imu_repeats:
            reason = (
                f"the IMU sent {self._repeats} identical blocks; it has stopped updating: switch the power off and on"
            )
            raise Stop(ExitCode.IMU_FROZEN, reason, damp=True)

    def _check_fall(self, time: float, tilt: float) -> None:
        if tilt <= self._limits.fall_angle_deg:
            self._upright = time
        elif time - self._upright >= self._limits.fall_time - 1e-9:
            raise Stop(ExitCode.FALL, f"the trunk is tilted by {tilt:.0f} deg: the robot has fallen", damp=True)

    def _check_parts(self, whose: str, gap: Gap | None) -> None:
        if gap is not None:
            raise Stop(ExitCode.SELF_COLLISION, f"parts of the robot collide at the {whose} angles: {gap}", damp=True)

    def _check_heat(self, state: RobotState) -> None:
        hot = state.temperature >= self._limits.temperature
        self._hot = self._hot + 1 if hot.any() else 0
        if self._hot >= CONFIRMED:
            joint = int(state.temperature.argmax())
            reason = f"{self._joints[joint]} is at {state.temperature[joint]:.0f} C; let it cool"
            raise Stop(ExitCode.TEMPERATURE, reason, damp=True)

    def _check_supply(self, state: RobotState) -> None:
        lowest = min(float(state.voltage.min()), state.supply_voltage)
        self._low = self._low + 1 if lowest <= self._limits.voltage + 1e-9 else 0
        if self._low >= SAG_READINGS:
            raise Stop(ExitCode.VOLTAGE, f"the supply is down to {lowest:.1f} V; charge the battery", damp=True)
