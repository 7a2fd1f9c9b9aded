"""Suites of motions of one leg, or the whole OP3, on the stand, for a diagnosis of its servos.

The suite takes about 100 s: slow triangles, multisines at high and low gain, squats, steps that exhaust the supply
voltage, holds at two loads, two orientations of the stand, cold and warm servos, and commands that are repeated.
`leg_walking` is a poor excitation, a leg that only walks, with which many effects cannot be distinguished. The suites
of the whole robot use another, mirrored suite for the left leg and also move arms and head. Collisions of limbs are not
checked, so these suites are only for simulated robots.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from op3.motions.excitations import RATE
from op3.motions.motion import Motion
from op3.motions.op3_motions import op3_robot, squat_position

JOINTS_PER_LEG, KNEE = 6, 3
"""Number of joints of a leg, and the index of the knee among them."""

RUN_DURATION = 4.0
"""Length of one run [s]."""

UPRIGHT = (0.0, 0.0)
"""Roll and pitch of the stand [rad]."""

TILTED = (0.5, 0.8)
"""The other orientation of the stand [rad]: it changes the torques of gravity, but not those of springs."""

SLOW_RATES = (0.02, 0.05, 0.1, 0.2, 0.3, 0.15)
"""Speeds of the slow triangles [rad/s]; each joint meets several of them."""

OTHER_LEG = 500_000
"""Offset of the left leg's seed."""

Array = NDArray[np.float64]


def leg_joints() -> tuple[str, ...]:
    """The servo joints of the right leg, from the trunk outwards: hip yaw, roll and pitch, knee, ankle pitch, roll."""
    return op3_robot().legs[1]


def arm_joints() -> tuple[str, ...]:
    """The joints of both arms."""
    return *op3_robot().limbs[1], *op3_robot().limbs[2]


@dataclass(frozen=True, eq=False)
class Excitation:
    """One run of a suite.

    Attributes:
        motion: targets; runs with the same commands have the same name.
        p_gain: proportional gain of all joints [A/rad].
        d_gain: derivative gain of all joints [A s/rad].
        tilt: roll and pitch of the stand [rad].
        warm: whether the servos are warm from earlier work.
    """

    motion: Motion
    p_gain: float = 6.0
    d_gain: float = 0.1
    tilt: tuple[float, float] = UPRIGHT
    warm: bool = False


def leg_suite(seed: int, duration: float = RUN_DURATION) -> list[Excitation]:
    """The rich suite: 26 runs of `duration` [s], in the order in which they are recorded.

    Args:
        seed: seed of amplitudes, frequencies and phases. Equal seeds give equal commands.
        duration: length of one run [s].
    """
    rng = np.random.default_rng([seed, 20])
    time = np.arange(round(duration * RATE)) / RATE

    def run(name: str, shape: Callable[..., Array], *args: float, gain: float = 6.0, tilt=UPRIGHT, warm=False):
        return Excitation(_motion(time, shape(time, rng, *args), name), gain, 0.1, tilt, warm)

    first = run("repeated_multisine", _multisine, 0.9, gain=4.0)
    second = run("repeated_squat", _squat, 1.0, tilt=TILTED)
    return [
        first,
        run("slow_triangles_1", _triangles, 0),
        run("multisine_high_gain_1", _multisine, 1.0),
        second,
        run("multisine_low_gain_1", _multisine, 1.0, gain=1.2),
        run("squats_1", _squat, 1.0),
        first,
        run("steps_1", _steps, 0.6),
        run("slow_triangles_2", _triangles, 2, tilt=TILTED),
        second,
        run("holds_1", _holds),
        run("multisine_high_gain_2", _multisine, 1.1, tilt=TILTED),
        first,
        run("slow_triangles_3", _triangles, 4),
        run("multisine_low_gain_2", _multisine, 1.0, gain=1.2, tilt=TILTED),
        second,
        run("holds_2", _holds, tilt=TILTED),
        run("steps_2", _steps, 0.7, tilt=TILTED),
        run("squats_2", _squat, 0.8, tilt=TILTED),
        first,
        second,
        run("slow_triangles_4", _triangles, 1, tilt=TILTED, warm=True),
        run("multisine_high_gain_3", _multisine, 1.0, warm=True),
        run("steps_3", _steps, 0.65, tilt=TILTED, warm=True),
        run("squats_3", _squat, 1.0, warm=True),
        run("multisine_high_gain_4", _multisine, 1.0, tilt=TILTED, warm=True),
    ]


def leg_walking(seed: int, duration: float = RUN_DURATION, runs: int = 26) -> list[Excitation]:
    """The poor suite: the leg walks in the air, upright, at one gain, cold. Every sixth run repeats the first.

    Args:
        seed: seed of cadence and stride.
        duration: length of one run [s].
        runs: number of runs.
    """
    rng = np.random.default_rng([seed, 21])
    time = np.arange(round(duration * RATE)) / RATE
    first = Excitation(_motion(time, _walk(time, rng), "repeated_walk"))
    return [
        first if i % 6 == 0 else Excitation(_motion(time, _walk(time, rng), f"walk_{i - i // 6}")) for i in range(runs)
    ]


def robot_suite(seed: int, duration: float = RUN_DURATION) -> list[Excitation]:
    """The rich suite for all joints: kinds and conditions as in `leg_suite`."""
    return _both(leg_suite(seed, duration), leg_suite(seed + OTHER_LEG, duration), seed)


def robot_walking(seed: int, duration: float = RUN_DURATION) -> list[Excitation]:
    """The poor suite for all joints: both legs walk in the air, see `leg_walking`."""
    return _both(leg_walking(seed, duration), leg_walking(seed + OTHER_LEG, duration), seed)


