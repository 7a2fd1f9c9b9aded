"""Search for the numbers of a walk by CMA-ES, every robot of a batch trying its own."""

import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from cmaes import CMA
from numpy.typing import NDArray

from op3.envs.batched import BatchedEnv
from op3.tasks import PhasedWalk, Stride

Array = NDArray[np.float64]

_FEEDBACK = (
    "stance_hip_roll",
    "swing_hip_roll",
    "stance_ankle_roll",
    "stance_hip_pitch",
    "swing_hip_pitch",
    "stance_ankle_pitch",
)

SCALES: dict[str, float] = {
    "step": 0.02,
    "lift": 0.012,
    "swing_start": 0.05,
    "swing_share": 0.05,
    "crouch": 0.01,
    "forward": 0.01,
    "sideways": 0.007,
    "lean": 0.06,
    "sway": 0.012,
    "sway_phase": 0.5,
    "sway_third": 0.1,
    "surge": 0.006,
    "surge_phase": 1.5,
    "bob": 0.004,
    "bob_phase": 1.5,
    "hip_roll": 0.04,
    **{f"{place}{rate}": size for place in _FEEDBACK for rate, size in (("", 0.15), ("_rate", 0.03))},
}
"""By how much a number is varied at first, in its unit; gains stay at their highest."""

BOUNDS: dict[str, tuple[float, float]] = {
    "step": (0.0, 0.12),
    "lift": (0.005, 0.07),
    "swing_share": (0.15, 0.45),
    "crouch": (0.005, 0.06),
    "sway": (0.0, 0.06),
}
"""Where a number may lie."""


@dataclasses.dataclass(frozen=True)
class Generation:
    """What a generation of the search found.

    Attributes:
        mean: numbers in the middle of the generation.
        score: of each candidate, [candidate].
        upright: share of candidates that did not fall.
        speed: mean forward speed [m/s] until the fall or the end.
    """

    mean: Stride
    score: Array
    upright: float
    speed: float


def search(
    env: BatchedEnv,
    start: Stride,
    generations: int,
    *,
    noise: float = 0.0,
    speed_weight: float = 0.2,
    spread: float = 0.5,
    seed: int = 0,
    say: Callable[[Generation], None] = lambda generation: None,
) -> Stride:
    """CMA-ES on the return of the task plus a bonus for speed.

    Args:
        env: walking robots, one per candidate; every generation meets new beginnings.
        start: numbers to begin with.
        generations: how many.
        noise: standard deviation of noise on all actions, against which the walk must hold.
        speed_weight: bonus per second of an episode for walking at the task's speed or faster, in proportion below.
        spread: of the first generation, in multiples of `SCALES`.
        seed: of everything random.
        say: takes each generation.

    Returns:
        The middle of the last generation.
    """
    origin = np.array([getattr(start, name) for name in SCALES])
    optimiser = CMA(np.zeros(len(SCALES)), spread, seed=seed, population_size=env.num_envs)
    generator = torch.Generator().manual_seed(seed)
    mean = start
    for number in range(generations):
        asked = [optimiser.ask() for _ in range(env.num_envs)]
        candidates = _stride(origin, np.stack(asked, -1), start)
        env.set_seed(seed + number)
        gained, upright, speed = _play(env, PhasedWalk(candidates, env.action_map), noise, generator)
        share = np.minimum(speed / env.task.desired_velocity[0], 1.0)
        score = gained + speed_weight * env.task.steps * share
        optimiser.tell([(point, -float(value)) for point, value in zip(asked, score, strict=True)])
        mean = _stride(origin, optimiser.mean, start)
        say(Generation(mean, score, float(upright.mean()), float(speed.mean())))
    return mean


def _stride(origin: Array, point: Array, start: Stride) -> Stride:
    """Numbers of points [number] or [number, candidate] of the search."""
    values = {}
    for name, scale, middle, value in zip(SCALES, SCALES.values(), origin, point, strict=True):
        low, high = BOUNDS.get(name, (-np.inf, np.inf))
        values[name] = np.clip(middle + scale * value, low, high)
    return dataclasses.replace(start, **values)


def _play(
    env: BatchedEnv, walk: PhasedWalk, noise: float, generator: torch.Generator
) -> tuple[Array, NDArray[np.bool_], Array]:
    """One episode of each robot: return, whether it stayed upright, and its speed over the whole duration [m/s]."""
    state = env.reset()
    positions = env.simulation.batch.bind("qpos")
    first, last = np.array(positions[:, 0]), np.array(positions[:, 0])
    gained, running = np.zeros(env.num_envs), np.ones(env.num_envs, dtype=bool)
    fallen = np.zeros(env.num_envs, dtype=bool)
    while running.any():
        action = walk.act(state["observation"])
        action = action + noise * torch.randn(action.shape, generator=generator)
        state["action"] = action.clamp(-1.0, 1.0)
        after = env.step(state)["next"]
        gained += running * after["reward"][:, 0].numpy()
        last = np.where(running, positions[:, 0], last)
        fallen |= running & after["terminated"][:, 0].numpy()
        running &= ~after["done"][:, 0].numpy()
        state = after.exclude("reward")
    return gained, ~fallen, (last - first) / env.task.duration
