"""Distances between parts of a robot, computed fast enough for a control loop."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from op3.common.settings import GAIN_HIGH
from op3.robot.model_source import read_model
from op3.robot.robot import Robot, exclude_neighbours

CLEARANCE = 0.005
"""Smallest allowed distance between non-neighbouring parts of the robot [m]."""

LARGEST_OVERLAP = 0.002
"""Depth to which collision shapes may enter each other [m]: more than three times what two legs that meet at stall
current reach in simulation, 0.6 mm, so that a deeper overlap is not a contact but an impossible pose."""

LARGEST_OVERLAP_AHEAD = 0.01
"""The same limit for poses predicted from measured speeds or from commands [m]. The shipped walk, whose feet pass each
other within 2 mm, reaches 5.3 and 6.6 mm on two layers of bricks. A walk whose commands move the legs through each
other reaches 11 and 50 mm."""

HORIZON = 0.016
"""Time for which a collision is predicted from a measured pose [s]: within two ticks of 8 ms a new command acts."""


@dataclass(frozen=True)
class Gap:
    """Two parts of a robot that are close to each other.

    Attributes:
        distance: distance between their collision shapes [m], negative for overlap.
        parts: names of the parts.
    """

    distance: float
    parts: tuple[str, str]

    def __str__(self) -> str:
        first, second = self.parts
        millimetres = 1000 * self.distance
        place = f"within {millimetres:.1f} mm of" if millimetres >= 0 else f"{-millimetres:.1f} mm into"
        return f"{first} {place} {second}"


class SelfCollision:
    """The collision shapes of a robot, without masses, ground or forces.

    Parent and child never collide, and neither do parts that touch in the home pose.

    Args:
        margin: distance up to which parts count as close [m].
    """

    def __init__(self, robot: Robot, margin: float = CLEARANCE):
        # before compiling, when MuJoCo determines which bodies may collide
        spec = read_model(robot.model_path, robot.file).spec
        for geom in spec.geoms:
            if geom.conaffinity:
                geom.contype, geom.margin = 1, margin
        self._model = exclude_neighbours(spec).compile()
        self._data = mujoco.MjData(self._model)
        self._robot = robot
        self._margin = margin
        self._at_home: set[tuple[int, int]] = set()
        self._at_home = {pair for pair, _ in self._close(robot.home)}

    def nearest(self, joint_position: ArrayLike) -> Gap | None:
        """The closest pair of parts in a pose [joint] in rad; None if no pair is within the margin."""
        close = self._close(joint_position)
        if not close:
            return None
        pair, distance = min(close, key=lambda found: found[1])
        return Gap(distance, (self._name(pair[0]), self._name(pair[1])))

    def measured(
        self,
        position: ArrayLike,
        velocity: ArrayLike,
        overlap: float = LARGEST_OVERLAP,
        ahead: float = LARGEST_OVERLAP_AHEAD,
    ) -> Gap | None:
        """Parts that overlap by more than `overlap` [m] now or `ahead` [m] within `HORIZON`; otherwise None.

        Args:
            position: measured angles [joint] in rad.
            velocity: measured velocities [joint] in rad/s, assumed constant for `HORIZON`.
        """
        coming = np.asarray(position) + HORIZON * np.asarray(velocity)
        return self._deeper(position, overlap) or self._deeper(coming, ahead)

    def commanded(
        self, position: ArrayLike, target: ArrayLike, p_gain: ArrayLike, ahead: float = LARGEST_OVERLAP_AHEAD
    ) -> Gap | None:
        """Parts that overlap by more than `ahead` [m] at the commanded angles; otherwise None.

        The target of a joint with a low gain may be deep inside another part with little contact force. The checked
        pose is therefore the target that would give the same torque with the highest gain.

        Args:
            position: measured angles [joint] in rad.
            target: target angles [joint] in rad.
            p_gain: P gains [joint] in A/rad.
        """
        position = np.asarray(position)
        return self._deeper(position + np.asarray(p_gain) / GAIN_HIGH * (np.asarray(target) - position), ahead)

    def _deeper(self, joint_position: ArrayLike, largest: float) -> Gap | None:
        gap = self.nearest(joint_position)
        return gap if gap is not None and gap.distance < -largest else None

    def _close(self, joint_position: ArrayLike) -> list[tuple[tuple[int, int], float]]:
        """Pairs of geoms within the margin, and their distances [m]."""
        data = self._data
        data.qpos[:] = self._robot.configuration(joint_position)
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_collision(self._model, data)
        if not data.ncon:
            return []
        pairs, distances = data.contact.geom.tolist(), data.contact.dist.tolist()
        found = [((pair[0], pair[1]), distance) for pair, distance in zip(pairs, distances, strict=True)]
        return [one for one in found if one[1] < self._margin and one[0] not in self._at_home]

    def _name(self, geom: int) -> str:
        return self._model.geom(geom).name or f"a part of {self._model.body(self._model.geom_bodyid[geom]).name}"
