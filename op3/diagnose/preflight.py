"""What logs are too poor for, before anything is fitted."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
from scipy import signal

from op3.diagnose.labels import asked_current, mislabelled
from op3.diagnose.split import LogSplit
from op3.robot.joints import whole_limbs
from op3.rollout import Rollout, stand_tilt
from op3.servo import RobotModel

SHORTEST = 15.0
"""Fitted runs shorter than this in all cannot carry a name [s]."""

STILL = 0.02
"""A joint that moves less than this has told nothing [rad]."""

REACH = 0.1
"""Range of angles that a joint must cover to tell one kind of friction from another [rad]."""

SLOW, FAST = (0.02, 0.3), 0.6
"""Speeds at which a joint must be seen: where static friction acts, and where viscous friction does [rad/s]."""

DWELL = 0.5
"""How long it must be seen at each [s]."""

REVERSALS = 6
"""Changes of direction that a joint must make: backlash, friction and delay differ in them."""

PIECE, FEWEST_ROWS = 4.0, 16
"""Length of the pieces whose spectra are averaged [s], and rows that such a piece must have."""

FEWEST_LINES, FASTEST_LINE = 2.0, 20.0
"""Sines of equal speed that the commands of a joint must amount to over all runs, and up to where they are counted
[Hz]: one sine locks position, speed and load to each other, and tells two numbers of a joint (Ljung, System
Identification, 2nd ed., section 13.2, persistence of excitation). Sixty walks in the air at 1.1 to 1.5 Hz have 1.1 to
1.6, arms that sway with three sines 2.7 to 3.5, rich legs 24 to 30. Of 16 walks with one effect each five got a further
or a wrong name with a confidence above 0.8."""

COUNTED = ("packet_drop",)
"""Effects that are counted packet by packet, for which one sine will do."""

SPEED_SPAN = 0.04
"""Time over which a speed is taken [s]."""

SATURATED = 0.25
"""Share of the rows of a joint in which its servo does not give what is asked of it. Rich legs, exhausted on purpose,
have up to 0.08."""

UNREACHED = (0.1, 0.3)
"""A current is not reached if it is this much [A] and this share away from what was asked."""

FULL_DUTY = 0.97
"""A servo at this duty gives all it has."""

TIMING = ("latency", "current_lag", "velocity_filter", "packet_drop")
"""Effects that are seen in when a servo answers. They make loops swing until the servos give all they have, so logs in
which these do are what they look like."""

FIRMWARE = ("position_servo", "latency")
"""Effects of a servo's own loop that its duty would confirm or contradict."""

CAPPED = 0.5
"""Confidence that a candidate has at most where the logs cannot carry a name."""


@dataclass(frozen=True)
class Caution:
    """Why logs cannot tell something, and what to record next.

    Attributes:
        text: a sentence of each.
        joints: of which it is said; empty where it is said of all.
        effects: of which it is said; empty where it is said of all.
        void: whether the logs contradict themselves, so that fitting them means nothing.
        spared: effects of which it is not said.
        most: whether it is said of most joints that moved, and so of what all joints share too.
        assumed: whether it only says what was taken for granted, and speaks against no name.
    """

    text: str
    joints: tuple[str, ...] = ()
    effects: tuple[str, ...] = ()
    void: bool = False
    spared: tuple[str, ...] = ()
    most: bool = False
    assumed: bool = False

    def weakens(self, joints: Sequence[str], effect: str = "") -> bool:
        """Whether the name of an effect in these joints, or in all where there are none, is not to be trusted."""
        if self.assumed or (self.effects and effect not in self.effects) or effect in self.spared:
            return False
        if self.void or not self.joints:
            return True
        return set(joints) <= set(self.joints) if joints else self.most


