"""Impulses at the trunk."""

import mujoco
import numpy as np
import torch

from op3.envs import BatchedEnv, make_env
from op3.tasks import find_task
from op3.tasks.pushes import DIRECTIONS, FIRST_PUSH, Push, Pushes


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
    env = make_env(find_task("walk", fall_height=0.0), num_envs=2, num_threads=1)
    state = env.begin({0: 0, 1: 0})
    env.simulation.batch.bind("qpos")[:, 2] += 5.0
    env.pushes = Pushes([Push.towards(0, 0.0, 0.064), Push.towards(3, 1.2, 0.064)])
    for _ in range(6):
        state["action"] = torch.from_numpy(env.action_map.stand()).float().expand(2, -1)
        state = env.step(state)["next"].exclude("reward")
    still, pushed = momentum(env, 0), momentum(env, 1)
    np.testing.assert_allclose(pushed - still, 1.2 * np.array([-(0.5**0.5), 0.5**0.5, 0.0]), atol=2e-3)


def test_pushes_are_drawn():
    """Of many seeds' pushes each has the size asked for, one of eight directions, and a time within the cycle."""
    pushes = [Push.draw(seed, 2.0, 1.0) for seed in range(200)]
    angles = np.array([np.arctan2(*push.impulse[::-1]) for push in pushes]) / (2 * np.pi / DIRECTIONS)
    np.testing.assert_allclose([np.hypot(*push.impulse) for push in pushes], 2.0)
    np.testing.assert_allclose(angles, np.rint(angles), atol=1e-9)
    assert len(np.unique(np.rint(angles) % DIRECTIONS)) == DIRECTIONS
    starts = np.array([push.start for push in pushes]) - FIRST_PUSH
    assert starts.min() < 0.05 < 0.95 < starts.max() <= 1.0
