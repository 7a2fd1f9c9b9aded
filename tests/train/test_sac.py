"""Networks, losses and replay against independent computations."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

from op3.policy import ActionMap, Manifest
from op3.train import SAC, Batch, ReplayBuffer, SACSettings
from op3.train.networks import Actor, TwinCritics
from op3.train.normaliser import Normaliser


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_log_probability_is_that_of_the_squashed_gaussian():
    """The one-pass log-probability equals that of torch's transformed distribution."""
    actor = Actor(5, 3, (16,), generator(), initial_std=0.7).double()
    observation = torch.randn(50, 5, generator=generator(1), dtype=torch.float64)
    noise = torch.randn(50, 3, generator=generator(2), dtype=torch.float64)
    action, log_prob = actor.sample(observation, noise)
    mean, log_std = actor(observation)
    squashed = TransformedDistribution(Independent(Normal(mean, log_std.exp()), 1), TanhTransform(cache_size=1))
    torch.testing.assert_close(log_prob, squashed.log_prob(action.clamp(-1 + 1e-12, 1 - 1e-12)), rtol=1e-6, atol=1e-6)


def test_untrained_policy_is_the_initial_action():
    """Whatever it sees, the untrained policy's mean is within 0.05 of the initial action, with the initial spread."""
    wanted = torch.tensor([0.0, 0.5, -0.9])
    actor = Actor(5, 3, (64, 64), generator(), wanted, initial_std=0.2)
    mean, log_std = actor(torch.randn(100, 5, generator=generator(1)))
    assert float((torch.tanh(mean.detach()) - wanted).abs().max()) < 0.05
    torch.testing.assert_close(log_std.exp(), torch.full_like(mean, 0.2), rtol=0.1, atol=0)


def test_exploration_is_bounded():
    """However the weights ask for it, the standard deviation stays at `largest_std`."""
    actor = Actor(5, 3, (16,), generator(), initial_std=0.02, largest_std=0.03)
    with torch.no_grad():
        actor.biases[-1][3:] = 2.0
    _, log_std = actor(torch.randn(10, 5, generator=generator(1)))
    torch.testing.assert_close(log_std.exp(), torch.full((10, 3), 0.03))
    with pytest.raises(ValueError, match="largest_std must be above"):
        SACSettings(largest_std=0.001)


@pytest.mark.parametrize("layer_norm", [False, True])
def test_twin_critics_equal_two_networks(layer_norm):
    """The batched product equals two networks of torch.nn layers with the same weights."""
    critics = TwinCritics(5, 3, (16, 8), generator(), layer_norm)
    observation, action = torch.randn(10, 5, generator=generator(1)), torch.randn(10, 3, generator=generator(2))
    values = critics(observation, action)
    for number in range(2):
        layers = []
        for weight, bias in zip(critics.weights, critics.biases, strict=True):
            linear = torch.nn.Linear(*weight.shape[1:])
            linear.weight.data, linear.bias.data = weight[number].t(), bias[number, 0]
            norm = [torch.nn.LayerNorm(weight.shape[-1])] if layer_norm else []
            layers += [linear, *norm, torch.nn.ReLU()]
        network = torch.nn.Sequential(*layers[: -1 - layer_norm])
        expected = network(torch.cat([observation, action], -1))[:, 0]
        torch.testing.assert_close(values[number], expected, rtol=1e-5, atol=1e-6)


def test_bfloat16_critics_are_close():
    """Critics in bfloat16 (8 bits of mantissa) differ by under 3 % of the values' spread; weights stay float32."""
    exact = TwinCritics(20, 4, (64, 64), generator())
    rough = TwinCritics(20, 4, (64, 64), generator(), dtype=torch.bfloat16)
    inputs = torch.randn(200, 20, generator=generator(1)), torch.randn(200, 4, generator=generator(2))
    values = exact(*inputs).detach()
    assert float((rough(*inputs).detach() - values).abs().mean()) < 0.03 * float(values.std())
    assert all(parameter.dtype == torch.float32 for parameter in rough.parameters())


@pytest.mark.parametrize(("asked", "able", "gets"), [(None, True, True), (None, False, False), (True, False, True)])
def test_bfloat16_is_taken_where_the_processor_is_fast_at_it(monkeypatch, asked, able, gets):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": able, "amx_bf16": False})
    critics = SAC(6, 2, SACSettings(hidden=(8, 8), bfloat16=asked), generator()).critics
    assert critics.dtype == (torch.bfloat16 if gets else torch.float32)


