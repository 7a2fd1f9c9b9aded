"""The batched environment: TorchRL's contract, determinism, independent robots, and its tasks' sanity."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from op3.envs import BatchedEnv, make_env
from op3.tasks.task import find_task, task_names


def roll(env: BatchedEnv, steps: int, seed: int = 0, start: TensorDict | None = None) -> TensorDict:
    """Steps with random actions near the stand, ``[step, env]``."""
    generator = torch.Generator().manual_seed(seed)
    stand = torch.from_numpy(env.action_map.stand()).float()
    state, seen = env.reset() if start is None else start, []
    for _ in range(steps):
        noise = 0.2 * torch.randn(env.num_envs, 20, generator=generator)
        state["action"] = (stand + noise).clamp(-1, 1)
        state = env.step(state)["next"]
        seen.append(state.clone())
        state = state.exclude("reward")
    return torch.stack(seen)


@pytest.mark.parametrize("name", task_names())
def test_specs(name):
    """Every task passes TorchRL's check of its specs."""
    check_env_specs(make_env(name, num_envs=2, num_threads=1), break_when_any_done="both")


def test_same_seed_same_bytes():
    """Two environments of one seed give equal bytes, another seed does not."""
    first, second, other = (roll(make_env("balance", num_envs=3, seed=s), 12) for s in (4, 4, 5))
    assert torch.equal(first["observation"], second["observation"])
    assert torch.equal(first["reward"], second["reward"])
    assert not torch.equal(first["observation"], other["observation"])


@pytest.mark.parametrize("name", ["balance", "walk_terrain"])
def test_partial_reset_leaves_others_alone(name):
    """Robots that are not reset go on to the last bit; the one that is reset begins a new episode."""
    touched, untouched = make_env(name, num_envs=3, seed=1), make_env(name, num_envs=3, seed=1)
    roll(touched, 6)
    roll(untouched, 6)
    mask = torch.tensor([False, True, False])[:, None]
    again = touched.reset(TensorDict({"_reset": mask}, [3]))
    assert touched.mdp.steps.tolist() == [6, 0, 6]
    after, expected = roll(touched, 6, 1, again), roll(untouched, 6, 1, again.clone())
    others = [0, 2]
    assert torch.equal(after["observation"][:, others], expected["observation"][:, others])
    assert torch.equal(after["reward"][:, others], expected["reward"][:, others])
    assert not torch.equal(after["observation"][:, 1], expected["observation"][:, 1])


def test_episodes_depend_on_seed_and_number_alone():
    """The second episode of a robot is the same, whenever the others were reset."""
    one, other = make_env("balance", num_envs=2, seed=3), make_env("balance", num_envs=2, seed=3)
    for env in (one, other):
        env.reset()
    for _ in range(2):
        other.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
    mask = TensorDict({"_reset": torch.tensor([[False], [True]])}, [2])
    assert torch.equal(one.reset(mask)["observation"][1], other.reset(mask)["observation"][1])
    assert one.episode_seeds[1] == other.episode_seeds[1]
    assert one.episode_seeds[0] != other.episode_seeds[0]


