"""Validity of gaits: scripted traces, and a robot that touches itself beside distances measured apart from it."""

import numpy as np
import pytest
import torch

from op3.envs import make_env
from op3.envs.gait_validity import gait_validity, judged_episodes
from op3.envs.step_traces import StepWatch
from op3.tasks import find_task
from tests.envs.scripted import still
from tests.op3_table import CONTROLLED_JOINTS
from tests.self_collision import PartDistances

STEPS = 5000
"""Of 1 ms in a scripted episode."""


def test_a_scripted_gait():
    """Two swings: clearances 4 and 10 mm, width 80 mm across a heading of 30 degrees, 0.9 of the time on both feet."""
    force, sole = np.full((STEPS, 1, 2), 16.0), np.zeros((STEPS, 1, 2))
    force[2000:2200, 0, 0], force[3000:3150, 0, 1] = 0.0, 0.0
    sole[2000:2200, 0, 0] = 0.004
    # from the floor to a tile of 5 mm: the peak at 15 mm is 10 mm above it
    sole[3000:3150, 0, 1], sole[3150:, 0, 1] = 0.015, 0.005
    yaw = np.full((STEPS, 1), np.pi / 6)
    across, along = np.array([-np.sin(np.pi / 6), np.cos(np.pi / 6)]), np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    centre = np.zeros((STEPS, 1, 2, 2))
    centre[:, 0, 0] = 0.08 * across + 0.3 * along
    found = gait_validity(still(STEPS, force=force, sole=sole, yaw=yaw, centre=centre), np.array([STEPS]))
    assert found.clearance == pytest.approx(0.007, abs=1e-6)  # the median of 4 and 10
    assert found.step_width == pytest.approx(0.08, abs=1e-6)
    assert found.double_support == pytest.approx(1 - 350 / 3500)
    assert (found.self_contact, found.penetration, found.yaw_drift) == (0.0, 0.0, pytest.approx(0.0, abs=1e-9))


def test_a_scripted_drift_slip_and_touch():
    """Half a turn across the seam of the heading in 3.5 s; loaded feet slip, others do not count; 1 % of touches."""
    yaw = np.linspace(0.0, np.pi, STEPS - 1500) + 2.0
    yaw = np.concatenate([np.full(1500, 2.0), np.remainder(yaw + np.pi, 2 * np.pi) - np.pi])[:, None]
    force, slip, penetration = np.zeros((STEPS, 1, 2)), np.full((STEPS, 1, 2), 0.3), np.zeros((STEPS, 1))
    force[:, :, 0], slip[:, :, 0] = 30.0, 0.02
    penetration[:50], penetration[4000:] = 0.0015, 0.004  # the episode is over before the second
    found = gait_validity(still(STEPS, yaw=yaw, force=force, slip=slip, penetration=penetration), np.array([STEPS]))
    assert found.yaw_drift == pytest.approx(np.pi / 3.5, rel=1e-3)
    assert found.foot_slip == pytest.approx(0.02)
    assert found.self_contact == pytest.approx(1050 / STEPS)
    cut = gait_validity(still(STEPS, yaw=yaw, penetration=penetration, force=force, slip=slip), np.array([4000]))
    assert (cut.self_contact, cut.penetration) == (pytest.approx(0.0125), pytest.approx(0.0015))
    assert (cut.clearance, cut.step_width, cut.double_support) == (None, None, None)


def test_penetration_is_that_of_the_shapes():
    """Robots that press their feet together: contact and depth of each step are those of `mj_geomDistance`."""
    env = make_env("walk", num_envs=2, seed=1, num_threads=1)
    state, watch, distances = env.reset(), StepWatch(env), PartDistances()
    action = torch.from_numpy(env.action_map.stand()).float().repeat(2, 1)
    for joint, inwards in (("l_hip_roll", 1.0), ("r_hip_roll", -1.0)):
        action[:, CONTROLLED_JOINTS.index(joint)] = inwards
    qpos, angles = env.simulation.batch.bind("qpos"), []
    env.simulation.on_step, before = lambda: (before(), angles.append(qpos[:, 7:27].copy())), env.simulation.on_step
    with watch.watching():
        for _ in range(8):
            state["action"] = action
            state = env.step(state)["next"].exclude("reward")
    # contacts of a step are those of the pose before it
    gaps = np.array([[distances.least(pose) for pose in poses] for poses in angles])[:-1]
    seen = watch.traces().penetration[1:]
    assert (gaps < -1e-4).any()
    assert (gaps > 1e-3).any()
    np.testing.assert_allclose(seen, np.maximum(-gaps, 0.0), atol=2e-5)
    found = gait_validity(watch.traces(), np.array([256, 256]))
    assert found.penetration == pytest.approx(-gaps.min(), abs=2e-5)
    assert found.self_contact == pytest.approx((gaps < 0).mean(), abs=0.02)


def test_a_robot_without_feet_has_no_gait():
    """An arm that holds: it does not touch itself, and what is of feet is absent."""
    env = make_env(find_task("reach", duration=0.2), "own", 2, num_threads=1)
    action = torch.from_numpy(env.action_map.stand())
    logs, found = judged_episodes(env, lambda observation: action.expand(len(observation), -1))
    assert len(logs) == 2
    assert (found.self_contact, found.penetration) == (0.0, 0.0)
    assert (found.clearance, found.step_width, found.double_support, found.foot_slip) == (None,) * 4
