"""What a whole robot on the stand is asked to do so that its twenty servos show what they hide.

The right leg gets a suite of `leg_suite`, the left leg another one, mirrored; arms and head move beside them. The trunk
is held and nothing is touched: whether limbs would meet is not looked at, so the suite is for simulated robots.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from op3.robot.joints import JOINTS, MIRROR, SOFT_LIMITS, indices
from op3.robot.leg_excitations import LEG_JOINTS, RUN_DURATION, Excitation, leg_suite, leg_walking
from op3.robot.motions import Motion
from op3.robot.poses import pose

UPPER_JOINTS: tuple[str, ...] = tuple(
    joint for joint in JOINTS if "hip" not in joint and "knee" not in joint and "ank" not in joint
)
"""Head and arms."""

OTHER_LEG = 500_000
"""What is added to the seed for the left leg."""

Array = NDArray[np.float64]


def robot_suite(seed: int, duration: float = RUN_DURATION) -> list[Excitation]:
    """The rich suite for all twenty joints: 26 runs of `duration` [s], kinds and conditions as in `leg_suite`.

    Args:
        seed: of amplitudes, frequencies and phases. Equal seeds give equal commands.
        duration: length of one run [s].
    """
    return _both(leg_suite(seed, duration), leg_suite(seed + OTHER_LEG, duration), seed)


def robot_walking(seed: int, duration: float = RUN_DURATION) -> list[Excitation]:
    """The poor suite for all twenty joints: both legs walk in the air, see `leg_walking`."""
    return _both(leg_walking(seed, duration), leg_walking(seed + OTHER_LEG, duration), seed)


def _both(right: list[Excitation], left: list[Excitation], seed: int) -> list[Excitation]:
    """Runs of two legs as runs of the robot; runs that repeated a command still do."""
    return [
        Excitation(_whole(one.motion, other.motion, seed), one.p_gain, one.d_gain, one.tilt, one.warm)
        for one, other in zip(right, left, strict=True)
    ]


def _whole(right: Motion, left: Motion, seed: int) -> Motion:
    time = right.time
    position = np.tile(pose("stand"), (len(time), 1))
    position[:, indices(LEG_JOINTS)] = right.position
    for column, joint in enumerate(LEG_JOINTS):
        partner, sign = MIRROR[joint]
        position[:, JOINTS.index(partner)] = sign * left.position[:, column]
    position[:, indices(UPPER_JOINTS)] += _sway(
        time, np.random.default_rng([seed, 22, zlib.crc32(right.name.encode())])
    )
    low, high = np.array([SOFT_LIMITS[joint] for joint in JOINTS]).T
    return Motion(time, np.clip(position, low + 0.01, high - 0.01), name=right.name)


def _sway(time: Array, rng: np.random.Generator) -> Array:
    """Three sines per joint of arms and head, slow and fast."""
    frequency = np.array([0.15, 0.6, 2.0])[:, None] * rng.uniform(0.8, 1.25, (3, len(UPPER_JOINTS)))
    phase = rng.uniform(0, 2 * np.pi, (3, len(UPPER_JOINTS)))
    waves = np.array([0.2, 0.15, 0.06])[:, None] * np.sin(2 * np.pi * frequency * time[:, None, None] + phase)
    return waves.sum(1)