def plain_update(sac: SAC, batch: Batch, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Gradients of SAC written out with torch.distributions; gamma and alpha as in Haarnoja et al. 2018."""

    def distribution(observation):
        mean, log_std = sac.actor(observation)
        return Independent(Normal(mean, log_std.exp()), 1), mean, log_std.exp()

    def sample(observation, noise):
        _, mean, std = distribution(observation)
        raw = mean + std * noise
        log_prob = (Normal(mean, std).log_prob(raw) - torch.log(1 - torch.tanh(raw) ** 2)).sum(-1)
        return torch.tanh(raw), log_prob

    alpha = sac.log_temperature.exp().detach()
    with torch.no_grad():
        action, log_prob = sample(batch.next_observation, noise[0])
        value = torch.minimum(*sac.targets(batch.next_observation, action)) - alpha * log_prob
        target = batch.reward + batch.discount * value
    first, second = sac.critics(batch.observation, batch.action)
    critic_loss = 0.5 * ((first - target) ** 2).mean() + 0.5 * ((second - target) ** 2).mean()
    action, log_prob = sample(batch.observation, noise[1])
    actor_loss = (alpha * log_prob - torch.minimum(*sac.critics(batch.observation, action))).mean()
    temperature_gradient = float(-(log_prob + sac.settings.target_entropy * sac.action_size).mean())
    return critic_loss, actor_loss, temperature_gradient


def test_losses_are_those_of_soft_actor_critic():
    """Losses and their gradients equal those of SAC written out plainly with torch.distributions."""
    sac = SAC(4, 2, SACSettings(hidden=(16, 16), initial_temperature=0.3), generator())
    g = generator(5)
    batch = Batch(
        torch.randn(32, 4, generator=g),
        torch.rand(32, 2, generator=g) * 2 - 1,
        torch.randn(32, generator=g),
        torch.full((32,), 0.9),
        torch.randn(32, 4, generator=g),
    )
    noise = torch.randn(2, 32, 2, generator=g)
    critic_loss, actor_loss, temperature = plain_update(sac, batch, noise)
    with torch.no_grad():
        target = sac._target(batch.next_observation, batch.reward, batch.discount, noise[0])
    ours, _ = sac._critic_loss(batch.observation, batch.action, target)
    torch.testing.assert_close(ours, critic_loss, rtol=1e-5, atol=1e-6)
    gradients = torch.autograd.grad(sac._actor_loss(batch.observation, noise[1])[0], sac._policy_parameters)
    expected = torch.autograd.grad(actor_loss, list(sac.actor.parameters()))
    for first, second in zip(gradients[:-1], expected, strict=True):
        torch.testing.assert_close(first, second, rtol=1e-4, atol=1e-6)
    # d/d log(alpha) of log(alpha) (entropy - wanted)
    assert float(gradients[-1]) == pytest.approx(temperature, rel=1e-4)


def test_critics_find_the_value_of_a_known_chain():
    """With reward 1, discount 0.5 and termination half of the time, Q converges to 1 / (1 - 0.25) = 1.333."""
    settings = SACSettings(hidden=(16,), critic_rate=3e-3, initial_temperature=1e-6, target_rate=0.05)
    sac = SAC(2, 2, settings, generator())
    batch = Batch(
        torch.zeros(64, 2), torch.zeros(64, 2), torch.ones(64), torch.tensor([0.5, 0.0] * 32), torch.zeros(64, 2)
    )
    for _ in range(600):
        measures = sac.update(batch._replace(action=torch.rand(64, 2, generator=sac.generator) * 2 - 1))
    # the mean of 1 + 0.5 Q and 1 + 0 Q is 1 + 0.25 Q
    assert float(measures["value"]) == pytest.approx(1.0 / 0.75, abs=0.05)


def test_target_critics_follow_by_their_rate():
    """After one update the targets have moved 10 % of the way to the critics."""
    sac = SAC(2, 2, SACSettings(hidden=(8,), target_rate=0.1), generator())
    before = [target.clone() for target in sac.targets.parameters()]
    sac.update(Batch(torch.zeros(4, 2), torch.zeros(4, 2), torch.ones(4), torch.zeros(4), torch.zeros(4, 2)))
    for old, new, critic in zip(before, sac.targets.parameters(), sac.critics.parameters(), strict=True):
        torch.testing.assert_close(new, old + 0.1 * (critic.detach() - old))


def naive_return(replay: ReplayBuffer, row: int, env: int, steps: int, discount: float) -> tuple[float, float, int]:
    """Return, discount of what follows, and last row, by a loop."""
    total, last = 0.0, row
    for number in range(steps):
        last = (row + number) % replay.rows
        total += discount**number * float(replay.reward[last, env])
        if bool(replay.done[last, env]):
            return total, 0.0 if bool(replay.terminated[last, env]) else discount ** (number + 1), last
    return total, discount**steps, last


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 4), st.integers(1, 40), st.integers(1, 7), st.integers(0, 1000))
def test_n_step_returns(steps, rows, chunk, seed):
    """Returns, discounts and last observations equal a plain loop's, over ends of episodes and of the ring."""
    g = generator(seed)
    replay = ReplayBuffer(48, 3, 2, 1)
    written = 0
    while written < max(rows, steps):
        terminated = torch.rand(chunk, 3, generator=g) < 0.15
        done = terminated | (torch.rand(chunk, 3, generator=g) < 0.1)
        # each row is marked by its number and its environment
        mark = torch.stack(
            torch.broadcast_tensors(torch.arange(written, written + chunk)[:, None], torch.arange(3)), -1
        )
        reward = torch.randn(chunk, 3, generator=g)
        replay.extend(mark.float(), torch.zeros(chunk, 3, 1), reward, mark.float() + 0.5, terminated, done)
        written += chunk
    batch = replay.sample(64, steps, 0.9, g)
    for number in range(64):
        step, env = (int(value) for value in batch.observation[number])
        assert max(0, written - replay.rows) <= step <= written - steps
        total, scale, last = naive_return(replay, step % replay.rows, env, steps, 0.9)
        assert float(batch.reward[number]) == pytest.approx(total, abs=1e-5)
        assert float(batch.discount[number]) == pytest.approx(scale, abs=1e-6)
        assert torch.equal(batch.next_observation[number], replay.next_observation[last, env])


def test_cut_ends_episodes_by_time():
    """After `cut` a return does not reach over the restart, and still bootstraps."""
    replay = ReplayBuffer(10, 1, 1, 1)
    flags = torch.zeros(2, 1, dtype=torch.bool)
    one = torch.ones(2, 1, 1)
    replay.extend(one, one, torch.ones(2, 1), one, flags, flags)
    replay.cut()
    replay.extend(2 * one, one, torch.ones(2, 1), 2 * one, flags, flags)
    batch = replay.sample(50, 2, 0.5, generator())
    # first row: 1 + 0.5; second row stops at the cut: 1, then the value with discount 0.5
    assert set(np.round(batch.reward.tolist(), 6)) == {1.5, 1.0}
    assert set(batch.discount[batch.reward == 1.0].tolist()) == {0.5}


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(1, 50), min_size=1, max_size=6), st.integers(0, 1000))
def test_normaliser_has_mean_and_deviation_of_all_it_saw(sizes, seed):
    """Merged rollouts give the mean and standard deviation of all of them together."""
    g = generator(seed)
    parts = [100.0 + 3.0 * torch.randn(size, 4, generator=g, dtype=torch.float64) for size in sizes]
    normaliser = Normaliser(4)
    for part in parts:
        normaliser.update(part)
    together = torch.cat(parts)
    torch.testing.assert_close(normaliser.mean.double(), together.mean(0), rtol=1e-6, atol=0)
    expected = together.std(0, unbiased=False).clamp(min=0.01)
    torch.testing.assert_close(normaliser.scale.double(), expected, rtol=1e-5, atol=1e-7)


def test_settings_are_checked():
    """Impossible settings are refused by name."""
    with pytest.raises(ValueError, match="n_step must be at least 1"):
        SACSettings(n_step=0)
    with pytest.raises(ValueError, match="discount"):
        SACSettings(discount=1.0)
    with pytest.raises(ValueError, match="critic_rate must be a finite number"):
        SACSettings(critic_rate=math.nan)


def test_a_learner_starts_from_a_policy():
    """After `start_from` the bundle of the learner acts as the policy did; another size is refused."""
    layout = {"state": 3}
    manifest = Manifest("balance", layout, 0, ActionMap.around_stand(), (16, 16))
    settings = SACSettings(hidden=(16, 16))
    first, second = (SAC(3, 20, settings, torch.Generator().manual_seed(seed)) for seed in (0, 1))
    first.normaliser.update(torch.randn(200, 3, generator=torch.Generator().manual_seed(2)) * 3 + 1)
    policy = first.bundle(manifest)
    second.start_from(policy)
    observation = torch.randn(7, 3, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(second.bundle(manifest).act(observation), policy.act(observation), rtol=0, atol=1e-6)
    other = SAC(3, 20, SACSettings(hidden=(8, 8)), torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="hidden layers"):
        other.start_from(policy)