def preflight(split: LogSplit, model: RobotModel) -> tuple[Caution, ...]:
    """Everything that speaks against trusting a name from these logs; empty if nothing does.

    Args:
        split: the logs.
        model: that is to be diagnosed.
    """
    wrong = mislabelled(split.logs, model)
    if wrong:
        return tuple(Caution(text, void=True) for text in wrong)
    said = (
        _short(split.fit),
        *_excitation(split.fit),
        _saturated(split.fit),
        _unseen_duty(split.fit),
        *_assumed(split.logs),
    )
    return tuple(caution for caution in said if caution)


def _short(logs: Sequence[Rollout]) -> Caution | None:
    duration = sum(log.duration for log in logs)
    if duration >= SHORTEST:
        return None
    return Caution(
        f"The fitted runs last {duration:.0f} s in all; record at least {SHORTEST:.0f} s, better 100 s in several"
        " runs with three repeats of one of them."
    )


def _assumed(logs: Sequence[Rollout]) -> list[Caution]:
    """What is taken for granted of a robot on the stand, as its logs do not tell; where it is wrong much is unknown."""
    if logs[0].metadata.mount != "stand":
        return []
    said, joints = [], logs[0].joints
    absent = [joint for joint in whole_limbs(joints) if joint not in joints]
    if absent:
        said.append(
            Caution(
                f"The logs lack {', '.join(absent)} of the same limbs, which were taken to be held in the pose"
                ' "stand"; record all joints of a limb if they were elsewhere, or moved.',
                assumed=True,
            )
        )
    if any(stand_tilt(log) is None for log in logs):
        said.append(
            Caution(
                "Logs without imu/orientation were taken to be of a level stand; record it, or write `tilt: [roll,"
                " pitch]` in rad into `extra` of their metadata, if it was tilted.",
                assumed=True,
            )
        )
    return said


def _excitation(logs: Sequence[Rollout]) -> list[Caution]:
    """Joints that did not move, or moved so that effects look alike."""
    joints = logs[0].joints
    reach = np.max([np.ptp(log.array("joint/position"), axis=0) for log in logs], axis=0)
    still = tuple(joint for joint, moved in zip(joints, reach, strict=True) if moved < STILL)
    poor = {joint: what for j, joint in enumerate(joints) if joint not in still and (what := _lacking(logs, j))}
    said = []
    if still:
        whole = len(still) == len(joints)
        said.append(
            Caution(
                f"{_listed(still, joints)} moved less than {STILL:g} rad in the fitted runs; move every joint through"
                " slow triangles and fast sines.",
                () if whole else still,
            )
        )
    if poor:
        whole = len(poor) + len(still) == len(joints)
        lacks = "; ".join(f"{joint} {what}" for joint, what in list(poor.items())[:3])
        more = f"; so did {len(poor) - 3} more" if len(poor) > 3 else ""
        said.append(
            Caution(
                f"Friction, delay and play look alike in joints that were hardly excited: {lacks}{more}. Record slow"
                " triangles at 0.02 to 0.3 rad/s and multisines beyond 1 rad/s in every joint.",
                () if whole else (*still, *poor),
            )
        )
    moved = [joint for joint in joints if joint not in still]
    alike = tuple(joint for joint in moved if _lines(logs, joints.index(joint)) < FEWEST_LINES)
    if alike:
        said.append(
            Caution(
                f"{_listed(alike, joints)} moved with little more than one sine, as in a walk, so that position, speed"
                " and load say the same; record multisines, steps and slow triangles.",
                () if len(alike) == len(moved) else (*still, *alike),
                spared=COUNTED,
                most=2 * len(alike) > len(moved),
            )
        )
    return said


