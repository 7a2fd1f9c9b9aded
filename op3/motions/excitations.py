"""Excitations: motions of any robot that make parameters of servos and body identifiable from a log.

Every motion starts and ends at rest in its central pose, respects a speed limit, and is sampled at the rate of the
robot's PD loop. All motions accept these arguments:

- `joints`: amplitude of each joint [rad], whose sign is the direction; None: every controlled joint as far as limits,
speeds and clearances of the robot allow, - `duration`: length [s]; reached by whole repeats for motions of fixed
length, - `around` and `offset`: the central pose, by default "home", and offsets from it by joint [rad], -
`robot` and `name`: a name in `assets/robots` or the path of a robot file, and the name of the motion.

`op3.motions.motion_checks` checks limits, speeds and collisions of the result.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from inspect import signature
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from op3.motions.motion import Motion, sample_times
from op3.motions.motion_checks import motion_faults
from op3.robot.kinematics import minimum_jerk
from op3.robot.robot import Robot, load_robot

RATE = 125.0
"""Rows per second, the rate of the robot's PD loop."""

FADE = 0.5
"""Duration of the fade-in and fade-out of oscillations [s]."""

Array = NDArray[np.float64]
Amplitudes = Mapping[str, float]
"""Amplitude of each joint that moves [rad]; the sign is its direction."""

SHARES = (0.4, 0.2, 0.1, 0.05, 0.02, 0.01)
"""Default amplitudes, as shares of the distance from home to the nearer limit; the first safe one is used."""

LARGEST = 0.5
"""Largest default amplitude [rad]."""

BRISK = 0.95
"""With default amplitudes, joints move at most at this share of their speed limit."""


def _of_any_robot(excursions: Callable[..., tuple[Array, Array]]) -> Callable[..., Motion]:
    """A motion of any robot, from a function that returns times [time] and joint excursions [time, joint]."""

    stretches = "duration" in signature(excursions).parameters

    @wraps(excursions)
    def make(
        joints: Amplitudes | None = None,
        *args: Any,
        around: str = "home",
        offset: Amplitudes | None = None,
        robot: str,
        name: str = excursions.__name__,
        duration: float | None = None,
        **own: Any,
    ) -> Motion:
        for field, value in {"duration": duration, **own}.items():
            if isinstance(value, int | float) and not value > 0:
                raise ValueError(f"motion {name!r}: {field} must be positive, got {value}")
        known = load_robot(robot)
        if stretches and duration is not None:
            own["duration"] = duration
        middle = known.pose(around)
        for joint, angle in (offset or {}).items():
            middle[known.indices([joint])[0]] += angle

        def motion(chosen: Amplitudes) -> Motion:
            if not chosen:
                raise ValueError(f"motion {name!r} moves no joint; give joints with amplitudes in rad")
            time, away = excursions(chosen, *args, **own)
            if duration is not None and not stretches:
                passes = max(1, round(duration / time[-1]))
                away = np.concatenate([*[away[:-1]] * (passes - 1), away])
                time = np.arange(len(away)) / RATE
            if joints is None:
                fastest = np.abs(np.diff(away, axis=0)).max(0) * RATE
                away = away * np.minimum(1.0, BRISK * known.speed_limits[known.indices(chosen)] / (fastest + 1e-12))
            position = np.tile(middle, (len(time), 1))
            position[:, known.indices(chosen)] += away
            return Motion(time, position, name=name, mounts=("stand",), robot=known.reference)

        if joints is not None:
            return motion(joints)
        motions = [motion(amplitudes(known, share)) for share in SHARES]
        return next((one for one in motions if not motion_faults(one)), motions[-1])

    return make


@_of_any_robot
def chirp(
    joints: Amplitudes, low: float = 0.3, high: float = 4.0, duration: float = 10.0, speed: float = 2.0
) -> tuple[Array, Array]:
    """Sines with exponentially growing frequency, which identify inertia and damping relative to load.

    Args:
        joints: amplitude of each joint [rad]; it decreases with frequency if `speed` requires it.
        low: first frequency [Hz].
        high: last frequency [Hz].
        duration: length [s].
        speed: largest joint speed [rad/s].
    """
    time = sample_times(duration, RATE)
    growth = np.log(high / low)
    phase = 2 * np.pi * low * duration / growth * np.expm1(growth * time / duration)
    frequency = low * np.exp(growth * time / duration)
    largest = max(abs(amplitude) for amplitude in joints.values())
    shrink = np.minimum(1.0, speed / (2 * np.pi * frequency * largest))
    return time, _alike(shrink * np.sin(phase) * fade(time), joints)


