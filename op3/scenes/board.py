"""The board under the robot: its motion as a function of time, the weight that tilts it, and their drives.

A motion is a pure function of a seed and of time, so that every simulator of the scene drives the same board.
Arrays may carry leading axes, one row per simulation.
"""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol, TypeVar

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.robot.kinematics import minimum_jerk
from op3.robot.register_units import GRAVITY

Array = NDArray[np.float64]

AXIS_HEIGHT = 0.12
"""Height of the board's axes above the floor [m]."""

TOP_HEIGHT = 0.01
"""Height of the board's top above its axes [m]."""

WAVE_AMPLITUDE = np.deg2rad(10.0)
"""Largest angle of the random waves [rad]; paper, 10 degrees."""

TILT = np.deg2rad(6.0)
"""Tilt of the board in evaluation, and its stops under the weight [rad]; paper, 6 degrees."""

WAVE_FREQUENCIES = (0.1, 0.8)
"""Range of the frequencies of the random waves [Hz]; op3's choice, because the paper gives none.

Training must cover the fastest motion of a board: with waves of up to 0.6 Hz two of three policies fell when a
weight tipped the board.
"""

WAVE_PARTS = 3
"""Number of sinusoids per axis; op3's choice."""

RAMP = 1.0
"""Time in which the waves grow from a level board to their full size [s]; op3's choice."""

WEIGHT_MASS = 1.0
"""[kg]"""

WEIGHT_DISTANCE = 0.23
"""Distance of the weight from the board's axis, backwards [m]."""


class BoardMotion(Protocol):
    """Roll and pitch of a board over time."""

    def at(self, time: ArrayLike) -> tuple[Array, Array]:
        """Angle [rad] and rate [rad/s], each ``[..., 2]`` (roll, pitch), at times [s]."""
        ...


def _smooth_step(x: Array) -> tuple[Array, Array]:
    """Minimum-jerk step from 0 to 1 over x in [0, 1], with its derivative."""
    x = np.clip(x, 0.0, 1.0)
    return minimum_jerk(x), 30 * x**2 * (1 - x) ** 2


@dataclass(frozen=True, eq=False)
class Waves:
    """Sums of sinusoids that grow from a level board.

    Attributes:
        amplitude: amplitudes, ``[..., axis, part]`` in rad; the axes are roll and pitch.
        frequency: frequencies of the same shape, in Hz.
        phase: phases of the same shape, in rad.
    """

    amplitude: Array
    frequency: Array
    phase: Array

    @classmethod
    def draw(cls, seed: int, amplitude: float = WAVE_AMPLITUDE) -> Waves:
        """Waves of a seed: each axis gets a size up to an amplitude [rad], which is divided among its parts."""
        rng = np.random.default_rng([seed, 11])
        shares = rng.dirichlet(np.ones(WAVE_PARTS), 2)
        size = rng.uniform(0.0, amplitude, (2, 1))
        shape = (2, WAVE_PARTS)
        return cls(size * shares, rng.uniform(*WAVE_FREQUENCIES, shape), rng.uniform(0.0, 2 * np.pi, shape))

    @classmethod
    def still(cls) -> Waves:
        """A board that stays level."""
        zeros = np.zeros((2, 1))
        return cls(zeros, zeros, zeros)

    def at(self, time: ArrayLike) -> tuple[Array, Array]:
        """See `BoardMotion`."""
        time = np.asarray(time, dtype=float)[..., None]
        speed = 2 * np.pi * self.frequency
        angle = speed * time[..., None] + self.phase
        wave, rate = (self.amplitude * np.sin(angle)).sum(-1), (speed * self.amplitude * np.cos(angle)).sum(-1)
        grown, growth = _smooth_step(time / RAMP)
        return grown * wave, grown * rate + growth / RAMP * wave


@dataclass(frozen=True, eq=False)
class Tilts:
    """Pitch steps between +`TILT` and -`TILT`: level for a second, then alternating sides.

    Attributes:
        side: +1 or -1, the side of the first tilt, ``[...]``.
        transition: duration of a change of side [s], ``[...]``.
        period: time from one change to the next [s], ``[...]``.
    """

    side: Array
    transition: Array
    period: Array

    @classmethod
    def draw(cls, seed: int) -> Tilts:
        """Tilts of a seed; changes take 0.6 to 1.0 s and occur every 2 to 3 s (op3's choice)."""
        rng = np.random.default_rng([seed, 12])
        side = rng.choice([-1.0, 1.0])
        return cls(np.array(side), np.array(rng.uniform(0.6, 1.0)), np.array(rng.uniform(2.0, 3.0)))

    def at(self, time: ArrayLike) -> tuple[Array, Array]:
        """See `BoardMotion`."""
        since = np.asarray(time, dtype=float) - 1.0
        change = np.maximum(np.floor(since / self.period), 0.0)
        # the first change starts level, later ones from the other side
        height = np.where(change == 0, 1.0, 2.0) * TILT * self.side * np.where(change % 2 == 0, 1.0, -1.0)
        start = np.where(change == 0, 0.0, TILT * self.side * np.where(change % 2 == 1, 1.0, -1.0))
        grown, growth = _smooth_step((since - change * self.period) / self.transition)
        pitch, rate = start + height * grown, height * growth / self.transition
        return np.stack([0.0 * pitch, pitch], -1), np.stack([0.0 * rate, rate], -1)