def _both(right: list[Excitation], left: list[Excitation], seed: int) -> list[Excitation]:
    """Combines runs of two legs to runs of the robot; repeated commands are kept."""
    return [
        Excitation(_whole(one.motion, other.motion, seed), one.p_gain, one.d_gain, one.tilt, one.warm)
        for one, other in zip(right, left, strict=True)
    ]


def _whole(right: Motion, left: Motion, seed: int) -> Motion:
    time, robot = right.time, op3_robot()
    position = np.tile(robot.home, (len(time), 1))
    position[:, robot.indices(robot.legs[1])] = left.position
    position = robot.mirrored(position)
    position[:, robot.indices(robot.legs[1])] = right.position
    upper = [joint for joint in robot.joints if not any(joint in leg for leg in robot.legs)]
    rng = np.random.default_rng([seed, 22, zlib.crc32(right.name.encode())])
    position[:, robot.indices(upper)] += _sway(time, rng, len(upper))
    low, high = robot.limits.T
    return Motion(time, np.clip(position, low + 0.01, high - 0.01), name=right.name, robot=robot.reference)


def _sway(time: Array, rng: np.random.Generator, count: int) -> Array:
    """Three sines per joint of arms and head, slow and fast."""
    frequency = np.array([0.15, 0.6, 2.0])[:, None] * rng.uniform(0.8, 1.25, (3, count))
    phase = rng.uniform(0, 2 * np.pi, (3, count))
    waves = np.array([0.2, 0.15, 0.06])[:, None] * np.sin(2 * np.pi * frequency * time[:, None, None] + phase)
    return waves.sum(1)


def _motion(time: Array, position: Array, name: str) -> Motion:
    low, high = op3_robot().limits[op3_robot().indices(leg_joints())].T
    return Motion(time, np.clip(position, low + 0.01, high - 0.01), leg_joints(), name, robot=op3_robot().reference)


def _centre() -> Array:
    """The leg angles of the home pose [joint]."""
    return op3_robot().home[op3_robot().indices(leg_joints())]


def _triangles(time: Array, rng: np.random.Generator, shift: float) -> Array:
    """Each joint goes back and forth at one slow speed; `shift` moves the speeds along the leg."""
    rates = np.roll(SLOW_RATES, int(shift))
    period = rng.uniform(1.6, 2.6, JOINTS_PER_LEG)
    phase = time[:, None] / period + rng.uniform(0, 1, JOINTS_PER_LEG)
    wave = 2 * np.abs(2 * (phase % 1) - 1) - 1
    return _centre() + rng.uniform(-0.25, 0.25, JOINTS_PER_LEG) + rates * period / 4 * wave


def _multisine(time: Array, rng: np.random.Generator, scale: float) -> Array:
    """Eight sines per joint between 0.25 and 6 Hz, whose amplitude decreases with frequency."""
    frequency = np.geomspace(0.25, 6.0, 8)[:, None] * rng.uniform(0.85, 1.15, (8, JOINTS_PER_LEG))
    amplitude = 0.22 / (1 + frequency / 0.8)
    phase = rng.uniform(0, 2 * np.pi, (8, JOINTS_PER_LEG))
    waves = amplitude * np.sin(2 * np.pi * frequency * time[:, None, None] + phase)
    return _centre() + scale * waves.sum(1)


def _squat(time: Array, rng: np.random.Generator, scale: float) -> Array:
    """Knee bends with hip and ankle, and slow sways of the other joints."""
    frequency = rng.uniform(0.45, 0.8)
    knee = 1.05 - 0.45 * scale * np.cos(2 * np.pi * frequency * time)
    position = squat_position(knee, 0.3)[:, op3_robot().indices(leg_joints())]
    sway = rng.uniform(0.05, 0.2, 3) * np.sin(2 * np.pi * rng.uniform(0.3, 0.7, 3) * time[:, None] + [0.0, 1.0, 2.0])
    position[:, [0, 1, 5]] += sway
    return position


def _steps(time: Array, rng: np.random.Generator, size: float) -> Array:
    """Jumps that require more current than the supply can deliver, at different times in each joint."""
    position = np.tile(_centre(), (len(time), 1))
    for joint in range(JOINTS_PER_LEG):
        edges = np.cumsum(rng.uniform(0.35, 0.75, 12))
        level = np.concatenate([[0.0], size * rng.uniform(0.5, 1.0, 12) * np.tile([1, -1], 6)])
        position[:, joint] += level[np.searchsorted(edges, time)] * rng.choice([-1, 1])
    return position


def _holds(time: Array, rng: np.random.Generator) -> Array:
    """Two poses with different gravity loads, held while the targets move slowly up and down."""
    low = _centre() + rng.uniform(-0.15, 0.15, JOINTS_PER_LEG)
    high = low + np.array([0.3, 0.45, 0.55, -0.5, -0.4, 0.5]) * rng.uniform(0.8, 1.2, JOINTS_PER_LEG)
    share = np.clip((time - time[-1] / 2) / 0.3, -0.5, 0.5)[:, None] + 0.5
    creep = 0.02 * np.abs(2 * ((time[:, None] / 1.7 + rng.uniform(0, 1, JOINTS_PER_LEG)) % 1) - 1)
    return low + share * (high - low) + creep


def _walk(time: Array, rng: np.random.Generator) -> Array:
    """Swing and stance of a short step."""
    phase = 2 * np.pi * (rng.uniform(1.1, 1.5) * time + rng.uniform())[:, None]
    stride = rng.uniform(0.15, 0.25)
    amplitude = np.array([0.03, 0.06, stride, 1.4 * stride, stride, 0.06])
    lag = np.array([0.0, 0.0, 0.0, 1.2, 2.4, 0.0])
    return _centre() + amplitude * np.sin(phase + lag)
