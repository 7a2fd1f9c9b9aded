"""Excitations: motions that make the parameters of servos and body visible in a log.

Every one starts and ends at rest in the pose it goes around, keeps its own speed limit, and is sampled at the rate of
the robot's PD loop. `op3.robot.motion_checks` checks limits, speeds and collisions of the result.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from op3.robot.motion_checks import motion_faults
from op3.robot.motions import D_GAIN, P_GAIN, Motion, sample_times
from op3.robot.poses import SQUAT_LEAN, pose, squat_position
from op3.robot.robot import Robot, load_robot

RATE = 125.0
"""Rows per second: the robot's PD loop."""

FADE = 0.5
"""How long oscillations swell and die away [s]."""

Array = NDArray[np.float64]
Amplitudes = Mapping[str, float]
"""Amplitude of each joint that moves [rad]; the sign is its direction."""

SHARES = (0.4, 0.2, 0.1, 0.05)
"""How far joints move where no amplitudes are given, of the way from home to the nearer limit: the first safe one."""

LARGEST = 0.5
"""And the largest of these amplitudes [rad]."""


def chirp(
    joints: Amplitudes | None = None,
    low: float = 0.3,
    high: float = 4.0,
    duration: float = 10.0,
    speed: float = 2.0,
    around: str = "home",
    offset: Amplitudes | None = None,
    robot: str = "op3",
    name: str = "chirp",
) -> Motion:
    """Sines whose frequency grows exponentially: inertia and damping over load.

    Args:
        joints: amplitude of each joint [rad]; it shrinks with frequency where `speed` asks for it.
            None: every controlled joint as far as is safe, see `amplitudes`.
        low: first frequency [Hz].
        high: last frequency [Hz].
        duration: length [s].
        speed: greatest joint speed of the sine [rad/s].
        around: pose in the middle: "home", or one of the OP3's.
        offset: added to that pose, by joint [rad], for example to spread the legs.
        name: of the motion.
        robot: a name in `assets/robots`, or the path of its file.
    """
    known = load_robot(robot)
    if joints is None:
        return _largest_safe(lambda own: chirp(own, low, high, duration, speed, around, offset, robot, name), known)
    time = sample_times(duration, RATE)
    growth = np.log(high / low)
    phase = 2 * np.pi * low * duration / growth * np.expm1(growth * time / duration)
    frequency = low * np.exp(growth * time / duration)
    largest = max(abs(amplitude) for amplitude in joints.values())
    shrink = np.minimum(1.0, speed / (2 * np.pi * frequency * largest))
    return _around(time, shrink * np.sin(phase) * _fade(time), joints, _middle(known, around, offset), name, known)


def triangle(
    joints: Amplitudes | None = None,
    speed: float = 0.15,
    acceleration: float = 2.0,
    cycles: int = 2,
    around: str = "home",
    offset: Amplitudes | None = None,
    robot: str = "op3",
    name: str = "triangle",
) -> Motion:
    """To and fro at constant speed: friction against angle and load, in both directions.

    Fast ones, at up to what the battery allows, show the motor's resistance.

    Args:
        joints: amplitude of each joint [rad].
            None: every controlled joint as far as is safe, see `amplitudes`.
        speed: of the joint with the largest amplitude [rad/s].
        acceleration: at the turns, of the same joint [rad/s^2].
        cycles: full ones, each from the pose to one side, to the other, and back.
        around: pose in the middle: "home", or one of the OP3's.
        offset: added to that pose, by joint [rad], for example to spread the legs.
        name: of the motion.
        robot: a name in `assets/robots`, or the path of its file.
    """
    known = load_robot(robot)
    if joints is None:
        return _largest_safe(lambda own: triangle(own, speed, acceleration, cycles, around, offset, robot, name), known)
    largest = max(abs(amplitude) for amplitude in joints.values())
    corners = [0.0, *[1.0, -1.0] * cycles, 0.0]
    shape = np.concatenate([_stroke(a, b, speed / largest, acceleration / largest) for a, b in pairwise(corners)])
    return _around(np.arange(len(shape)) / RATE, shape, joints, _middle(known, around, offset), name, known)


