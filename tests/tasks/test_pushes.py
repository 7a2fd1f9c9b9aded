"""Impulses at the trunk."""

import mujoco
import numpy as np
import torch

from op3.common.settings import CONTROL_PERIOD
from op3.envs import BatchedEnv, make_env
from op3.tasks import find_task
from op3.tasks.episodes import Episodes
from op3.tasks.events import Pushing
from op3.tasks.pushes import DIRECTIONS, FIRST_PUSH, PUSH_DURATION, Push


def momentum(env: BatchedEnv, robot: int) -> np.ndarray:
    """Of a robot, [3] in N s."""
    batch = env.simulation.batch
    model = batch.get_model(robot)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = batch.bind("qpos")[robot], batch.bind("qvel")[robot]
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    return model.body_subtreemass[0] * data.subtree_linvel[0]


def test_a_push_is_its_impulse():
    """Two robots fall freely, one of them pushed: their momenta differ by the impulse afterwards."""
    task = find_task("walk", {"terminations.height": None, "events.pushing": {"impulse": 0.0}})
    env = make_env(task, num_envs=2, num_threads=1)
    state = env.begin({0: 0, 1: 0})
    env.simulation.batch.bind("qpos")[:, 2] += 5.0
    env.mdp.event("pushing").replace(np.arange(2), [Push.towards(0, 0.0, 0.064), Push.towards(3, 1.2, 0.064)])
    for _ in range(6):
        state["action"] = torch.from_numpy(env.action_map.stand()).float().expand(2, -1)
        state = env.step(state)["next"].exclude("reward")
    still, pushed = momentum(env, 0), momentum(env, 1)
    np.testing.assert_allclose(pushed - still, 1.2 * np.array([-(0.5**0.5), 0.5**0.5, 0.0]), atol=2e-3)


def test_pushes_are_drawn():
    """Of many seeds' pushes each has the size asked for, one of eight directions, and a time within the cycle."""
    count = 200
    event = Pushing(num_envs=count, duration=10.0, gait_cycle=1.0, impulse=2.0)
    nothing = np.zeros((count, 0))
    event.begin(Episodes(np.arange(count), np.arange(count), nothing, nothing))
    ticks = np.arange(round(10.0 / CONTROL_PERIOD)) * CONTROL_PERIOD
    force = np.stack([event._pushes[0].force(np.full(count, time)) for time in ticks])
    impulse = CONTROL_PERIOD * force.sum(0)
    angles = np.arctan2(impulse[:, 1], impulse[:, 0]) / (2 * np.pi / DIRECTIONS)
    np.testing.assert_allclose(np.linalg.norm(impulse, axis=1), 2.0)
    np.testing.assert_allclose(angles, np.rint(angles), atol=1e-9)
    assert len(np.unique(np.rint(angles) % DIRECTIONS)) == DIRECTIONS
    starts = ticks[np.argmax(np.abs(force).max(2) > 0, axis=0)] - FIRST_PUSH
    assert starts.min() < 0.05 < 0.95 < starts.max() <= 1.0


def test_pushes_again_and_again():
    """With a time between pushes an episode of ten seconds has several, each of another size up to the largest."""
    event = Pushing(num_envs=3, duration=10.0, gait_cycle=None, impulse=1.0, every=2.0, uniform=True)
    nothing = np.zeros((3, 0))
    event.begin(Episodes(np.arange(3), np.arange(3), nothing, nothing))
    ticks = np.arange(round(10.0 / CONTROL_PERIOD)) * CONTROL_PERIOD
    sizes = [[np.linalg.norm(p.force(np.full(3, t)), axis=1).max() for t in ticks] for p in event._pushes]
    largest = np.max(sizes, axis=1) * PUSH_DURATION
    assert len(largest) == 4
    assert len(set(largest)) == 4
    assert largest.max() <= 1.0
