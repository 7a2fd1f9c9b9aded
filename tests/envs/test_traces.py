"""Touchdowns, and what is seen every millisecond."""

import numpy as np
import torch

from op3.envs import make_env
from op3.envs.step_traces import StepWatch, touchdowns
from op3.robot.register_units import GRAVITY


def test_touchdowns_of_a_scripted_contact():
    """Two landings after swings of 300 ms; a bounce of 20 ms and a graze below 5 N are none."""
    force = np.full(2000, 20.0)
    force[400:700] = 0.0
    force[720:740] = 0.0  # bounces after the landing at 700
    force[1200:1500] = 0.0
    force[1300:1310] = 3.0  # grazes in mid-swing
    assert touchdowns(force).tolist() == [700, 1500]
    assert touchdowns(np.full(100, 20.0)).tolist() == []


def test_a_standing_robot():
    """Held at the stand pose the feet carry the robot's weight, the trunk is at rest, and soles are on the floor."""
    env = make_env("walk", num_envs=2, num_threads=1)
    watch, state = StepWatch(env), env.reset()
    with watch.watching():
        for _ in range(25):
            state["action"] = torch.from_numpy(env.action_map.stand()).float().expand(2, -1)
            state = env.step(state)["next"].exclude("reward")
    traces = watch.traces()
    weight = GRAVITY * env.simulation.batch.get_model(0).body_subtreemass[0]
    assert traces.force.shape == (25 * 32, 2, 2)
    np.testing.assert_allclose(traces.force[-200:].sum(-1).mean(0), weight, rtol=0.02)
    assert traces.acceleration[-200:].mean() < 0.5
    assert np.abs(traces.sole[-1]).max() < 0.002