M = TypeVar("M")


def stack(motions: Sequence[M]) -> M:
    """Many motions or schedules of one kind, combined with a leading axis."""
    kind: Any = type(motions[0])
    return kind(*(np.stack([getattr(motion, field.name) for motion in motions]) for field in fields(kind)))


class BoardDrive:
    """Moves the board of the scene "board", once per control tick.

    The board's state is written, and its acceleration until the next tick is applied as a force on its large inertia:
    between ticks it follows the motion to some microradians, whatever stands on it, and contacts see its velocity.

    Args:
        period: time between ticks [s].
    """

    def __init__(self, model: mujoco.MjModel, period: float):
        joints = [model.joint(f"board/{axis}") for axis in ("roll", "pitch")]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._dof = np.array([joint.dofadr[0] for joint in joints])
        self._inertia = float(model.body("board/board").inertia[0])
        self._period = period

    def apply(self, motion: BoardMotion, time: ArrayLike, qpos: Array, qvel: Array, qfrc_applied: Array) -> None:
        """Write the board's state at the times, and the force until the next tick, into arrays ``[..., nq | nv]``."""
        time = np.asarray(time, dtype=float)
        angle, rate = motion.at(time)
        _, later = motion.at(time + self._period)
        qpos[..., self._qpos] = angle
        qvel[..., self._dof] = rate
        qfrc_applied[..., self._dof] = self._inertia * (later - rate) / self._period


LOWERING_SPEED = 0.1
"""Speed at which a hand lowers the weight [m/s]; op3's choice."""

HAND_STIFFNESS = 200.0
"""Stiffness with which the hand holds the weight at its intended height [N/m]; it lets go within 0.5 s of touching the
board."""

_HAND_DAMPING = 2 * np.sqrt(HAND_STIFFNESS * WEIGHT_MASS)


@dataclass(frozen=True, eq=False)
class WeightSchedule:
    """The time at which the weight is lowered.

    Attributes:
        start: time at which the hand begins to lower the weight [s], ``[...]``.
    """

    start: Array

    @classmethod
    def draw(cls, seed: int) -> WeightSchedule:
        """A start between 4 and 5 s (op3's choice)."""
        return cls(np.array(np.random.default_rng([seed, 13]).uniform(4.0, 5.0)))


class WeightDrive:
    """The hand that lowers the weight of the scene "board_weight", once per control tick.

    The hand holds the weight like a spring and damper and cannot push it down, so the board loads gradually.
    """

    def __init__(self, model: mujoco.MjModel):
        joint = model.joint("board/weight")
        self._qpos, self._dof = int(joint.qposadr[0]), int(joint.dofadr[0])

    def apply(self, schedule: WeightSchedule, time: ArrayLike, qpos: Array, qvel: Array, qfrc_applied: Array) -> None:
        """Write the hand's force at the times into ``qfrc_applied`` [..., nv]."""
        lowered = LOWERING_SPEED * np.maximum(np.asarray(time, dtype=float) - schedule.start, 0.0)
        speed = np.where(lowered > 0, LOWERING_SPEED, 0.0)
        force = WEIGHT_MASS * GRAVITY + HAND_STIFFNESS * (-lowered - qpos[..., self._qpos])
        force = force + _HAND_DAMPING * (-speed - qvel[..., self._dof])
        qfrc_applied[..., self._dof] = np.maximum(force, 0.0)


def board_drive(
    model: mujoco.MjModel, board: BoardMotion | WeightSchedule, period: float = 0.008
) -> BoardDrive | WeightDrive:
    """The drive of a scene's board for a motion.

    Args:
        board: motion of the scene "board", or schedule of the scene "board_weight".
        period: time between ticks [s].

    Raises:
        ValueError: if the scene has no such board.
    """
    wanted = "board/weight" if isinstance(board, WeightSchedule) else "board/roll"
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, wanted) < 0:
        scene = "board_weight" if wanted == "board/weight" else "board"
        raise ValueError(f"{type(board).__name__} moves the scene {scene!r}, but this scene has no joint {wanted!r}")
    return WeightDrive(model) if isinstance(board, WeightSchedule) else BoardDrive(model, period)
