"""What the robot is asked to do in turn: ramp up, wait, follow a motion or a policy, sit down."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.deploy.limits import HIGH, LOW, Command
from op3.deploy.state import State
from op3.deploy.ticker import PERIOD
from op3.policy.actions import D_GAIN, HELD_GAIN
from op3.robot import JOINTS, Motion
from op3.stand_in.play import sample

Array = NDArray[np.float64]

GAIN_RAMP_TIME = 1.0
"""How long the P gains take from nothing to full, about the pose that was measured [s]."""

LEAST_MOVE_TIME = 2.0
"""Shortest time of a move to another pose [s]."""

MOVE_SPEED = 1.0
"""Fastest speed of a joint on such a move [rad/s]; longer moves take longer."""


class Phase(Protocol):
    """Gives commands tick by tick.

    Attributes:
        name: shown to the operator.
        log: name of the log that its ticks belong to.
    """

    name: str
    log: str

    def command(self, elapsed: int, state: State) -> Command | None:
        """The command of a tick, or None when the phase is over.

        Args:
            elapsed: deadlines since the phase began, skipped ones included.
            state: the reading of this tick.
        """
        ...

    def channels(self) -> dict[Any, Array]:
        """Further channels of the log for the tick just commanded."""
        ...


class _Plain:
    """A phase without channels of its own."""

    name = ""
    log = "approach"

    def channels(self) -> dict[Any, Array]:
        """None."""
        return {}


def minimum_jerk(share: float) -> float:
    """Share of a move that is done at a share of its time, 0 to 1 each: no speed and no acceleration at its ends."""
    s = min(max(share, 0.0), 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


class GainRamp(_Plain):
    """Hold the pose in which the robot is found, from no stiffness to full."""

    name = "ramp"

    def __init__(self, p_gain: ArrayLike = HELD_GAIN, d_gain: ArrayLike = D_GAIN, duration: float = GAIN_RAMP_TIME):
        self._p_gain, self._d_gain = np.asarray(p_gain, dtype=float), d_gain
        self._ticks = max(1, round(duration / PERIOD))
        self._pose: Array | None = None

    def command(self, elapsed: int, state: State) -> Command | None:
        """The measured pose with rising gain."""
        if self._pose is None:
            self._pose = state.position.clip(LOW, HIGH)
        if elapsed >= self._ticks:
            return None
        return Command.of(self._pose, self._p_gain * elapsed / self._ticks, self._d_gain)


class Move(_Plain):
    """A minimum-jerk move from where the targets are to a pose.

    It starts from the measured pose, or from the target before it where the joints hang below theirs: `start` says
    so, and the targets never jump.
    """

    name = "move"

    def __init__(
        self,
        pose: ArrayLike,
        p_gain: ArrayLike = HELD_GAIN,
        d_gain: ArrayLike = D_GAIN,
        *,
        least_time: float = LEAST_MOVE_TIME,
        start: Callable[[], Array | None] | None = None,
        log: str = "approach",
    ):
        self._goal = np.asarray(pose, dtype=float).clip(LOW, HIGH)
        self._p_gain, self._d_gain, self._least_time = p_gain, d_gain, least_time
        self._given_start = start
        self.log = log
        self._start: Array | None = None
        self._ticks = 0

    def command(self, elapsed: int, state: State) -> Command | None:
        """The pose of this instant."""
        if self._start is None:
            given = None if self._given_start is None else self._given_start()
            self._start = state.position.clip(LOW, HIGH) if given is None else given
            # The fastest instant of a minimum-jerk move has 1.875 times its mean speed.
            needed = 1.875 * float(np.abs(self._goal - self._start).max()) / MOVE_SPEED
            self._ticks = round(max(self._least_time, needed) / PERIOD)
        if elapsed >= self._ticks:
            return None
        share = minimum_jerk(elapsed / self._ticks)
        return Command.of(self._start + share * (self._goal - self._start), self._p_gain, self._d_gain)


class Relax(_Plain):
    """Hold a pose while the stiffness goes, so that the robot sinks instead of dropping."""

    name = "relax"
    log = "after"

    def __init__(self, pose: ArrayLike, p_gain: ArrayLike = HELD_GAIN, duration: float = GAIN_RAMP_TIME):
        self._pose, self._p_gain = pose, np.asarray(p_gain, dtype=float)
        self._ticks = max(1, round(duration / PERIOD))

    def command(self, elapsed: int, state: State) -> Command | None:
        """The pose with falling gain."""
        if elapsed >= self._ticks:
            return None
        return Command.of(self._pose, self._p_gain * (1 - elapsed / self._ticks), 2 * D_GAIN)


class Hold(_Plain):
    """Hold a pose until someone says so, or for a time.

    Args:
        pose: [joint] in rad.
        until: asked in every tick; True ends the phase. Raising `Stop` ends the run.
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
        self._until, self._duration = until, duration
        self.log = log

    def command(self, elapsed: int, state: State) -> Command | None:
        """The pose."""
        over = elapsed * PERIOD >= self._duration - 1e-9 or (self._until is not None and self._until())
        return None if over else self._command


class FollowMotion(_Plain):
    """Follow a motion, as excitation for identification.

    Args:
        motion: targets; joints that it does not name stay in the pose "stand".
        p_gain: one number, [joint], or [row, joint] with one row per tick of 8 ms [A/rad].
        d_gain: the same [A s/rad].
    """

    name = "motion"
    log = "run"

    def __init__(self, motion: Motion, p_gain: ArrayLike = HELD_GAIN, d_gain: ArrayLike = D_GAIN):
        self.targets = sample(motion, PERIOD)
        self.p_gain, self.d_gain = (self._gain(n, v) for n, v in (("p_gain", p_gain), ("d_gain", d_gain)))
        outside = (self.targets < LOW) | (self.targets > HIGH)
        if outside.any():
            row, joint = np.argwhere(outside)[0]
            raise ValueError(
                f"motion {motion.name!r} asks {JOINTS[joint]} for {self.targets[row, joint]:.3f} rad at"
                f" {row * PERIOD:.3f} s; it may go from {LOW[joint]:.3f} to {HIGH[joint]:.3f} rad"
            )

    def _gain(self, name: str, value: ArrayLike) -> Array:
        try:
            gain = np.broadcast_to(np.asarray(value, dtype=float), self.targets.shape)
        except ValueError:
            rows, count = self.targets.shape
            wanted = f"one number, one per joint ({count}) or one per row and joint ({rows}, {count})"
            raise ValueError(f"{name} must be {wanted}, got shape {np.shape(value)}") from None
        if not (np.isfinite(gain).all() and (gain >= 0).all()):
            raise ValueError(f"{name} must be finite and at least 0")
        return gain

    def command(self, elapsed: int, state: State) -> Command | None:
        """The row of this tick."""
        if elapsed >= len(self.targets):
            return None
        return Command.of(self.targets[elapsed], self.p_gain[elapsed], self.d_gain[elapsed])
