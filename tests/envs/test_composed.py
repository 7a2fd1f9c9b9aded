"""The composer environment is the batched one's twin."""

import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

from op3.envs import make_env
from op3.servo import catalogue
from op3.sim import load_model


def play(env, steps: int) -> list:
    generator = torch.Generator().manual_seed(7)
    stand = torch.from_numpy(env.action_map.stand()).float()
    state, seen = env.reset(), []
    for _ in range(steps):
        state["action"] = (stand + 0.1 * torch.randn(1, 20, generator=generator)).clamp(-1, 1)
        state = env.step(state)["next"]
        seen.append(state)
        if state["done"]:
            break
        state = state.exclude("reward")
    return seen


@pytest.mark.parametrize("name", ["balance", "balance_weight", "walk_terrain", "walk_bricks_d", "walk_push"])
def test_twins_agree(name):
    """The same actions give the same observations, rewards and ends through composer and through the batch."""
    envs = [make_env(name, num_envs=1, seed=3, backend=b) for b in ("composer", "batched")]
    composed, batched = (play(env, 20) for env in envs)
    position = [servos.signals.position for servos in (envs[0].composer_task.servos, envs[1].simulation)]
    torch.testing.assert_close(*position, rtol=0, atol=1e-9)
    for one, other in zip(composed, batched, strict=True):
        # float32 of trajectories that agree to rounding; a count of a quantised sensor may fall either way
        torch.testing.assert_close(one["observation"], other["observation"], rtol=0, atol=1e-6)
        torch.testing.assert_close(one["reward"], other["reward"], rtol=0, atol=1e-6)
        assert torch.equal(one["terminated"], other["terminated"])


def test_twins_agree_with_all_kinds_of_effects():
    """Effects that remember, edit the model, or change sensors and ground act alike in both."""
    model = load_model("paper")
    for name in ("backlash", "velocity_filter", "voltage_sag", "encoder_offset", "imu_mount", "foot_friction"):
        effect = catalogue()[name]()
        own = {p.name for p in effect.parameters}
        model = model.with_effect(effect, {n: v for n, v in effect.secants[0].items() if n in own})
    composed, batched = (
        play(make_env("balance", model, num_envs=1, seed=3, backend=b), 10) for b in ("composer", "batched")
    )
    plain = play(make_env("balance", num_envs=1, seed=3), 10)
    for one, other in zip(composed, batched, strict=True):
        torch.testing.assert_close(one["observation"], other["observation"], rtol=0, atol=1e-5)
        torch.testing.assert_close(one["reward"], other["reward"], rtol=0, atol=1e-5)
    assert (batched[-1]["observation"] - plain[-1]["observation"]).abs().max() > 1e-2


def test_specs():
    """It passes TorchRL's check of its specs."""
    check_env_specs(make_env("walk", backend="composer"))


def test_composer_shows_what_the_policy_sees():
    """A time step of dm_control has the observation that the TorchRL environment gives, from the first one on."""
    env = make_env("walk", backend="composer", seed=4)
    (spec,) = env.composer.observation_spec().values()
    assert spec.shape == (256,)
    state, action = env.reset(), env.action_map.stand()
    step = env.composer.reset()
    for _ in range(4):
        assert np.abs(step.observation["observation"]).max() > 0.1
        assert np.array_equal(step.observation["observation"], env.composer_task.observation[0].numpy())
        step = env.composer.step(action)
    assert state["observation"].shape == (1, 256)


def test_diverged_robot_ends_its_episode():
    """As in the batch, a robot whose simulation diverges is terminated with finite numbers, and can begin again."""
    env = make_env("balance", backend="composer")
    state = env.reset()
    env.composer.physics.data.qvel[10] = 1e13
    state["action"] = torch.zeros(1, 20)
    after = env.step(state)["next"]
    assert after["terminated"].all()
    assert after["reward"].item() == 0.0
    assert torch.isfinite(after["observation"]).all()
    again = env.reset()
    again["action"] = torch.zeros(1, 20)
    assert not env.step(again)["next"]["terminated"].any()


def test_one_robot_only():
    """More robots, or drawn ones, are refused with the backend that has them."""
    with pytest.raises(ValueError, match="use backend='batched'"):
        make_env("walk", backend="composer", num_envs=2)
    with pytest.raises(ValueError, match="use backend='batched'"):
        make_env("walk", backend="composer", randomisation="ranges")
