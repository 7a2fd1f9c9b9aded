"""Distances between parts of the OP3, by `mj_geomDistance` on the scene's shapes alone: no contact, no sensor."""

from itertools import combinations

import mujoco
import numpy as np

from op3.scenes import build_scene


class PartDistances:
    """Signed distances between parts of the robot that are not neighbours.

    Attributes:
        pairs: numbers of two geoms each: no two of one body or of parent and child, none of the head.
        legs: those of them between the left and the right leg.
    """

    def __init__(self) -> None:
        self.model = model = build_scene("floor", "op3").compile(visual=False)
        self.data = mujoco.MjData(model)
        parts = [g for g in range(model.ngeom) if model.geom_bodyid[g]]
        body, parent = model.geom_bodyid, model.body_parentid
        self.pairs = [
            (a, b)
            for a, b in combinations(parts, 2)
            if body[a] != body[b] and body[a] != parent[body[b]] and body[b] != parent[body[a]]
            if "head" not in (self.name(a), self.name(b))
        ]
        self.legs = [pair for pair in self.pairs if {self._leg(geom) for geom in pair} == {"l", "r"}]

    def name(self, geom: int) -> str:
        """Of a geom, without the robot's."""
        return str(self.model.geom(geom).name).removeprefix("op3/")

    def _leg(self, geom: int) -> str | None:
        side, part = self.name(geom)[:1], self.name(geom)[2:]
        return side if part in ("hip", "thigh", "shin", "ankle", "sole_long", "sole_wide") else None

    def between(self, first: int, second: int) -> float:
        """Distance in the present pose [m], negative where one is inside the other; at most 0.1 m."""
        return mujoco.mj_geomDistance(self.model, self.data, first, second, 0.1, None)

    def least(self, joint_position: np.ndarray, pairs: list[tuple[int, int]] | None = None) -> float:
        """Smallest distance of all pairs, or of some, in a pose [joint] in rad."""
        self.data.qpos[7:27] = joint_position
        mujoco.mj_kinematics(self.model, self.data)
        return min(self.between(*pair) for pair in (self.pairs if pairs is None else pairs))