def multisine(
    joints: Amplitudes | None = None,
    low: float = 0.2,
    high: float = 3.0,
    lines: int = 6,
    duration: float = 10.0,
    around: str = "home",
    offset: Amplitudes | None = None,
    robot: str = "op3",
    name: str = "multisine",
) -> Motion:
    """All joints at once, each a sum of sines at frequencies of its own, so that their effects can be told apart.

    Frequencies are whole multiples of 1 / duration, dealt out in turn from a logarithmic grid; phases are Schroeder's
    (IEEE Transactions on Information Theory 16, 1970), which keep the peak low. Amplitudes fall with frequency, so
    every line moves equally fast.

    Args:
        joints: largest excursion of each joint [rad].
            None: every controlled joint as far as is safe, see `amplitudes`.
        low: lowest frequency [Hz].
        high: highest frequency [Hz].
        lines: sines per joint.
        duration: length [s].
        around: pose in the middle: "home", or one of the OP3's.
        offset: added to that pose, by joint [rad], for example to spread the legs.
        name: of the motion.
        robot: a name in `assets/robots`, or the path of its file.
    """
    known = load_robot(robot)
    if joints is None:
        return _largest_safe(lambda own: multisine(own, low, high, lines, duration, around, offset, robot, name), known)
    time = sample_times(duration, RATE)
    wanted = np.geomspace(low * duration, high * duration, lines * len(joints))
    multiples = _distinct(wanted)
    position = np.tile(_middle(known, around, offset), (len(time), 1))
    for number, (joint, amplitude) in enumerate(joints.items()):
        own = multiples[number :: len(joints)]
        k = np.arange(lines)
        phases = -np.pi * k * (k + 1) / lines
        waves = np.sin(2 * np.pi * own * time[:, None] / duration + phases) / own
        wave = waves.sum(1) * _fade(time)
        position[:, known.indices([joint])[0]] += amplitude * wave / np.abs(wave).max()
    return Motion(time, position, name=name, mounts=("stand",), robot=known.reference)


def staircase(
    joints: Amplitudes | None = None,
    levels: Sequence[float] = (0.5, 1.0, 0.5, 0.0, -0.5, -1.0, -0.5),
    ramp: float = 0.4,
    rest: float = 0.6,
    around: str = "home",
    offset: Amplitudes | None = None,
    robot: str = "op3",
    name: str = "staircase",
) -> Motion:
    """Holds at several angles, each reached from both sides: what a joint rests at shows static friction and gear.

    Args:
        joints: amplitude of each joint [rad].
            None: every controlled joint as far as is safe, see `amplitudes`.
        levels: share of the amplitude at each hold.
        ramp: time from one hold to the next [s].
        rest: time at each hold [s].
        around: pose at the start and at the end: "home", or one of the OP3's.
        offset: added to that pose, by joint [rad].
        name: of the motion.
        robot: a name in `assets/robots`, or the path of its file.
    """
    known = load_robot(robot)
    if joints is None:
        return _largest_safe(lambda own: staircase(own, levels, ramp, rest, around, offset, robot, name), known)
    shape = _levels([0.0, *levels, 0.0], ramp, rest)
    return _around(np.arange(len(shape)) / RATE, shape, joints, _middle(known, around, offset), name, known)


def push_down(
    knees: Sequence[float] = (0.6, 0.9, 1.2, 1.47, 1.2, 0.9, 0.6),
    ramp: float = 1.2,
    rest: float = 0.5,
    lean: float = SQUAT_LEAN,
    name: str = "push_down",
) -> Motion:
    """The robot's own weight loads the knees slowly: a squat in steps, down and up again, at rest between.

    At one depth the load is the same on the way down and up, the direction is not: what differs is what the gear and
    Coulomb friction hold.

    Args:
        knees: knee angles at the holds [rad].
        ramp: time from one hold to the next [s].
        rest: time at each hold [s].
        lean: pitch of the trunk [rad], positive forward.
        name: of the motion.
    """
    knee = _levels(knees, ramp, rest)
    return Motion(np.arange(len(knee)) / RATE, squat_position(knee, lean), name=name, mounts=("floor",))