@pytest.mark.parametrize("backend", ["batched", "composer"])
def test_overload_joins_the_reward_where_it_has_a_weight(backend):
    """A jump into a crouch takes more current than a servo carries for long; by default the term is not there."""
    crouch = torch.zeros(1, 20)
    crouch[0, [1, 2, 3, 6, 7, 8]] = torch.tensor([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
    crouch[0, 10:] = 1.0
    seen = {}
    for weight in (0.0, 0.5):
        env = make_env(
            find_task("balance", {"shaping.overload": {"weight": weight} if weight else None}),
            backend=backend,
            num_envs=1,
        )
        state = env.reset()
        seen[weight] = [state := env.step(state.set("action", crouch))["next"] for _ in range(5)]
    assert not any("overload" in set(state["reward_terms"].keys()) for state in seen[0.0])
    costs = [state["reward_terms", "overload"].item() for state in seen[0.5]]
    assert -0.5 <= min(costs) < -0.1
    for cost, paid, free in zip(costs, seen[0.5], seen[0.0], strict=True):
        assert paid["reward"].item() == pytest.approx(free["reward"].item() + cost, abs=1e-6)


def test_models_differ_within_a_batch():
    """Parameters per robot: one with a weak motor sinks where its neighbour stands as the plain model does."""
    task = find_task("walk")
    weak = torch.tensor([0.006, 0.003])
    mixed = make_env(task, num_envs=2, parameters={"torque_constant": weak})
    plain = make_env(task, num_envs=2)
    seen, expected = roll(mixed, 10), roll(plain, 10)
    assert torch.equal(seen["observation"][:, 0], expected["observation"][:, 0])
    assert not torch.equal(seen["observation"][:, 1], expected["observation"][:, 1])


def test_randomisation_redraws_at_reset():
    """Every episode gets a robot from Table I's ranges; a robot that is not reset keeps its own."""
    env = make_env("balance", num_envs=3, randomisation="ranges")
    env.reset()
    first = {name: values.clone() for name, values in env.parameters_drawn.items()}
    env.reset(TensorDict({"_reset": torch.tensor([[True], [False], [False]])}, [3]))
    for name, values in env.parameters_drawn.items():
        low, high = env.model.parameters()[name].low, env.model.parameters()[name].high
        assert ((values >= low) & (values <= high)).all()
        assert values[0] != first[name][0]
        assert torch.equal(values[1:], first[name][1:])
        assert torch.equal(env.simulation.parameters[name][:, 0], values)


def test_hanging_time_limit_truncates():
    """A robot that stands until the time is over is truncated, not terminated."""
    env = make_env(find_task("walk", duration=0.32), num_envs=2)
    state = env.reset()
    for step in range(10):
        state["action"] = torch.from_numpy(env.action_map.stand()).float().expand(2, -1)
        state = env.step(state)["next"]
        assert state["truncated"].all() == (step == 9)
        assert not state["terminated"].any()
        assert torch.equal(state["done"], state["truncated"])
        state = state.exclude("reward")


def test_limp_robot_falls():
    """With the lowest gains the robot collapses, which terminates its episode."""
    env = make_env("walk", num_envs=2)
    state = env.reset()
    limp = torch.cat([torch.zeros(2, 10), -torch.ones(2, 10)], 1)
    for _ in range(100):
        state["action"] = limp
        state = env.step(state)["next"]
        if state["terminated"].all():
            break
        state = state.exclude("reward")
    assert state["terminated"].all()
    assert not state["truncated"].any()


def test_board_follows_its_motion():
    """Under a robot the board is where the motion of the episode's seed says, to 0.1 mrad."""
    env = make_env("balance", num_envs=2, seed=2)
    roll(env, 60)
    angle, _ = env.mdp.event("board")._stacked.at(env.mdp.time.numpy())
    np.testing.assert_allclose(env._qpos[:, [28, 27]], angle, atol=1e-4)
    assert np.abs(angle).max() > 0.01


def test_unknown_names_are_refused():
    """Unknown tasks and backends are named, with those there are."""
    with pytest.raises(ValueError, match=r"unknown task 'run'; there are balance,"):
        make_env("run")
    with pytest.raises(ValueError, match="model=sts3032: its servos accept no P gains"):
        make_env("balance", "sts3032", 1)
    with pytest.raises(ValueError, match="unknown backend"):
        make_env("balance", backend="gpu")


def test_diverged_robot_ends_its_episode():
    """A robot whose simulation diverges is terminated with finite numbers, and can be put down again."""
    env = make_env("balance", num_envs=2)
    state = env.reset()
    env._qvel[0, 10] = 1e13
    state["action"] = torch.zeros(2, 20)
    state = env.step(state)["next"]
    assert state["terminated"][:, 0].tolist() == [True, False]
    assert state["reward"][0].item() == 0.0
    assert torch.isfinite(state["observation"]).all()
    again = env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
    again["action"] = torch.zeros(2, 20)
    after = env.step(again)["next"]
    assert not after["terminated"].any()
    assert torch.isfinite(after["observation"]).all()
    assert after["reward"][0].item() != 0.0


def test_scaled_gains():
    """All P and D gains that reach the servos are scaled, from the first tick on; targets are not."""
    nominal, weak = (make_env("walk", num_envs=1, num_threads=1, gain_scale=scale) for scale in (1.0, 0.8))
    for env in (nominal, weak):
        roll(env, 1)
    for name, factor in (("p_gain", 0.8), ("d_gain", 0.8), ("position_target", 1.0)):
        expected = factor * getattr(nominal.simulation.signals, name)
        torch.testing.assert_close(getattr(weak.simulation.signals, name), expected)
    with pytest.raises(ValueError, match="gain_scale must be a number above 0"):
        make_env("walk", num_envs=1, gain_scale=0.0)
