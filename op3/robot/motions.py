"""Motions as arrays: what the joints are asked to do over time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.robot.robot import DEFAULT, load_robot

P_GAIN = 6.0
"""Gain of position of the paper's squat [A/rad]."""

D_GAIN = 0.1
"""Gain of velocity of the paper [A s/rad]."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Target joint angles over time.

    Attributes:
        time: [time] in s, increasing.
        position: [time, joint] in rad, in the order of `joints`.
        joints: joint names of the robot; all of them where none are given.
        name: what the motion is called in logs and figures.
        mounts: where it may be played: "floor", "stand".
        p_gain: gain of position it is played with [A/rad]: one number, or one per row [time].
        d_gain: gain of velocity it is played with [A s/rad].
        robot: that it is made for, a name in `assets/robots` or the path of its file.
    """

    time: NDArray[np.float64]
    position: NDArray[np.float64]
    joints: tuple[str, ...] = ()
    name: str = "motion"
    mounts: tuple[str, ...] = ("floor", "stand")
    p_gain: float | NDArray[np.float64] = P_GAIN
    d_gain: float = D_GAIN
    robot: str = DEFAULT

    def __post_init__(self):
        """Refuse arrays that do not fit together."""
        robot = load_robot(self.robot)
        object.__setattr__(self, "joints", self.joints or robot.joints)
        robot.indices(self.joints)
        if self.position.shape != (len(self.time), len(self.joints)):
            raise ValueError(
                f"motion {self.name!r}: position must be [time, joint] = "
                f"({len(self.time)}, {len(self.joints)}), got {self.position.shape}"
            )
        if not (np.isfinite(self.time).all() and np.isfinite(self.position).all()):
            raise ValueError(f"motion {self.name!r} holds numbers that are not finite")
        if (np.diff(self.time) <= 0).any():
            row = int(np.argmax(np.diff(self.time) <= 0)) + 1
            raise ValueError(f"motion {self.name!r}: time does not increase at row {row}")
        if np.shape(self.p_gain) not in ((), self.time.shape):
            shape = np.shape(self.p_gain)
            raise ValueError(f"motion {self.name!r}: p_gain must be one number or one per row, got the shape {shape}")

    @property
    def duration(self) -> float:
        """Time from the first to the last row [s]."""
        return float(self.time[-1] - self.time[0])


def sample_times(duration: float, rate: float) -> NDArray[np.float64]:
    """Times 0, 1/rate, ... below `duration` [time] in s."""
    if not (duration > 0 and rate > 0):
        raise ValueError(f"duration and rate must be positive, got {duration} s and {rate} Hz")
    return np.arange(round(duration * rate)) / rate


def hold(
    joint_position: ArrayLike, duration: float, rate: float = 125.0, name: str = "hold", robot: str = DEFAULT
) -> Motion:
    """Stay at the angles `joint_position` [joint] in rad for `duration` [s], with `rate` rows per second."""
    time = sample_times(duration, rate)
    position = load_robot(robot).position(joint_position)
    return Motion(time, np.tile(position, (len(time), 1)), name=name, robot=robot)


def minimum_jerk(share: ArrayLike) -> NDArray[np.float64]:
    """Share of a move that is done at a share of its time, 0 to 1 each: no speed and no acceleration at its ends."""
    s = np.clip(share, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)
