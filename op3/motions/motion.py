"""Motions as arrays: targets of the joints over time."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.robot.robot import load_robot

Array = NDArray[np.float64]

P_GAIN = 6.0
"""P gain of the paper's squat [A/rad]."""

D_GAIN = 0.1
"""D gain of the paper [A s/rad]."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Target joint angles over time.

    Attributes:
        time: increasing times [time] in s.
        position: target angles [time, joint] in rad, in the order of `joints`.
        joints: joint names of the robot; by default all.
        name: name in logs and figures.
        mounts: allowed mounts: "floor", "stand".
        p_gain: P gain during playback [A/rad]: one number, or one per row [time].
        d_gain: D gain during playback [A s/rad].
        robot: robot of the motion, a name in `assets/robots` or the path of its file.
    """

    time: NDArray[np.float64]
    position: NDArray[np.float64]
    joints: tuple[str, ...] = ()
    name: str = "motion"
    mounts: tuple[str, ...] = ("floor", "stand")
    p_gain: float | NDArray[np.float64] = P_GAIN
    d_gain: float = D_GAIN
    robot: str = field(kw_only=True)

    def __post_init__(self):
        """Raise an error for arrays that do not fit together."""
        robot = load_robot(self.robot)
        object.__setattr__(self, "joints", self.joints or robot.joints)
        robot.indices(self.joints)
        if self.position.shape != (len(self.time), len(self.joints)):
            raise ValueError(
                f"motion {self.name!r}: position must be [time, joint] = "
                f"({len(self.time)}, {len(self.joints)}), got {self.position.shape}"
            )
        if not (np.isfinite(self.time).all() and np.isfinite(self.position).all()):
            raise ValueError(f"motion {self.name!r} contains non-finite numbers")
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
    for name, value in (("duration", duration), ("rate", rate)):
        if not value > 0:
            raise ValueError(f"{name} must be positive, got {value}")
    return np.arange(round(duration * rate)) / rate


def hold(joint_position: ArrayLike, duration: float, rate: float = 125.0, name: str = "hold", *, robot: str) -> Motion:
    """Stay at the angles `joint_position` [joint] in rad for `duration` [s], with `rate` rows per second."""
    time = sample_times(duration, rate)
    position = load_robot(robot).position(joint_position)
    return Motion(time, np.tile(position, (len(time), 1)), name=name, robot=robot)


def sample(motion: Motion, period: float, joints: Sequence[str] = (), rest: Array | None = None) -> Array:
    """Targets of joints at ticks of `period` [s], [tick, joint]: held between a motion's own rows.

    Other joints stay at `rest`; without `rest`, all joints of the motion's robot are included and stay at home.
    """
    known = load_robot(motion.robot)
    joints, rest = joints or known.joints, known.home if rest is None else rest
    ticks = np.arange(round((motion.time[-1] - motion.time[0]) / period) + 1) * period
    # Half a percent of the period absorbs rounding of written times.
    rows = np.searchsorted(motion.time - motion.time[0], ticks + 0.005 * period, side="right") - 1
    targets = np.tile(rest, (len(ticks), 1))
    targets[:, [joints.index(name) for name in motion.joints]] = motion.position[rows]
    return targets


def gain_rows(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """A gain, one number, [joint] or [tick, joint], as [tick, joint]; raises a ValueError if it has another shape."""
    try:
        gain = np.broadcast_to(np.asarray(value, dtype=float), shape).copy()
    except ValueError:
        wanted = f"one number, one per joint ({shape[1]}) or one per row and joint ({shape[0]}, {shape[1]})"
        raise ValueError(f"{name} must be {wanted}, got {value!r}") from None
    if not (np.isfinite(gain).all() and (gain >= 0).all()):
        raise ValueError(f"{name} must be finite and at least 0, got {value}")
    return gain