def _lacking(logs: Sequence[Rollout], joint: int) -> str:
    """What the excitation of a joint lacks; empty if nothing."""
    slow = fast = reach = 0.0
    reversals = 0
    for log in logs:
        time, angle = log.array("time")[:, 0], log.array("joint/position")[:, joint]
        period = float(np.median(np.diff(time)))
        half = max(1, round(0.5 * SPEED_SPAN / period))
        speed = (angle[2 * half :] - angle[: -2 * half]) / (time[2 * half :] - time[: -2 * half])
        slow += period * float(((np.abs(speed) > SLOW[0]) & (np.abs(speed) < SLOW[1])).sum())
        fast += period * float((np.abs(speed) > FAST).sum())
        reversals += int((np.diff(np.sign(speed[np.abs(speed) > SLOW[0]])) != 0).sum())
        reach = max(reach, float(np.ptp(angle)))
    if reach < REACH:
        return f"covered {reach:.2f} rad"
    if reversals < REVERSALS:
        return f"turned {reversals} times"
    if slow < DWELL:
        return f"was slower than {SLOW[1]:g} rad/s for {slow:.1f} s only"
    if fast < DWELL:
        return f"was faster than {FAST:g} rad/s for {fast:.1f} s only"
    return ""


def _lines(logs: Sequence[Rollout], joint: int) -> float:
    """How many sines of equal power the speed of a joint's command amounts to; infinite where the command stays.

    The participation ratio of the spectrum over all runs, in units of that of one sine. It is taken in pieces of
    `PIECE`, so that standing still between two motions is none; what moves without a command is not judged by it.
    """
    grid = np.arange(1.0 / PIECE, FASTEST_LINE, 1.0 / PIECE)
    power = np.zeros(len(grid))
    for log in logs:
        name = "command/position" if "command/position" in log else "joint/position"
        time, angle = log.array("time")[:, 0], log.array(name)[:, joint]
        period = float(np.median(np.diff(time)))
        even = np.arange(time[0], time[-1], period)
        angle, rows = np.interp(even, time, angle), min(round(PIECE / period), len(even))
        if rows < FEWEST_ROWS or np.ptp(angle) < STILL:
            continue
        frequency, density = signal.welch(np.gradient(angle, period), 1.0 / period, "hann", rows, detrend="constant")
        power += np.interp(grid, frequency, density) * len(even) * period
    total = float(power.sum())
    # a Hann window spreads a sine over three bins, with powers of 1/4, 1 and 1/4
    return 0.5 * total**2 / float(np.square(power).sum()) if total > 0 else inf


def _saturated(logs: Sequence[Rollout]) -> Caution | None:
    """Joints whose servos could not give what was asked of them most of the time."""
    shares = np.mean([_exhausted(log) for log in logs], axis=0)
    joints = logs[0].joints
    found = tuple(joint for joint, share in zip(joints, shares, strict=True) if share > SATURATED)
    if not found:
        return None
    return Caution(
        f"{_listed(found, joints)} could not give what was asked in {shares.max():.0%} of the rows, by current limit or"
        " voltage, so that gear and friction hardly show; record at lower gains or amplitudes, with a charged battery.",
        () if len(found) == len(joints) else found,
        spared=TIMING,
    )


def _unseen_duty(logs: Sequence[Rollout]) -> Caution | None:
    """Servos with a loop of their own whose duty was not recorded."""
    if "command/firmware_gain" not in logs[0] or all("joint/duty" in log for log in logs):
        return None
    return Caution(
        "The servo's duty was not recorded, and it alone tells a wrong controller gain or a delay from friction: read"
        " the present PWM beside the position.",
        effects=FIRMWARE,
    )


def _exhausted(log: Rollout) -> np.ndarray:
    """Share of rows in which each servo is at its end, ``[joint]``; zero where the log does not tell."""
    none = np.zeros(len(log.joints))
    if "joint/duty" in log:
        return (np.abs(log.array("joint/duty")) > FULL_DUTY).mean(0)
    asked = asked_current(log)
    if asked is None or "joint/current" not in log:
        return none
    apart = np.abs(asked - log.array("joint/current"))
    return (apart > UNREACHED[0] + UNREACHED[1] * np.abs(asked)).mean(0)


def _listed(some: Sequence[str], joints: Sequence[str]) -> str:
    return "All joints" if len(some) == len(joints) > 1 else ", ".join(some)
