"""Motions for the OP3 only: the squat, weight shifts, compliant knees, and the walk that is shipped with it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.motions.excitations import RATE, fade, levels_over_time
from op3.motions.motion import D_GAIN, P_GAIN, Motion, sample_times
from op3.robot.robot import Robot, load_robot

Array = NDArray[np.float64]

SQUAT_KNEE_LOW = 1.47
"""Knee angle at the bottom of the paper's squat [rad]."""

SQUAT_KNEE_HIGH = 0.6
"""Knee angle at the top of the paper's squat [rad]."""

SQUAT_LEAN = 0.3
"""Forward lean of the trunk during the squat [rad]; the paper gives no number.

The lean keeps the centre of mass over the middle of the soles from the lowest to the highest point.
"""

THIGH = 0.11015
"""Distance from hip pitch axis to knee axis [m]."""

SHIN = 0.11
"""Distance from knee axis to ankle pitch axis [m]."""


def op3_robot() -> Robot:
    """The robot of these motions, read when a motion is built."""
    return load_robot("op3")


def squat_position(knee: ArrayLike, lean: float = SQUAT_LEAN) -> Array:
    """Whole-body angles [..., joint] in rad of a squat at a knee angle [...], with all other joints at home.

    The hips stay above the ankles and the soles level while the trunk leans forward by `lean` [rad].
    """
    knee = np.asarray(knee, dtype=float)
    length = np.sqrt(THIGH**2 + SHIN**2 + 2 * THIGH * SHIN * np.cos(knee))
    angles = leg_angles(np.stack([0 * length, 0 * length, -length], -1), lean)
    return op3_robot().completed({f"l_{name}": angles[name] for name in ("hip_pitch", "knee", "ank_pitch")})


def squat(
    knee_low: float = SQUAT_KNEE_LOW,
    knee_high: float = SQUAT_KNEE_HIGH,
    frequency: float = 0.5,
    lean: float = SQUAT_LEAN,
    duration: float = 5.0,
    rate: float = RATE,
    name: str = "squat",
) -> Motion:
    """The squat that excites the robot for identification.

    In the paper, the robot leans forward and moves the knee between 1.47 and 0.6 rad at about 0.5 Hz. Here the knee
    follows a raised cosine from the low position, with zero speed at both ends.

    Args:
        knee_low: knee angle at the start and at every lowest point [rad].
        knee_high: knee angle at every highest point [rad].
        frequency: full cycles per second.
        lean: pitch of the trunk [rad], positive forward.
        duration: length [s].
        rate: rows per second.
    """
    time = sample_times(duration, rate)
    crouch = (1 + np.cos(2 * np.pi * frequency * time)) / 2
    return Motion(
        time, squat_position(knee_high + (knee_low - knee_high) * crouch, lean), name=name, robot=op3_robot().reference
    )


def push_down(
    knees: Sequence[float] = (0.6, 0.9, 1.2, 1.47, 1.2, 0.9, 0.6),
    ramp: float = 1.2,
    rest: float = 0.5,
    lean: float = SQUAT_LEAN,
    name: str = "push_down",
) -> Motion:
    """The robot's weight loads the knees slowly: a stepwise squat, down and up again, with rests in between.

    At each depth the load is the same on the way down and up but the direction differs, so the difference is due to
    gear losses and Coulomb friction.

    Args:
        knees: knee angles at the holds [rad].
        ramp: time from one hold to the next [s]; at each it rests for `rest`.
        lean: pitch of the trunk [rad], positive forward.
    """
    knee = levels_over_time(knees, ramp, rest)
    return Motion(
        np.arange(len(knee)) / RATE,
        squat_position(knee, lean),
        name=name,
        mounts=("floor",),
        robot=op3_robot().reference,
    )


def sway(
    amplitude: float = 0.08, frequency: float = 0.4, duration: float = 7.5, around: str = "stand", name: str = "sway"
) -> Motion:
    """Shifts the weight from foot to foot: hip and ankle rolls move equally, so the soles stay level.

    Args:
        amplitude: amplitude of the four roll joints [rad].
        frequency: full cycles per second.
        duration: length [s].
        around: pose in the middle.
    """
    time = sample_times(duration, RATE)
    position = np.tile(op3_robot().pose(around), (len(time), 1))
    rolls = op3_robot().indices(["l_hip_roll", "r_hip_roll", "l_ank_roll", "r_ank_roll"])
    position[:, rolls] += amplitude * (np.sin(2 * np.pi * frequency * time) * fade(time))[:, None]
    return Motion(time, position, name=name, mounts=("floor",), robot=op3_robot().reference)


def soften(
    knee: float = 1.2,
    p_gain: float = 3.0,
    cycles: int = 2,
    period: float = 4.0,
    lean: float = SQUAT_LEAN,
    name: str = "soften",
) -> Motion:
    """A crouch whose gain decreases and increases: the joints yield when motor and friction cannot hold the weight.

    A joint slips at |motor torque| = backward efficiency x |load| - Coulomb friction, and stiffens again from there.

    Args:
        knee: knee angle commanded throughout [rad].
        p_gain: lowest gain [A/rad]; the highest is that of a squat.
        cycles: number of gain cycles.
        period: duration of a cycle [s].
        lean: pitch of the trunk [rad], positive forward.
    """
    if not 0 < p_gain <= P_GAIN:
        raise ValueError(f"motion {name!r}: p_gain must be above 0 and at most {P_GAIN:g} A/rad, got {p_gain}")
    time = sample_times(cycles * period + 0.5, RATE)
    fall = (1 - np.cos(2 * np.pi * np.minimum(time, cycles * period) / period)) / 2
    position = np.tile(squat_position(knee, lean), (len(time), 1))
    gain = P_GAIN * (p_gain / P_GAIN) ** fall
    return Motion(time, position, name=name, mounts=("floor",), p_gain=gain, d_gain=D_GAIN, robot=op3_robot().reference)


