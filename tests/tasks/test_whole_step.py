"""What a step was like throughout, on falling and landing robots."""

import math

import pytest
import torch

from op3.envs import make_env
from op3.robot import load_robot
from op3.robot.kinematics import key_points
from op3.tasks import find_task
from op3.tasks.addresses import Addresses

OP3 = load_robot("op3")


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


def test_a_pitched_foot_is_higher_at_its_heel():
    """A robot in the air that leans 0.2 rad forwards has heels higher than toes by the soles' length times its sine."""
    env, stand = drop(0.3)
    env._qpos[0, 3:7] = torch.tensor([math.cos(0.1), 0.0, math.sin(0.1), 0.0], dtype=torch.float64)
    env.simulation.batch.forward()
    env.step(_with(env, stand))
    seen = env._whole_step.result()
    foot = key_points(OP3.home, OP3).reshape(2, -1, 3)[0]
    length = foot[:, 0].max() - foot[:, 0].min()
    rise = float((seen.foot_rise - seen.foot_clearance)[0, 0])
    assert rise == pytest.approx(length * math.sin(0.2), rel=0.1)
    assert float(seen.foot_clearance.min()) < 0.001


def test_a_landing_escapes_a_single_look():
    """In some step of a landing the force has peaked at several times what is left of it at the step's end."""
    env, stand = drop(0.02)
    peaks, ends = [], []
    for _ in range(6):
        env.step(_with(env, stand))
        peaks.append(float(env._whole_step.result().peak_force))
        at = Addresses.find(env.simulation.batch.model, env.scene).foot_force
        ends.append(max(float(env.simulation.sensordata[0, foot : foot + 3].norm()) for foot in at))
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
    drawn = make_env(find_task("walk", {"gait.first_phase": None}), num_envs=8, seed=0)
    drawn.reset()
    assert len(set(drawn.mdp.phase.tolist())) == 8
    again = make_env(find_task("walk", {"gait.first_phase": None}), num_envs=8, seed=0)
    again.reset()
    assert torch.equal(drawn.mdp.phase, again.mdp.phase)
    fixed = make_env(find_task("walk", {"gait.first_phase": 0.25}), num_envs=8, seed=0)
    fixed.reset()
    assert set(fixed.mdp.phase.tolist()) == {0.25}


def test_practice_changes_the_reward_and_the_ground():
    """A bonus is paid per speed and reported beside the paper's terms; tiles grow with the next episodes."""
    env = make_env(find_task("walk_terrain", {"shaping.speed_bonus": {"weight": 0.0}}), num_envs=2, seed=0)
    env.set_terms(**{"shaping.speed_bonus.weight": 2.0, "events.terrain.height": 0.0})
    state, tiles = env.reset(), env.mdp.event("terrain")
    heights = [tiles._geom_pos[:, tiles._tiles, 2].max()]
    env._qvel[:, 0] = 0.1
    state["action"] = torch.from_numpy(env.action_map.stand()).float().expand(2, -1)
    after = env.step(state)["next"]
    velocity = torch.from_numpy(env._qvel[:, :1]).clamp(-0.3, 0.3)
    torch.testing.assert_close(after["reward_terms", "speed_bonus"], (2.0 * velocity).float())
    torch.testing.assert_close(after["reward"], sum(after["reward_terms"].values()))
    env.set_terms(**{"events.terrain.height": 0.01})
    env.reset()
    heights.append(tiles._geom_pos[:, tiles._tiles, 2].max())
    assert heights[1] - heights[0] > 0.005
    with pytest.raises(ValueError, match=r"the nearest is 'events\.terrain'"):
        env.set_terms(**{"events.terain.height": 0.01})
    with pytest.raises(ValueError, match=r"events\.terrain\.hight: unknown field; the nearest is 'height'"):
        env.set_terms(**{"events.terrain.hight": 0.01})


def test_who_stands_still_falls_behind():
    """An episode of standing ends once the robot is so far behind, and the next begins without what it lacked."""
    env = make_env(find_task("walk", {"terminations.lag": {"velocity": 0.3, "distance": 0.1}}), num_envs=1, seed=0)
    state, stand = env.reset(), torch.from_numpy(env.action_map.stand()).float()[None]
    for _ in range(20):
        state["action"] = stand
        state = env.step(state)["next"]
        if state["terminated"].item():
            break
    assert 8 <= env.mdp.steps.item() <= 13  # 0.3 m/s for 0.35 s are 0.1 m, and the body sways
    state = env.reset()
    state["action"] = stand
    assert not env.step(state)["next"]["terminated"].item()


def _with(env, action):
    state = env.fake_tensordict().select("observation")
    state["action"] = action
    return state
