"""The walk that the OP3 comes with: sinusoids for body and feet, and the inverse kinematics of the legs.

The paper compares against it. The form of the gait and its default numbers are those of ROBOTIS' walking module
(default parameters of `op3_walking_module`); the code is ours. Gyro feedback is left out.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from op3.robot.joints import indices
from op3.robot.motions import Motion
from op3.robot.poses import pose

Array = NDArray[np.float64]

_THIGH = 0.11015
_SHIN = 0.11


@dataclass(frozen=True)
class SinusoidalGait:
    """Parameters of the walk; lengths in m, angles in rad, times in s.

    Attributes:
        period: of a cycle of two steps.
        double_support: share of the cycle in which both feet stand.
        step: half the distance that a foot moves against the body in a step; the body advances by four times this in
            a cycle.
        step_sway: forward sway of the body as a share of `step`.
        foot_height: how high a foot is lifted.
        sway: sideways sway of the body.
        bob: amplitude of the body's up and down.
        forward: place of the feet ahead of the hips.
        sideways: place of the feet outside the hips.
        crouch: by how much the stretched legs are shortened.
        lean: forward lean of the trunk.
        pelvis: how far the hip of the swinging leg is raised.
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

    def motion(self, duration: float, rate: float = 125.0) -> Motion:
        """The walk as targets of all joints, for a duration [s] at a rate [Hz]."""
        time = np.arange(round(duration * rate)) / rate
        return Motion(time, self.targets(time), name="sinusoidal_gait")

    def targets(self, time: Array) -> Array:
        """Targets of all joints [time, joint] in rad at times [time] in s since the start.

        Arms and head stay in the pose "stand", and the motion grows from nothing in two cycles.
        """
        grown = np.clip(time / (2 * self.period), 0.0, 1.0)
        position = np.tile(pose("stand"), (len(time), 1))
        for side, prefix in ((1, "l"), (-1, "r")):
            feet, lift = self._foot(time, side, grown)
            angles = leg_angles(feet, self.lean)
            angles["hip_roll"] = angles["hip_roll"] - self.pelvis * lift
            for name, angle in angles.items():
                # the right leg is the left one's mirror image, whose angles have the other sign
                position[:, indices([f"{prefix}_{name}"])[0]] = side * angle
        return position

    def _foot(self, time: Array, side: int, grown: Array) -> tuple[Array, Array]:
        """Ankle against the hip of one side, mirrored to the left ([time, xyz]), and how far it is lifted, 0 to 1."""
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
        z = -(_THIGH + _SHIN) + self.crouch + grown * (self.foot_height * lift + sway_z)
        return np.stack([x, y, z], -1), lift * grown


def leg_angles(ankle: Array, lean: float | Array = 0.0) -> dict[str, Array]:
    """Angles [rad] of the left leg's joints, without the yaw, that put the ankle there with the sole level.

    Args:
        ankle: place of the ankle relative to the hip's axes, in a frame that does not lean, [..., xyz] in m.
        lean: forward lean of the trunk [rad], a number or [...].

    Raises:
        ValueError: if the ankle is out of reach.
    """
    x, y, z = np.moveaxis(np.asarray(ankle, dtype=float), -1, 0)
    roll = np.arctan2(y, -z)
    down = np.hypot(y, z)
    reach = np.hypot(x, down)
    if (reach >= _THIGH + _SHIN).any() or (reach <= abs(_THIGH - _SHIN)).any():
        raise ValueError(f"the ankle is out of the leg's reach of {_THIGH + _SHIN:.4f} m: at {reach.max():.4f} m")
    knee = np.arccos((reach**2 - _THIGH**2 - _SHIN**2) / (2 * _THIGH * _SHIN))
    # tilts from the vertical about +y: of the line from hip to ankle, of thigh and of shin
    line = np.arctan2(-x, down)
    thigh = line - np.arcsin(_SHIN * np.sin(knee) / reach)
    return {
        "hip_roll": -roll,
        "hip_pitch": thigh - lean,
        "knee": knee,
        "ank_pitch": thigh + knee,
        "ank_roll": -roll,
    }