def sway(
    amplitude: float = 0.08, frequency: float = 0.4, duration: float = 7.5, around: str = "stand", name: str = "sway"
) -> Motion:
    """From foot to foot: hip and ankle rolls move alike, so the soles stay level while the load wanders.

    Args:
        amplitude: of the four roll joints [rad].
        frequency: full cycles per second.
        duration: length [s].
        around: pose in the middle: "home", or one of the OP3's.
        name: of the motion.
    """
    time = sample_times(duration, RATE)
    joints = {joint: amplitude for joint in ("l_hip_roll", "r_hip_roll", "l_ank_roll", "r_ank_roll")}
    motion = _around(
        time, np.sin(2 * np.pi * frequency * time) * _fade(time), joints, pose(around), name, load_robot("op3")
    )
    return Motion(time, motion.position, name=name, mounts=("floor",))


def soften(
    knee: float = 1.2,
    p_gain: float = 3.0,
    cycles: int = 2,
    period: float = 4.0,
    lean: float = SQUAT_LEAN,
    name: str = "soften",
) -> Motion:
    """A crouch whose gain falls and rises: the joints give way to the weight where motor and friction cannot hold.

    It slips where |motor torque| = backward efficiency x |load| less Coulomb friction, and stiffens again from there.

    Args:
        knee: knee angle commanded throughout [rad].
        p_gain: lowest gain [A/rad]; the highest is that of a squat.
        cycles: how often it falls and rises.
        period: of one [s].
        lean: pitch of the trunk [rad], positive forward.
        name: of the motion.
    """
    time = sample_times(cycles * period + 0.5, RATE)
    fall = (1 - np.cos(2 * np.pi * np.minimum(time, cycles * period) / period)) / 2
    gain = P_GAIN * (p_gain / P_GAIN) ** fall
    position = np.tile(squat_position(knee, lean), (len(time), 1))
    return Motion(time, position, name=name, mounts=("floor",), p_gain=gain, d_gain=D_GAIN)


def _largest_safe(make: Callable[[Amplitudes], Motion], robot: Robot) -> Motion:
    """The motion of all controlled joints with the largest amplitudes that are safe."""
    motions = [make(amplitudes(robot, share)) for share in SHARES]
    return next((motion for motion in motions if not motion_faults(motion)), motions[-1])


def amplitudes(robot: Robot, share: float = SHARES[0]) -> dict[str, float]:
    """How far each controlled joint may move around home [rad]: a share of the way to its nearer limit."""
    columns = robot.indices(robot.controlled)
    low, high = robot.limits[columns].T
    reach = share * np.minimum(robot.home[columns] - low, high - robot.home[columns])
    return dict(zip(robot.controlled, np.minimum(reach, LARGEST).tolist(), strict=True))


def _middle(robot: Robot, around: str, offset: Amplitudes | None) -> Array:
    """A pose with some joints moved aside, [joint] in rad."""
    position = robot.home.copy() if around == "home" else pose(around)
    for joint, angle in (offset or {}).items():
        position[robot.indices([joint])[0]] += angle
    return position


def _around(time: Array, shape: Array, joints: Amplitudes, middle: Array, name: str, robot: Robot) -> Motion:
    """Joints move by amplitude times shape [time] around a pose; on the stand, where nothing can tip over."""
    if not joints:
        raise ValueError(f"motion {name!r} moves no joint: give joints with their amplitudes in rad")
    position = np.tile(middle, (len(time), 1))
    position[:, robot.indices(joints)] += shape[:, None] * np.array(list(joints.values()))
    return Motion(time, position, name=name, mounts=("stand",), robot=robot.reference)


def _fade(time: Array) -> Array:
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


def _levels(levels: Sequence[float], ramp: float, rest: float) -> Array:
    """Holds at levels with jerk-limited ramps between (quintic, at rest at both ends), [time]."""
    u = sample_times(ramp, RATE) / ramp
    smooth = u**3 * (10 - 15 * u + 6 * u**2)
    stay = np.ones(round(rest * RATE))
    parts = [levels[0] * stay]
    for a, b in pairwise(levels):
        parts += [a + (b - a) * smooth, b * stay]
    return np.concatenate(parts)


def _distinct(wanted: Array) -> NDArray[np.int64]:
    """Whole numbers near the wanted ones, ascending, none twice."""
    chosen: list[int] = []
    for value in wanted:
        chosen.append(max(round(value), chosen[-1] + 1 if chosen else 1))
    return np.array(chosen)
