"""What only a simulator sees, every millisecond: forces on the feet, acceleration of the body, heights of the soles."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from op3.envs.batched import BatchedEnv
from op3.robot.units import GRAVITY
from op3.tasks.addresses import Addresses

Array = NDArray[np.float32]

TOUCHED, LIFTED = 5.0, 1.0
"""Forces from which a foot stands, and up to which it is in the air [N]; the OP3 weighs 33 N."""

SHORTEST_SWING = 60
"""Milliseconds in the air before a contact counts as a touchdown and not as a bounce."""


@dataclass(frozen=True, eq=False)
class Traces:
    """Robots of a batch, millisecond by millisecond.

    Attributes:
        force: of the ground on the left and the right foot, ``[time, sim, 2]`` in N.
        acceleration: of the trunk at the IMU without gravity, ``[time, sim]`` in m/s^2.
        sole: height of the lowest key point of each foot, ``[time, sim, 2]`` in m.
        ahead: where the trunk is, forwards, ``[time, sim]`` in m.
    """

    force: Array
    acceleration: Array
    sole: Array
    ahead: Array


class Watch:
    """Looks at an environment's robots after every step of the physics while `watching`."""

    def __init__(self, env: BatchedEnv):
        self._env, batch = env, env.simulation.batch
        at = Addresses.find(batch.model, env.scene)
        self._trunk, self._points, self._accelerometer = at.base, at.foot_points, at.accelerometer
        self._feet = batch.model.site_bodyid[self._points[:, 0]]
        self._external, self._sites = batch.bind("cfrc_ext"), batch.bind("site_xpos")
        self._turn, self._place = batch.bind("xmat"), batch.bind("xpos")
        self._sensors = env.simulation.sensordata.numpy()
        self._rows: tuple[list[Array], ...] = ([], [], [], [])

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Look as long as this lasts, beside whoever looks already."""
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
        upwards = self._turn[:, self._trunk].reshape(-1, 3, 3)[:, 2]
        assert self._accelerometer is not None
        specific = self._sensors[:, self._accelerometer : self._accelerometer + 3]
        seen = (
            np.linalg.norm(self._external[:, self._feet, 3:], axis=-1),
            np.linalg.norm(specific - GRAVITY * upwards, axis=-1),
            self._sites[:, self._points, 2].min(-1),
            self._place[:, self._trunk, 0].copy(),
        )
        for rows, values in zip(self._rows, seen, strict=True):
            rows.append(values.astype(np.float32))

    def traces(self) -> Traces:
        """All that was seen."""
        return Traces(*(np.stack(rows) for rows in self._rows))


def touchdowns(force: NDArray[np.floating]) -> NDArray[np.int64]:
    """Milliseconds ``[touchdown]`` at which a force ``[time]`` [N] on a foot first reaches `TOUCHED` after a swing."""
    landings, lifted, stands = [], 0, True
    for time, value in enumerate(force):
        if value < LIFTED:
            lifted += 1
        elif value >= TOUCHED:
            if not stands and lifted >= SHORTEST_SWING:
                landings.append(time)
            lifted, stands = 0, True
        if lifted >= SHORTEST_SWING:
            stands = False
    return np.array(landings, dtype=np.int64)
