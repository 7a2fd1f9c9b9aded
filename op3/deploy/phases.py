"""Phases of a run: ramp up, wait, follow a motion, watch, sit down."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.deploy.limits import Command
from op3.deploy.robot_state import RobotState
from op3.deploy.ticker import PERIOD
from op3.motions import Motion
from op3.motions.motion import gain_rows, sample
from op3.motions.motion_checks import check_motion
from op3.policy.actions import D_GAIN, HELD_GAIN
from op3.robot import load_robot
from op3.robot.kinematics import minimum_jerk

Array = NDArray[np.float64]

GAIN_RAMP_TIME = 1.0
"""Time in which P gains rise from zero at the measured pose [s]."""

BLEND_TIME = 0.25
"""Time over which gains change to the gains of a move, for example after a compliant policy [s]."""

LEAST_MOVE_TIME = 2.0
"""Shortest time of a move to another pose [s]."""

MOVE_SPEED = 1.0
"""Largest speed of a joint during such a move [rad/s], which determines the duration of long moves."""


class Phase:
    """Gives one command per tick. Targets outside the soft limits are clipped at execution."""

    name = ""
    log = "approach"

    def command(self, elapsed: int, state: RobotState) -> Command | None:
        """The command of a tick, or None when the phase is over.

        Args:
            elapsed: number of deadlines since the phase began, including skipped deadlines.
        """
        raise NotImplementedError

    def channels(self) -> dict[Any, Array]:
        """Further log channels for the last commanded tick."""
        return {}


class GainRamp(Phase):
    """Hold the measured pose, with a P gain that rises from zero over `GAIN_RAMP_TIME`."""

    name = "ramp"

    def __init__(self, p_gain: ArrayLike = HELD_GAIN, d_gain: ArrayLike = D_GAIN):
        self._p_gain, self._d_gain = np.asarray(p_gain, dtype=float), d_gain
        self._pose: Array | None = None

    def command(self, elapsed: int, state: RobotState) -> Command | None:
        """See `Phase`."""
        self._pose = state.position if self._pose is None else self._pose
        share = elapsed * PERIOD / GAIN_RAMP_TIME
        return Command.of(self._pose, share * self._p_gain, self._d_gain) if share < 1 else None


class Relax(Phase):
    """Hold a pose while the gains fall to zero over `GAIN_RAMP_TIME`, so that the robot sinks instead of dropping."""

    name = "relax"
    log = "after"

    def __init__(self, pose: ArrayLike):
        self._pose = pose

    def command(self, elapsed: int, state: RobotState) -> Command | None:
        """See `Phase`."""
        share = 1 - elapsed * PERIOD / GAIN_RAMP_TIME
        return Command.of(self._pose, share * HELD_GAIN, 2 * D_GAIN) if share > 0 else None


class Move(Phase):
    """A minimum-jerk move from the current targets to a pose, so that neither targets nor gains jump.

    Args:
        pose: target pose [joint] in rad.
        p_gain: P gain [A/rad].
        d_gain: D gain [A s/rad].
        start: function that returns the previous command; gains change from its gains over `BLEND_TIME`. Without a
            previous command the move starts from the measured pose.
    """

    name = "move"

    def __init__(
        self,
        pose: ArrayLike,
        p_gain: ArrayLike = HELD_GAIN,
        d_gain: ArrayLike = D_GAIN,
        *,
        start: Callable[[], Command | None] | None = None,
        log: str = "approach",
    ):
        self._goal = np.asarray(pose, dtype=float)
        self._own, self._given_start, self.log = Command.of(self._goal, p_gain, d_gain), start, log
        self._start: Command | None = None
        self._ticks = 0

    def command(self, elapsed: int, state: RobotState) -> Command | None:
        """See `Phase`."""
        if self._start is None:
            given = None if self._given_start is None else self._given_start()
            self._start = replace(self._own, position=state.position) if given is None else given
            # The peak speed of a minimum-jerk move is 1.875 times its mean speed.
            needed = 1.875 * float(np.abs(self._goal - self._start.position).max()) / MOVE_SPEED
            self._ticks = round(max(LEAST_MOVE_TIME, needed) / PERIOD)
        if elapsed >= self._ticks:
            return None
        before, after, share = self._start, self._own, min(1.0, elapsed * PERIOD / BLEND_TIME)
        return Command(
            before.position + minimum_jerk(elapsed / self._ticks) * (self._goal - before.position),
            before.p_gain + share * (after.p_gain - before.p_gain),
            before.d_gain + share * (after.d_gain - before.d_gain),
        )


class HoldPose(Phase):
    """Hold a pose until a condition is met, or for a time.

    Args:
        pose: target pose [joint] in rad.
        p_gain: P gain [A/rad].
        d_gain: D gain [A s/rad].
        until: condition, evaluated in every tick; True ends the phase. Raising `Stop` ends the run.
        duration: longest time [s].
    """

    name = "hold"

    def __init__(
        self,
        pose: ArrayLike,
        p_gain: ArrayLike = HELD_GAIN,
        d_gain: ArrayLike = D_GAIN,
        *,
        until: Callable[[], bool] | None = None,
        duration: float = np.inf,
        log: str = "approach",
    ):
        self._command = Command.of(pose, p_gain, d_gain)
        self._until, self._duration, self.log = until, duration, log

    def command(self, elapsed: int, state: RobotState) -> Command | None:
        """See `Phase`."""
        over = elapsed * PERIOD >= self._duration - 1e-9 or (self._until is not None and self._until())
        return None if over else self._command


class Watch(Phase):
    """Command the measured pose with zero gains, for a time [s]."""

    name = "watch"
    log = "run"

    def __init__(self, duration: float):
        self._ticks = round(duration / PERIOD)

    def command(self, elapsed: int, state: RobotState) -> Command | None:
        """See `Phase`."""
        return Command.of(state.position, 0.0, 0.0) if elapsed < self._ticks else None


class FollowMotion(Phase):
    """Follow a motion, as excitation for identification.

    Args:
        motion: targets of joints; other joints stay at home.
        p_gain: one number, [joint], or [row, joint] with one row per tick of 8 ms [A/rad].
        d_gain: one number or array, as for `p_gain` [A s/rad].

    Raises:
        ValueError: if the motion is not safe, see `check_motion`, or gains have another shape.
    """

    name = "motion"
    log = "run"

    def __init__(self, motion: Motion, p_gain: ArrayLike = HELD_GAIN, d_gain: ArrayLike = D_GAIN):
        check_motion(motion)
        robot = load_robot(motion.robot)
        self.targets = sample(motion, PERIOD, robot.joints, robot.home)
        self.p_gain = gain_rows("p_gain", p_gain, self.targets.shape)
        self.d_gain = gain_rows("d_gain", d_gain, self.targets.shape)

    def command(self, elapsed: int, state: RobotState) -> Command | None:
        """See `Phase`."""
        if elapsed >= len(self.targets):
            return None
        return Command.of(self.targets[elapsed], self.p_gain[elapsed], self.d_gain[elapsed])