@dataclass(frozen=True)
class SinusoidalGait:
    """The walk shipped with the OP3, the paper's baseline; lengths in m, angles in rad, times in s.

    Sinusoids for body and feet, and the inverse kinematics of the legs. Form and default numbers are those of ROBOTIS'
    walking module (default parameters of `op3_walking_module`); the code is op3's. Gyro feedback is omitted.

    Attributes:
        period: duration of a cycle of two steps.
        double_support: share of the cycle in which both feet stand.
        step: half the distance that a foot moves against the body in a step; the body advances by four times this in
            a cycle.
        step_sway: forward sway of the body as a share of `step`.
        foot_height: lift height of a foot.
        sway: sideways sway of the body.
        bob: amplitude of the body's up and down.
        forward: position of the feet ahead of the hips.
        sideways: lateral position of the feet outside the hips.
        crouch: shortening of the stretched legs.
        lean: forward lean of the trunk.
        pelvis: lift of the hip of the swinging leg.
    """

    period: float = 0.6
    double_support: float = 0.2
    step: float = 0.02
    step_sway: float = 0.28
    foot_height: float = 0.06
    sway: float = 0.028
    bob: float = 0.006
    forward: float = -0.02
    sideways: float = 0.015
    crouch: float = 0.035
    lean: float = np.deg2rad(7.0)
    pelvis: float = np.deg2rad(0.5)

    def motion(self, duration: float, rate: float = RATE) -> Motion:
        """The walk as targets of all joints, for a duration [s] at a rate [Hz]."""
        time = np.arange(round(duration * rate)) / rate
        return Motion(time, self.targets(time), name="sinusoidal_gait", robot=op3_robot().reference)

    def targets(self, time: Array) -> Array:
        """Targets of all joints [time, joint] in rad at times [time] in s since the start.

        Arms and head stay at home, and the motion grows from zero within two cycles.
        """
        grown = np.clip(time / (2 * self.period), 0.0, 1.0)
        position = np.tile(op3_robot().home, (len(time), 1))
        for side, prefix in ((1, "l"), (-1, "r")):
            feet, lift = self._foot(time, side, grown)
            angles = leg_angles(feet, self.lean)
            angles["hip_roll"] = angles["hip_roll"] - self.pelvis * lift
            for name, angle in angles.items():
                # the right leg is the left one's mirror image, whose angles have the other sign
                position[:, op3_robot().indices([f"{prefix}_{name}"])[0]] = side * angle
        return position

    def _foot(self, time: Array, side: int, grown: Array) -> tuple[Array, Array]:
        """Ankle position relative to the hip, mirrored to the left side ([time, xyz]), and relative lift, 0 to 1."""
        share = 1.0 - self.double_support
        # the left foot swings about the first quarter of the cycle, the right one half a cycle later
        middle = 0.25 if side > 0 else 0.75
        phase = (time / self.period) % 1.0
        own = np.clip((phase - middle) / (share / 2), -0.5, 0.5)
        # its own swing carries the foot from -1 to 1, the other foot's swing back again
        back = np.clip((((phase - middle) % 1.0) - 0.5) / (share / 2), -0.5, 0.5)
        swinging = np.abs(own) < 0.5
        forth = np.where(swinging, np.sin(np.pi * own), -np.sin(np.pi * back))
        lift = np.where(swinging, (1 + np.cos(2 * np.pi * own)) / 2, 0.0)
        cycle = 2 * np.pi * time / self.period
        # the body sways towards the foot that stands
        sway_x = self.step * self.step_sway * np.sin(2 * cycle - np.pi)
        sway_y = self.sway * np.sin(cycle)
        sway_z = self.bob * (np.sin(2 * cycle - 1.5 * np.pi) + 1.0)
        x = self.forward + grown * (self.step * forth + sway_x)
        y = self.sideways + side * grown * sway_y
        z = -(THIGH + SHIN) + self.crouch + grown * (self.foot_height * lift + sway_z)
        return np.stack([x, y, z], -1), lift * grown


def leg_angles(ankle: Array, lean: float | Array = 0.0) -> dict[str, Array]:
    """Angles [rad] of the left leg's joints, without yaw, that place the ankle there with a level sole.

    Args:
        ankle: position of the ankle relative to the hip's axes, in a frame that does not lean, [..., xyz] in m.
        lean: forward lean of the trunk [rad], a number or [...].

    Raises:
        ValueError: if the ankle is out of reach.
    """
    x, y, z = np.moveaxis(np.asarray(ankle, dtype=float), -1, 0)
    roll = np.arctan2(y, -z)
    down = np.hypot(y, z)
    reach = np.hypot(x, down)
    if (reach >= THIGH + SHIN).any() or (reach <= abs(THIGH - SHIN)).any():
        raise ValueError(
            f"the ankle is {reach.max():.4f} m from the hip, out of the leg's reach of {THIGH + SHIN:.4f} m"
        )
    knee = np.arccos((reach**2 - THIGH**2 - SHIN**2) / (2 * THIGH * SHIN))
    # tilts from the vertical about +y: of the line from hip to ankle, and of the thigh
    tilt = np.arctan2(-x, down) - np.arcsin(SHIN * np.sin(knee) / reach)
    return {"hip_roll": -roll, "hip_pitch": tilt - lean, "knee": knee, "ank_pitch": tilt + knee, "ank_roll": -roll}
