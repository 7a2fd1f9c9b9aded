"""Traces at every physics step that exist only in simulation: forces on the feet, motion of the soles, self-contact."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from op3.envs.batched import BatchedEnv
from op3.robot.register_units import GRAVITY
from op3.tasks.addresses import Addresses

Array = NDArray[np.float32]

TOUCHED, LIFTED = 5.0, 1.0
"""Force above which a foot is on the ground, and force below which it is in the air [N]; the OP3 weighs 33 N."""

SHORTEST_SWING = 60
"""Number of 1 ms steps in the air before a contact counts as a touchdown rather than a bounce."""

SKIPPED = 1.5
"""Time at the beginning of an episode that is omitted from gait measures [s], because the robot does not walk yet."""


@dataclass(frozen=True, eq=False)
class Traces:
    """Traces of the robots of a batch, one row per physics step; feet are those with soles, the left one first.

    Attributes:
        force: external force on each foot, ``[time, sim, foot]`` in N.
        acceleration: trunk acceleration at the IMU without gravity, ``[time, sim]`` in m/s^2; NaN without an
            IMU.
        sole: height of the lowest corner of each foot's sole, ``[time, sim, foot]`` in m.
        slip: horizontal speed of this corner, ``[time, sim, foot]`` in m/s.
        centre: position of each sole's centre, forwards and to the left in the world, ``[time, sim, foot, 2]`` in m.
        ahead: forward position of the trunk in the world, ``[time, sim]`` in m.
        tilt: angle of the trunk from upright, ``[time, sim]`` in rad.
        yaw: heading of the trunk, ``[time, sim]`` in rad, within pi of 0.
        penetration: depth of the deepest self-contact, ``[time, sim]`` in m; 0 without contact.
    """

    force: Array
    acceleration: Array
    sole: Array
    slip: Array
    centre: Array
    ahead: Array
    tilt: Array
    yaw: Array
    penetration: Array


class StepWatch:
    """Records an environment's robots after every physics step within `watching`."""

    def __init__(self, env: BatchedEnv):
        self._env, batch, robot = env, env.simulation.batch, env.scene.robot
        assert robot is not None
        model, at = batch.model, Addresses.find(batch.model, env.scene)
        self._timestep = model.opt.timestep
        self._trunk, self._accelerometer, self._contact = at.base, at.accelerometer, at.self_contact
        soles = np.array([model.geom(sole.full_identifier).id for sole in robot.soles], dtype=np.int64)
        self._feet = np.array(list(dict.fromkeys(model.geom_bodyid[soles])), dtype=np.int64)
        self._soles = soles = soles.reshape(len(self._feet), -1) if len(soles) else soles.reshape(0, 1)
        corners = np.array(list(product((-1.0, 1.0), repeat=3)))
        self._corners = model.geom_size[soles][:, :, None] * corners  # [foot, box, corner, 3]
        self._external, self._sensors = batch.bind("cfrc_ext"), env.simulation.sensordata.numpy()
        self._turn, self._place = batch.bind("xmat"), batch.bind("xpos")
        self._sole_place, self._sole_turn = batch.bind("geom_xpos"), batch.bind("geom_xmat")
        self._before: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._rows: list[tuple[Array, ...]] = []

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Context within which steps are recorded, in addition to other observers."""
        simulation, before = self._env.simulation, self._env.simulation.on_step

        def look() -> None:
            if before is not None:
                before()
            self._look()

        simulation.on_step = look
        try:
            yield
        finally:
            simulation.on_step = before

    def _look(self) -> None:
        turn = self._turn[:, self._trunk].reshape(-1, 3, 3)
        found, distance = self._sensors[:, self._contact], self._sensors[:, self._contact + 1]
        height, speed, centre = self._look_at_soles()
        seen = (
            np.linalg.norm(self._external[:, self._feet, 3:], axis=-1),
            self._acceleration(turn),
            height,
            speed,
            centre,
            self._place[:, self._trunk, 0],
            np.arccos(turn[:, 2, 2].clip(-1.0, 1.0)),
            np.arctan2(turn[:, 1, 0], turn[:, 0, 0]),
            np.where(found > 0, np.maximum(-distance, 0.0), 0.0),
        )
        self._rows.append(tuple(values.astype(np.float32) for values in seen))

    def _acceleration(self, turn: NDArray[np.float64]) -> NDArray[np.float64]:
        if self._accelerometer is None:
            return np.full(len(turn), np.nan)
        specific = self._sensors[:, self._accelerometer : self._accelerometer + 3]
        return np.linalg.norm(specific - GRAVITY * turn[:, 2], axis=-1)

    def _look_at_soles(self) -> tuple[NDArray[np.float64], ...]:
        """Height and horizontal speed of each sole's lowest corner ``[sim, foot]``, and centre ``[sim, foot, 2]``."""
        place = self._sole_place[:, self._soles]  # [sim, foot, box, 3]
        turn = self._sole_turn[:, self._soles].reshape(*place.shape, 3)
        shape = place.shape[:2]
        heights = place[..., None, 2] + np.einsum("sfbj,fbcj->sfbc", turn[..., 2, :], self._corners)
        lowest = heights.reshape(*shape, heights.shape[2] * heights.shape[3]).argmin(-1)
        sims, feet = np.indices(shape)
        box, corner = np.divmod(lowest, self._corners.shape[2])

        def corner_of(place: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
            local = self._corners[feet, box, corner]
            return place[sims, feet, box] + np.einsum("sfij,sfj->sfi", turn[sims, feet, box], local)

        now = corner_of(place, turn)
        before = now if self._before is None else corner_of(*self._before)
        self._before = place.copy(), turn.copy()
        speed = np.linalg.norm((now - before)[..., :2], axis=-1) / self._timestep
        return now[..., 2], speed, place[..., :2].mean(2)

    def traces(self) -> Traces:
        """The recorded traces."""
        return Traces(*(np.stack(values) for values in zip(*self._rows, strict=True)))


def swings(force: NDArray[np.floating]) -> NDArray[np.int64]:
    """Swings of a foot: steps from the last contact before to the touchdown after, ``[swing, 2]``.

    At a touchdown, the force ``[time]`` [N] on the foot reaches `TOUCHED` for the first time after `SHORTEST_SWING` in
    the air; weaker contacts belong to the swing.
    """
    found, lifted, stands, left = [], 0, True, 0
    for time, value in enumerate(force):
        if value < LIFTED:
            lifted += 1
        elif value >= TOUCHED:
            if not stands and lifted >= SHORTEST_SWING:
                found.append((left, time))
            lifted, stands, left = 0, True, time
        if lifted >= SHORTEST_SWING:
            stands = False
    return np.array(found, dtype=np.int64).reshape(-1, 2)


def touchdowns(force: NDArray[np.floating]) -> NDArray[np.int64]:
    """Steps ``[touchdown]`` at which swings end; see `swings`."""
    return swings(force)[:, 1]