@_of_any_robot
def triangle(
    joints: Amplitudes, speed: float = 0.15, acceleration: float = 2.0, cycles: int = 2
) -> tuple[Array, Array]:
    """Back-and-forth motion at constant speed, which identifies friction over angle and load in both directions.

    Fast strokes, up to the limit of the battery, identify the motor's resistance.

    Args:
        joints: amplitude of each joint [rad].
        speed: speed of the joint with the largest amplitude [rad/s].
        acceleration: acceleration of the same joint at the reversals [rad/s^2].
        cycles: number of full cycles, each from the pose to one side, to the other, and back.
    """
    largest = max(abs(amplitude) for amplitude in joints.values())
    corners = [0.0, *[1.0, -1.0] * cycles, 0.0]
    shape = np.concatenate([_stroke(a, b, speed / largest, acceleration / largest) for a, b in pairwise(corners)])
    return np.arange(len(shape)) / RATE, _alike(shape, joints)


@_of_any_robot
def multisine(
    joints: Amplitudes, low: float = 0.2, high: float = 3.0, lines: int = 6, duration: float = 10.0
) -> tuple[Array, Array]:
    """All joints at once, each with a sum of sines at separate frequencies, so that their effects can be distinguished.

    Frequencies are integer multiples of 1 / duration, assigned in turn from a logarithmic grid; phases are Schroeder's
    (IEEE Transactions on Information Theory 16, 1970), which keep the peak low. Amplitudes decrease with frequency, so
    that every sine has the same peak speed.

    Args:
        joints: largest excursion of each joint [rad].
        low: lowest frequency [Hz].
        high: highest frequency [Hz].
        lines: number of sines per joint.
        duration: length [s].
    """
    time = sample_times(duration, RATE)
    multiples = _distinct(np.geomspace(low * duration, high * duration, lines * len(joints)))
    away = np.zeros((len(time), len(joints)))
    for number, amplitude in enumerate(joints.values()):
        own = multiples[number :: len(joints)]
        k = np.arange(lines)
        phases = -np.pi * k * (k + 1) / lines
        waves = np.sin(2 * np.pi * own * time[:, None] / duration + phases) / own
        wave = waves.sum(1) * fade(time)
        away[:, number] = amplitude * wave / np.abs(wave).max()
    return time, away


@_of_any_robot
def staircase(
    joints: Amplitudes,
    levels: Sequence[float] = (0.5, 1.0, 0.5, 0.0, -0.5, -1.0, -0.5),
    ramp: float = 0.4,
    rest: float = 0.6,
) -> tuple[Array, Array]:
    """Holds at several angles, each reached from both sides; the rest positions identify stiction and gear losses.

    Args:
        joints: amplitude of each joint [rad].
        levels: share of the amplitude at each hold.
        ramp: time from one hold to the next [s].
        rest: time at each hold [s].
    """
    shape = levels_over_time([0.0, *levels, 0.0], ramp, rest)
    return np.arange(len(shape)) / RATE, _alike(shape, joints)


def amplitudes(robot: Robot, share: float = SHARES[0]) -> dict[str, float]:
    """Allowed excursion of each controlled joint around home [rad]: a share of the distance to the nearer limit."""
    columns = robot.indices(robot.controlled)
    low, high = robot.limits[columns].T
    reach = share * np.minimum(robot.home[columns] - low, high - robot.home[columns])
    return dict(zip(robot.controlled, np.minimum(reach, LARGEST).tolist(), strict=True))


def _alike(shape: Array, joints: Amplitudes) -> Array:
    """One shape [time] scaled by the amplitude of each joint, [time, joint]."""
    return shape[:, None] * np.array(list(joints.values()))


def fade(time: Array) -> Array:
    """Raised cosine up from zero over `FADE` and down to zero at the end, [time]."""
    to_end = np.minimum(time, time[-1] - time)
    return (1 - np.cos(np.pi * np.minimum(to_end / FADE, 1.0))) / 2


def _stroke(start: float, end: float, speed: float, acceleration: float) -> Array:
    """From rest to rest at constant acceleration, speed and deceleration, without the end, [time]."""
    way = abs(end - start)
    speed = min(speed, np.sqrt(way * acceleration))
    speeding = speed / acceleration
    total = way / speed + speeding
    time = np.arange(max(1, round(total * RATE))) / RATE
    up = 0.5 * acceleration * np.minimum(time, speeding) ** 2
    cruise = speed * np.clip(time - speeding, 0.0, total - 2 * speeding)
    slowing = np.clip(time - (total - speeding), 0.0, speeding)
    return start + np.sign(end - start) * (up + cruise + speed * slowing - 0.5 * acceleration * slowing**2)


def levels_over_time(levels: Sequence[float], ramp: float, rest: float) -> Array:
    """Angles that hold each level, with jerk-limited (quintic) ramps between the levels, [time]."""
    smooth = minimum_jerk(sample_times(ramp, RATE) / ramp)
    stay = np.ones(round(rest * RATE))
    parts = [levels[0] * stay]
    for a, b in pairwise(levels):
        parts += [a + (b - a) * smooth, b * stay]
    return np.concatenate(parts)


def _distinct(wanted: Array) -> NDArray[np.int64]:
    """Distinct ascending integers near the requested numbers."""
    chosen: list[int] = []
    for value in wanted:
        chosen.append(max(round(value), chosen[-1] + 1 if chosen else 1))
    return np.array(chosen)
