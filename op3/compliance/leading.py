"""Guidance of a walking robot by hand: pulled slowly at trunk or foot and compared with an unpulled twin."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from op3.common.sample_intervals import with_interval
from op3.common.settings import CONTROL_PERIOD
from op3.envs.actors import Actor
from op3.servo import RobotModel
from op3.tasks.task import TICKS, Task, find_task

Array = NDArray[np.float64]

PULLS = {
    "trunk forwards": ("trunk", (1.0, 0.0, 0.0)),
    "trunk backwards": ("trunk", (-1.0, 0.0, 0.0)),
    "trunk to the left": ("trunk", (0.0, 1.0, 0.0)),
    "left foot forwards": ("foot", (1.0, 0.0, 0.0)),
    "left foot outwards": ("foot", (0.0, 1.0, 0.0)),
    "left foot upwards": ("foot", (0.0, 0.0, 1.0)),
}
"""Pulled body and direction of the pull in the world's axes."""

FIRST, DURATION, MOST = 2.0, 6.0, 6.0
"""Start and duration of the force ramp [s], and its largest force [N]; the OP3 weighs 33 N."""


@dataclass(frozen=True, eq=False)
class Led:
    """Robots under a growing force, arrays over `force` [level]; displacement is relative to the twin.

    Attributes:
        force: force levels [N].
        displacement: displacement of the trunk along the force, or of the foot relative to the trunk, averaged over a
            gait cycle; mean and 95 % interval over robots still upright, ``[level, 3]`` in m; NaN with fewer than two.
        upright: share of the robots still upright, [level].
    """

    force: NDArray[np.floating]
    displacement: Array
    upright: Array

    @property
    def fall_force(self) -> float | None:
        """Force at which half of the robots have fallen [N]; None if fewer have fallen."""
        fallen = np.flatnonzero(self.upright < 0.5)
        return float(self.force[fallen[0]]) if len(fallen) else None

    @property
    def follows(self) -> float | None:
        """Displacement per force [m/N]: by least squares through zero over all levels at which half are upright."""
        known = (self.upright >= 0.5) & np.isfinite(self.displacement[:, 0])
        if not known.any():
            return None
        return float(self.displacement[known, 0] @ self.force[known] / (self.force[known] @ self.force[known]))


def lead(
    actor: Actor,
    model: str | RobotModel,
    task: Task,
    *,
    episodes: int,
    seed: int = 0,
    **options: Any,
) -> dict[str, Led]:
    """Pull walking robots in every way of `PULLS` with a linearly growing force.

    Args:
        episodes: for each pull; all pulls and the twins have the same initial states.
        **options: further arguments of `op3.envs.make_env`.
    """
    count = len(PULLS) * episodes
    env = actor.environment(find_task(task, duration=FIRST + DURATION), model, count + episodes, seed, **options)
    places = _Places(env)
    external = env.simulation.batch.bind("xfrc_applied")
    way = np.repeat([direction for _, direction in PULLS.values()], episodes, axis=0)
    body = np.repeat([places.body[what] for what, _ in PULLS.values()], episodes)
    state: Any = env.begin({row: row % episodes for row in range(env.num_envs)})

    def pull(tick: int) -> None:
        since = env.mdp.time.numpy()[:count] + tick * CONTROL_PERIOD - FIRST
        size = MOST * np.clip(since / DURATION, 0.0, 1.0)
        external[np.arange(count), body, :3] = size[:, None] * way

    env.on_tick = pull
    seen: list[Array] = []
    upright = [np.ones(env.num_envs, dtype=bool)]
    for _ in range(env.task.steps):
        state = actor.step(env, state)
        seen.append(places.now())
        upright.append(upright[-1] & np.logical_not(state["terminated"][:, 0].numpy()))
    return _against_twins(np.array(seen), np.array(upright[1:]), way, episodes, task.cycle or 1.0)


class _Places:
    """Positions of trunks and left feet."""

    def __init__(self, env: Any):
        batch, robot = env.simulation.batch, env.scene.robot
        model = batch.model
        site = model.site(robot.key_points[0].full_identifier).id
        self.body = {"trunk": model.body(robot.trunk.full_identifier).id, "foot": int(model.site_bodyid[site])}
        self._place, self._turn = batch.bind("xpos"), batch.bind("xmat")

    def now(self) -> Array:
        """Positions of the trunk in the world and of the foot in the trunk's frame: ``[sim, 2, 3]`` in m."""
        trunk, foot = self._place[:, self.body["trunk"]], self._place[:, self.body["foot"]]
        turn = self._turn[:, self.body["trunk"]].reshape(-1, 3, 3)
        return np.stack([trunk, np.einsum("sij,si->sj", turn, foot - trunk)], 1)


def _against_twins(seen: Array, upright: NDArray[np.bool_], way: Array, episodes: int, cycle: float) -> dict[str, Led]:
    """Displacements of robots ``[step, sim, 2, 3]`` from the unpulled twins (the last rows), averaged over cycles."""
    count, period = len(way), TICKS * CONTROL_PERIOD
    twins = np.tile(seen[:, count:], (1, len(PULLS), 1, 1))
    moved = np.einsum("tsci,si->tsc", seen[:, :count] - twins, way)
    together = upright[:, :count] & np.tile(upright[:, count:], (1, len(PULLS)))
    steps = max(1, round(cycle / period))
    ends = np.arange(round(FIRST / period) + steps, len(seen) + 1, steps)
    force = MOST * np.clip(((ends - steps / 2) * period - FIRST) / DURATION, 0.0, 1.0)
    led = {}
    for number, (name, (what, _)) in enumerate(PULLS.items()):
        mine = slice(number * episodes, (number + 1) * episodes)
        displacement = np.full((len(ends), 3), np.nan)
        for level, end in enumerate(ends):
            well = together[end - 1, mine]
            values = moved[end - steps : end, mine, 0 if what == "trunk" else 1].mean(0)[well]
            displacement[level] = with_interval(values)
        led[name] = Led(force, displacement, upright[ends - 1, mine].mean(1))
    return led
