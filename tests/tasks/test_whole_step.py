"""What a step was like throughout, on falling and landing robots."""

import math

import pytest
import torch

from op3.envs import make_env
from op3.tasks import find_task


def drop(height: float):
    """A robot lifted by `height` m and let go."""
    env = make_env("walk", num_envs=1, seed=0)
    env.reset()
    env._qvel[:] = 0.0
    env._qpos[0, 2] += height
    env.simulation.batch.forward()
    stand = torch.from_numpy(env.action_map.stand()).float()[None]
    return env, stand


def test_a_falling_robot_feels_nothing_and_its_feet_move():
    """In free fall the body accelerates with g, the feet carry next to nothing and move with g t on average."""
    env, stand = drop(0.3)
    env.step(_with(env, stand))
    seen = env._whole_step.result()
    assert float(seen.acceleration) == pytest.approx(9.81, abs=0.5)
    assert float(seen.foot_force.max()) < 2.0
    # after 32 ms of fall the mean speed is half of g t, and the looks lag by a millisecond
    assert seen.foot_speed[0].tolist() == pytest.approx([9.81 * 0.032 / 2] * 2, rel=0.1)


def test_a_landing_escapes_a_single_look():
    """In some step of a landing the force has peaked at several times what is left of it at the step's end."""
    env, stand = drop(0.02)
    peaks, ends = [], []
    for _ in range(6):
        env.step(_with(env, stand))
        peaks.append(float(env._whole_step.result().peak_force))
        ends.append(float(env.snapshot().foot_force.max()))
    assert max(peak / end for peak, end in zip(peaks, ends, strict=True) if peak > 50) > 3


def test_the_single_look_is_an_option():
    """With `whole_step=False` the reward of a landing is another."""
    rewards = []
    for whole in (True, False):
        env = make_env(find_task("walk", whole_step=whole), num_envs=1, seed=0)
        state = env.reset()
        env._qpos[0, 2] += 0.02
        env.simulation.batch.forward()
        total = 0.0
        for _ in range(6):
            state["action"] = torch.from_numpy(env.action_map.stand()).float()[None]
            state = env.step(state)["next"]
            total += float(state["reward"])
            state = state.exclude("reward")
        rewards.append(total)
    assert math.isfinite(rewards[0])
    assert abs(rewards[0] - rewards[1]) > 0.05


def test_the_phase_is_drawn_where_asked():
    """Without a first phase each episode has its own, by its seed; otherwise all begin there."""
    drawn = make_env(find_task("walk", first_phase=None), num_envs=8, seed=0)
    drawn.reset()
    assert len(set(drawn.rules.first_phase.tolist())) == 8
    again = make_env(find_task("walk", first_phase=None), num_envs=8, seed=0)
    again.reset()
    assert torch.equal(drawn.rules.first_phase, again.rules.first_phase)
    fixed = make_env(find_task("walk", first_phase=0.25), num_envs=8, seed=0)
    fixed.reset()
    assert set(fixed.rules.first_phase.tolist()) == {0.25}


def test_practice_changes_the_reward_and_the_ground():
    """A bonus is paid per speed and reported beside the paper's terms; tiles grow with the next episodes."""
    env = make_env("walk_terrain", num_envs=2, seed=0)
    env.practise(speed_bonus=2.0, terrain_height=0.0)
    state = env.reset()
    assert env._beginnings[0].tiles.max() == 0.0
    env._qvel[:, 0] = 0.1
    state["action"] = torch.from_numpy(env.action_map.stand()).float().expand(2, -1)
    after = env.step(state)["next"]
    velocity = torch.from_numpy(env._qvel[:, :1]).clamp(-0.3, 0.3)
    torch.testing.assert_close(after["reward_terms", "speed_bonus"], (2.0 * velocity).float())
    total = 1.0 + sum(after["reward_terms"].values())
    torch.testing.assert_close(after["reward"], total)
    env.practise(terrain_height=0.01)
    env.reset()
    assert env._beginnings[0].tiles.max() > 0.005


def test_who_stands_still_falls_behind():
    """An episode of standing ends once the robot is so far behind, and the next begins without what it lacked."""
    env = make_env("walk", num_envs=1, seed=0)
    env.practise(largest_lag=0.1)
    state, stand = env.reset(), torch.from_numpy(env.action_map.stand()).float()[None]
    for _ in range(20):
        state["action"] = stand
        state = env.step(state)["next"]
        if state["terminated"].item():
            break
    assert 8 <= env.rules.steps.item() <= 13  # 0.3 m/s for 0.35 s are 0.1 m, and the body sways
    state = env.reset()
    state["action"] = stand
    assert not env.step(state)["next"]["terminated"].item()


def _with(env, action):
    state = env.fake_tensordict().select("observation")
    state["action"] = action
    return state
