"""Networks, losses, returns and exploration against independent computations."""

import copy
import dataclasses
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution
from torchrl.data import Unbounded
from torchrl.envs import check_env_specs
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import REDQLoss, SACLoss
from train_pendulum import LIMIT, MANIFEST, Pendulum

from op3.policy import PolicyBundle, Training
from op3.train import PPO, SAC, TD3, Algorithm, Mirrored, OffPolicy, SACSettings, evaluate
from op3.train.networks import Ensemble, Normaliser, PolicyNetwork, QNetwork

SMALL = {"hidden": (16, 16), "batch": 32, "warmup": 0, "buffer": 1000}
ALGORITHMS = [(SAC, SMALL), (TD3, SMALL), (PPO, {"hidden": (16, 16), "rollout": 8, "batch": 64})]


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def transitions(size: int = 32, seed: int = 5) -> TensorDict:
    """Complete returns [batch] of pendulums, as the buffer gives them."""
    g = generator(seed)
    content = {
        "observation": torch.randn(size, 3, generator=g),
        "action": torch.rand(size, 2, generator=g) * 2 - 1,
        "steps_to_next_obs": torch.randint(1, 4, (size,), generator=g),
        "next": {
            "observation": torch.randn(size, 3, generator=g),
            "reward": torch.randn(size, 1, generator=g),
            "terminated": torch.rand(size, 1, generator=g) < 0.2,
            "done": torch.rand(size, 1, generator=g) < 0.3,
        },
    }
    return TensorDict(content, [size])


def rollout(env: Pendulum, algorithm: Algorithm, steps: int) -> TensorDict:
    """A rollout [env, time] of the explorer, over the ends of episodes."""
    return env.rollout(steps, algorithm.explorer, break_when_any_done=False)


def test_untrained_policy_is_the_initial_action():
    """Whatever it sees, the untrained policy's mean is within 0.05 of the initial action, with the initial spread."""
    wanted = torch.tensor([0.0, 0.5, -0.9])
    mean, std = PolicyNetwork(5, 3, (64, 64), initial_action=wanted, initial_std=0.2)(
        torch.randn(100, 5, generator=generator(1))
    )
    assert float((mean.detach().tanh() - wanted).abs().max()) < 0.05
    torch.testing.assert_close(std, torch.full_like(mean, 0.2), rtol=0.1, atol=0)


def test_exploration_is_bounded():
    """However the weights ask for it, the standard deviation stays at `largest_std`."""
    network = PolicyNetwork(5, 3, (16,), initial_std=0.02, largest_std=0.03)
    with torch.no_grad():
        network.mlp[-1].bias[3:] = 2.0
    torch.testing.assert_close(network(torch.randn(10, 5))[1], torch.full((10, 3), 0.03))
    with pytest.raises(ValueError, match="largest_std must be above"):
        SACSettings(largest_std=0.001)


@pytest.mark.parametrize("layer_norm", [False, True])
def test_a_q_network_equals_one_of_joined_inputs(layer_norm):
    """The split first layer equals one layer of observation and action together, drawn within the same bound."""
    network = QNetwork(5, 3, (16, 8), layer_norm)
    observation, action = torch.randn(10, 5), torch.randn(10, 3)
    first = torch.nn.Linear(8, 16)
    first.weight.data = torch.cat([network.observation.weight, network.action.weight], -1)
    first.bias.data = network.observation.bias
    joined = torch.nn.Sequential(first, *copy.deepcopy(network.rest))
    expected = joined(torch.cat([observation, action], -1))
    torch.testing.assert_close(network(observation, action), expected, rtol=1e-5, atol=1e-6)
    assert float(first.weight.detach().abs().max()) <= 8**-0.5


def test_bfloat16_critics_are_close():
    """Critics in bfloat16 (8 bits of mantissa) differ by under 3 % of the values' spread; weights stay float32."""
    exact = QNetwork(20, 4, (64, 64))
    rough = copy.deepcopy(exact)
    rough.in_bfloat16 = True
    inputs = torch.randn(200, 20, generator=generator(1)), torch.randn(200, 4, generator=generator(2))
    values = exact(*inputs).detach()
    assert 0 < float((rough(*inputs).detach() - values).abs().mean()) < 0.03 * float(values.std())
    assert all(parameter.dtype == torch.float32 for parameter in rough.parameters())


def written_out(sac: SAC, batch: TensorDict, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Losses of SAC written out with torch.distributions; gamma and alpha as in Haarnoja et al. 2018."""

    def sample(observation, noise):
        mean, std = sac.network(observation)
        raw = mean + std * noise
        squashed = TransformedDistribution(Independent(Normal(mean, std), 1), TanhTransform(cache_size=1))
        return torch.tanh(raw), squashed.log_prob(torch.tanh(raw))

    alpha, following = sac.log_temperature.exp().detach(), batch["next"]
    with torch.no_grad():
        action, log_prob = sample(following["normalised"], noise[0])
        value = torch.minimum(*sac.target_critics(following["normalised"], action)) - alpha * log_prob
        discount = sac.settings.discount ** batch["steps_to_next_obs"]
        target = following["reward"][:, 0] + discount * (1.0 - following["terminated"][:, 0].float()) * value
    first, second = sac.critics(batch["normalised"], batch["action"])
    critic_loss = 0.5 * ((first - target) ** 2).mean() + 0.5 * ((second - target) ** 2).mean()
    action, log_prob = sample(batch["normalised"], noise[1])
    policy_loss = (alpha * log_prob - torch.minimum(*sac.critics(batch["normalised"], action))).mean()
    return critic_loss, policy_loss, -float((log_prob + sac.settings.target_entropy * sac.action_size).mean().detach())


def drawn(seed: int, count: int = 1) -> torch.Tensor:
    """What torch's global generator gives after this seed."""
    torch.manual_seed(seed)
    return torch.stack([torch.normal(torch.zeros(32, 2), torch.ones(32, 2)) for _ in range(count)])


def test_losses_are_those_of_soft_actor_critic():
    """Losses and their gradients equal those of SAC written out plainly with torch.distributions."""
    sac = SAC(Pendulum(16), **SMALL, initial_temperature=0.3)
    batch = sac.normalise(transitions())
    critic_loss, policy_loss, temperature = written_out(sac, batch, drawn(3, 2))
    torch.manual_seed(3)
    torch.testing.assert_close(sac.critic_loss(batch)[0], critic_loss, rtol=1e-5, atol=1e-6)
    parameters = [*sac.network.parameters(), sac.log_temperature]
    gradients = torch.autograd.grad(sac.policy_loss(batch)[0], parameters)
    for first, second in zip(gradients[:-1], torch.autograd.grad(policy_loss, parameters[:-1]), strict=True):
        torch.testing.assert_close(first, second, rtol=1e-4, atol=1e-6)
    # d/d log(alpha) of log(alpha) (entropy - wanted)
    assert float(gradients[-1]) == pytest.approx(temperature, rel=1e-4)


def test_losses_are_those_of_torchrl():
    """On one batch with the same noise, `torchrl.objectives.SACLoss` has the same losses of critics and policy."""
    sac = SAC(Pendulum(16), **SMALL, initial_temperature=0.3)
    batch = sac.normalise(transitions())
    actor = ProbabilisticActor(
        TensorDictModule(sac.network, ["normalised"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    critics = [ValueOperator(member, in_keys=["normalised", "action"]) for member in sac.critics.members]
    loss = SACLoss(actor, critics, loss_function="l2", alpha_init=0.3, target_entropy=-2.0)
    loss.make_value_estimator(gamma=sac.settings.discount)
    torch.manual_seed(3)
    expected = loss(batch.clone())
    torch.manual_seed(3)
    torch.testing.assert_close(2.0 * sac.critic_loss(batch)[0], expected["loss_qvalue"], rtol=1e-6, atol=1e-6)
    policy_loss, entropy = sac.policy_loss(batch)
    policy_loss = policy_loss - sac.log_temperature * (entropy - sac.settings.target_entropy * 2)
    torch.testing.assert_close(policy_loss, expected["loss_actor"], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(entropy, expected["entropy"], rtol=1e-6, atol=1e-6)


def test_checkpoints_that_have_the_policy_twice_are_read():
    """Earlier versions kept the policy's weights also as those of an actor; any other unknown weight is refused."""
    sac, other = SAC(Pendulum(2), **SMALL), SAC(Pendulum(2), **SMALL, seed=1)
    state = sac.state_dict()
    twice = {f"actor.module.0.module.{name}": value for name, value in sac.network.state_dict().items()}
    other.load_state_dict({**state, **twice})
    assert all(torch.equal(a, b) for a, b in zip(sac.parameters(), other.parameters(), strict=True))
    with pytest.raises(RuntimeError, match="Unexpected key"):
        other.load_state_dict({**state, "another": state["log_temperature"]})


def test_critics_find_the_value_of_a_known_chain():
    """With reward 1, discount 0.5 and termination half of the time, Q converges to 1 / (1 - 0.25) = 1.333."""
    sac = SAC(
        Pendulum(16),
        hidden=(16,),
        discount=0.5,
        critic_rate=3e-3,
        initial_temperature=1e-6,
        target_rate=0.05,
        buffer=100,
    )
    batch = sac.normalise(transitions(64).apply(torch.zeros_like))
    batch["next", "reward"] += 1.0
    batch["next", "terminated"][::2] = True
    batch["steps_to_next_obs"] += 1
    g = generator()
    for _ in range(600):
        measures = sac.update(batch.set("action", torch.rand(64, 2, generator=g) * 2 - 1))
    # the mean of 1 + 0.5 Q and 1 + 0 Q is 1 + 0.25 Q
    assert float(measures["value"]) == pytest.approx(1.0 / 0.75, abs=0.05)


def test_target_critics_follow_by_their_rate():
    """After one update the targets have moved 10 % of the way to the critics."""
    sac = SAC(Pendulum(16), **SMALL, target_rate=0.1)
    before = [target.clone() for target in sac.target_critics.parameters()]
    sac.update(sac.normalise(transitions()))
    for old, new, critic in zip(before, sac.target_critics.parameters(), sac.critics.parameters(), strict=True):
        torch.testing.assert_close(new, old + 0.1 * (critic.detach() - old))


def test_the_policy_waits_for_the_critics():
    """Before `actor_after` updates the policy keeps its weights, afterwards it moves at every second one."""
    for kind in (SAC, TD3):
        algorithm = kind(Pendulum(16), **SMALL, actor_after=3, actor_every=2)
        batch, moved = algorithm.normalise(transitions()), []
        for _ in range(6):
            before = [parameter.clone() for parameter in algorithm.network.parameters()]
            algorithm.update(batch.clone())
            algorithm.updates += 1
            after = algorithm.network.parameters()
            moved.append(any(not torch.equal(a, b) for a, b in zip(before, after, strict=True)))
        assert moved == [False, False, False, False, True, False]


def stored(algorithm: OffPolicy) -> TensorDict:
    return algorithm.buffer.storage[:]


def test_returns_over_the_ends_of_episodes():
    """Three-step returns of two robots, in rollouts of two steps, by hand: one falls, the other's time is over."""
    sac = SAC(Pendulum(2), **{**SMALL, "batch": 2}, n_step=3, discount=0.5)
    # rewards are 1, 2, 4, 8, ... of the first robot and 10 times that of the second; observations count the steps
    steps, robots = torch.arange(8.0), torch.tensor([1.0, 10.0])
    reward = robots[:, None] * 2.0**steps
    terminated, done = torch.zeros(2, 8, dtype=torch.bool), torch.zeros(2, 8, dtype=torch.bool)
    terminated[0, 2] = done[0, 2] = True  # the first falls in its third step
    done[1, 3] = True  # the time of the second is over after its fourth
    observation = (robots[:, None] * (1.0 + steps))[..., None].expand(2, 8, 3)
    content = {"observation": observation, "action": torch.zeros(2, 8, 2)}
    ends = {"reward": reward[..., None], "terminated": terminated[..., None], "done": done[..., None]}
    whole = TensorDict({**content, "next": {"observation": observation + robots[:, None, None] / 2, **ends}}, [2, 8])
    for first in range(0, 8, 2):
        sac.take(whole[:, first : first + 2])
    found = {float(row["observation"][0]): row for row in stored(sac)}
    expected = {
        # robot 1: 1 + 0.5 * 2 + 0.25 * 4 = 3, and nothing after the fall
        1.0: (3.0, 3, True, 3.5),
        # 2 + 0.5 * 4 = 4 in two steps
        2.0: (4.0, 2, True, 3.5),
        # 4 in one step
        3.0: (4.0, 1, True, 3.5),
        # 8 + 0.5 * 16 + 0.25 * 32 = 24, and the value of what follows
        4.0: (24.0, 3, False, 6.5),
        # robot 2: 10 + 0.5 * 20 + 0.25 * 40 = 30, 20 + 0.5 * 40 + 0.25 * 80 = 60
        10.0: (30.0, 3, False, 35.0),
        20.0: (60.0, 3, False, 45.0),
        # 40 + 0.5 * 80 = 80 in two steps, at the end of time, and the value of the last observation
        30.0: (80.0, 2, False, 45.0),
        # 80 in one step
        40.0: (80.0, 1, False, 45.0),
    }
    assert expected.keys() <= found.keys()
    for key, (total, count, fell, last) in expected.items():
        row = found[key]
        assert float(row["next", "reward"]) == total
        assert int(row["steps_to_next_obs"]) == count
        assert bool(row["next", "terminated"]) == fell
        assert float(row["next", "observation"][0]) == last


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 4), st.integers(1, 6), st.integers(0, 1000))
def test_n_step_returns_equal_a_plain_loop(steps, chunk, seed):
    """For any n and length of a rollout, over ends of episodes and borders of rollouts."""
    g, length = generator(seed), 24
    sac = SAC(Pendulum(2), **{**SMALL, "batch": 2}, n_step=steps, discount=0.9)
    terminated = torch.rand(2, length, 1, generator=g) < 0.15
    done = terminated | (torch.rand(2, length, 1, generator=g) < 0.1)
    reward = torch.randn(2, length, 1, generator=g)
    # each step is marked by its robot and number
    mark = torch.stack(torch.meshgrid(torch.arange(2.0), torch.arange(float(length)), indexing="ij"), -1)
    mark = torch.cat([mark, torch.zeros(2, length, 1)], -1)
    ends = {"observation": mark + 0.5, "reward": reward, "terminated": terminated, "done": done}
    whole = TensorDict({"observation": mark, "action": torch.zeros(2, length, 2), "next": ends}, [2, length])
    for first in range(0, length, chunk):
        sac.take(whole[:, first : first + chunk])
    rows = stored(sac)
    assert len(rows) == 2 * (length - steps)
    for row in rows:
        robot, first = (int(value) for value in row["observation"][:2])
        total, last = 0.0, first
        for number in range(steps):
            last = first + number
            total += 0.9**number * float(reward[robot, last])
            if bool(done[robot, last]):
                break
        assert float(row["next", "reward"]) == pytest.approx(total, abs=1e-5)
        assert int(row["steps_to_next_obs"]) == last - first + 1
        assert bool(row["next", "terminated"]) == bool(terminated[robot, last])
        assert torch.equal(row["next", "observation"], mark[robot, last] + 0.5)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(1, 50), min_size=1, max_size=6), st.integers(0, 1000))
def test_normaliser_has_mean_and_deviation_of_all_it_saw(sizes, seed):
    """Merged rollouts give the mean and standard deviation of all of them together."""
    g = generator(seed)
    parts = [100.0 + 3.0 * torch.randn(size, 4, generator=g, dtype=torch.float64) for size in sizes]
    normaliser = Normaliser(4, clip=10.0)
    for part in parts:
        normaliser.update(part)
    together = torch.cat(parts)
    torch.testing.assert_close(normaliser.mean.double(), together.mean(0), rtol=1e-6, atol=0)
    expected = together.std(0, unbiased=False).clamp(min=0.01)
    torch.testing.assert_close(normaliser.scale.double(), expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(("kind", "options"), ALGORITHMS)
def test_the_normalisation_is_frozen_in_evaluation(kind, options):
    """A rollout that is learned from moves it; exploring and evaluating do not, nor the policy's weights."""
    env, judge = Pendulum(16), Pendulum(8)
    algorithm = kind(env, **options)
    taken = rollout(env, algorithm, 8)
    assert float(algorithm.normaliser.count[0]) == 0
    algorithm.take(taken)
    assert float(algorithm.normaliser.count[0]) == 16 * 8
    before = copy.deepcopy(algorithm.state_dict())
    evaluate(judge, algorithm.act, 0, LIMIT)
    rollout(env, algorithm, 8)
    for name, value in algorithm.state_dict().items():
        assert not isinstance(value, torch.Tensor) or torch.equal(value, before[name]), name


@pytest.mark.parametrize(("kind", "options"), ALGORITHMS)
def test_networks_have_the_sizes_that_are_asked_for(kind, options):
    """Inputs and outputs come from the environment's specs, hidden layers from the settings."""
    algorithm = kind(Pendulum(4), **{**options, "hidden": (24, 12)}, critic_hidden=(20,))
    shapes = [tuple(value.shape) for name, value in algorithm.network.named_parameters() if name.endswith("weight")]
    outputs = 2 if kind is TD3 else 4
    assert shapes == [(24, 3), (12, 24), (outputs, 12)]
    critics = {tuple(value.shape[-2:]) for name, value in algorithm.named_parameters() if "network.mlp" not in name}
    assert {(20, 3), (1, 20)} <= critics
    assert algorithm.bundle(MANIFEST).act(torch.zeros(4, 3)).shape == (4, 2)


@pytest.mark.parametrize(("kind", "options"), ALGORITHMS)
def test_a_bundle_acts_as_the_policy(kind, options, tmp_path):
    """The bundle of any algorithm has its deterministic actions, after it has learned."""
    env = Pendulum(16)
    algorithm = kind(env, **options, activation="elu")
    for _ in range(3):
        algorithm.take(rollout(env, algorithm, 8))
        algorithm.learn()
        algorithm.follow()
    assert algorithm.updates > 0
    observation = torch.randn(7, 3, generator=generator(3))
    algorithm.bundle(MANIFEST).save(tmp_path / "policy")
    bundle = PolicyBundle.load(tmp_path / "policy")
    assert (bundle.manifest.hidden, bundle.manifest.activation) == ((16, 16), "elu")
    torch.testing.assert_close(bundle.act(observation), algorithm.act(observation), rtol=0, atol=1e-6)


def test_an_algorithm_starts_from_a_policy():
    """After `start_from` the bundle of the learner acts as the policy did; another size is refused."""
    first, second = (SAC(Pendulum(16), **SMALL, seed=seed) for seed in (0, 1))
    first.normaliser.update(torch.randn(200, 3, generator=generator(2)) * 3 + 1)
    policy = first.bundle(MANIFEST)
    second.start_from(policy)
    observation = torch.randn(7, 3, generator=generator(3))
    torch.testing.assert_close(second.bundle(MANIFEST).act(observation), policy.act(observation), rtol=0, atol=1e-6)
    learned = PolicyBundle(dataclasses.replace(policy.manifest, training=Training(steps=100_000)), policy.weights)
    third = SAC(Pendulum(16), **SMALL, seed=2)
    third.start_from(learned)
    for algorithm in (second, third):  # of a policy that learned from much, little changes the normalisation
        algorithm.normaliser.update(torch.randn(1000, 3, generator=generator(4)) - 5)
    moved = [
        (algorithm.normaliser.mean - policy.weights["observation.mean"]).abs().max() for algorithm in (second, third)
    ]
    assert moved[1] < 0.1 < moved[0]
    other = SAC(Pendulum(16), **{**SMALL, "hidden": (8, 8)})
    with pytest.raises(ValueError, match="hidden layers"):
        other.start_from(policy)


def test_bold_environments_explore_more_during_the_warm_up():
    """Exploration grows from the policy's own deviation in the first environment to ten times it in the last."""
    sac = SAC(Pendulum(3), **{**SMALL, "warmup": 100}, initial_std=0.02, warmup_noise=10.0, noise=2.0)
    observation = TensorDict({"observation": torch.zeros(3, 3)}, [3])
    for steps, spread in ((0, [0.02, 0.02 * 10**0.5, 0.2]), (100, [0.02, 0.02 * 2**0.5, 0.04])):
        sac.steps = steps
        sac.follow()
        actions = torch.stack([sac.explorer(observation.clone())["action"] for _ in range(500)])
        assert actions.std((0, 2)).tolist() == pytest.approx(spread, rel=0.15)


class Flip:
    """The pendulum's image: angles change their sign, gains do not."""

    def observation(self, observation):
        return -observation

    def action(self, action):
        return action * torch.tensor([-1.0, 1.0])


def test_half_of_a_batch_is_seen_in_the_mirror():
    """The first part of a batch is its image in both observations and the action; rewards stay."""
    batch = transitions()
    seen = Mirrored(Flip(), 0.5)(batch.clone())
    for key, sign in (("observation", -1.0), (("next", "observation"), -1.0), (("next", "reward"), 1.0)):
        assert torch.equal(seen[key][:16], sign * batch[key][:16])
        assert torch.equal(seen[key][16:], batch[key][16:])
    assert torch.equal(seen["action"][:16], Flip().action(batch["action"][:16]))


class Shaken(Pendulum):
    """Pendulums whose critics see one more number than the policy."""

    def __init__(self, count: int):
        super().__init__(count)
        self.observation_spec["privileged"] = Unbounded((count, 1))

    def _reset(self, tensordict=None, **_):
        return super()._reset(tensordict).set("privileged", self.state[:, 1:2].clone())

    def _step(self, tensordict):
        return super()._step(tensordict).set("privileged", self.state[:, 1:2].clone())


@pytest.mark.parametrize(("kind", "options"), ALGORITHMS)
def test_critics_see_more_than_the_policy(kind, options):
    """Learning changes the critics' weights of the privileged number; the bundle is as wide as the observation."""
    env = Shaken(16)
    check_env_specs(env)
    algorithm = kind(env, **options)
    first = {"SAC": "critics", "TD3": "loss", "PPO": "loss"}[kind.__name__]
    wide = [p for p in getattr(algorithm, first).parameters() if p.dim() > 1 and p.shape[-1] == 4]
    before = [p.detach().clone() for p in wide]
    for _ in range(4):
        algorithm.take(rollout(env, algorithm, 8))
        algorithm.learn()
    assert wide
    assert all((p.detach()[..., 3] != old[..., 3]).any() for p, old in zip(wide, before, strict=True))
    weights = algorithm.bundle(MANIFEST).weights
    assert weights["observation.mean"].shape == (3,)
    assert weights["layer_0.weight"].shape[1] == 3
    other = kind(env, **options, seed=5)
    other.start_from(algorithm.bundle(MANIFEST))
    seen = torch.randn(10, 3, generator=generator())
    assert torch.equal(other.act(seen), algorithm.act(seen))


class Redq(OffPolicy):
    """Another algorithm: four critics, of which each target takes two (Chen et al. 2021)."""

    def make_loss(self):
        actor, critic = self.stochastic_actor(), self.critic()
        loss = REDQLoss(actor, critic, num_qvalue_nets=4, sub_sample_len=2, target_entropy=-2.0)
        loss.make_value_estimator(gamma=self.settings.discount)
        return loss


def test_another_algorithm_is_ten_lines():
    """A class with one of TorchRL's losses collects, learns and makes bundles as those of the project do."""
    env = Pendulum(16)
    algorithm = Redq(env, **SMALL)
    before = [parameter.clone() for parameter in algorithm.network.parameters()]
    for _ in range(3):
        algorithm.take(rollout(env, algorithm, 8))
        measures = algorithm.learn()
    assert algorithm.updates > 10
    assert math.isfinite(float(measures["qvalue_loss"]))
    assert all(not torch.equal(a, b) for a, b in zip(before, algorithm.network.parameters(), strict=True))
    assert algorithm.bundle(MANIFEST).act(torch.zeros(2, 3)).shape == (2, 2)


def test_settings_are_checked():
    """Impossible settings are refused by name."""
    for options, message in (
        ({"n_step": 0}, "n_step must be at least 1"),
        ({"discount": 1.0}, "discount must be below 1"),
        ({"critic_rate": math.nan}, "critic_rate must be a finite number"),
        ({"batch": 10.5}, "batch must be a whole number, got 10.5"),
        ({"hidden": 256}, "hidden must be a list, got 256"),
        ({"noise": "loud"}, "noise must be a number, got 'loud'"),
        ({"mirrored": 2.0}, "mirrored must be at most 1"),
        ({"epochs": 3}, "epochs is not a field"),
        ({"buffer": 31}, "buffer must hold two steps of 16 environments or more, got 31"),
    ):
        with pytest.raises(ValueError, match=message):
            SAC(Pendulum(16), **options)


def test_an_ensemble_keeps_its_members_apart():
    members = [QNetwork(3, 2, (8,)) for _ in range(2)]
    observation, action = torch.randn(5, 3), torch.randn(5, 2)
    values = Ensemble(members)(observation, action)
    for value, member in zip(values, members, strict=True):
        torch.testing.assert_close(value, member(observation, action)[:, 0])


@pytest.mark.parametrize(("kind", "learn"), ALGORITHMS)
def test_the_policy_that_is_kept_has_an_average_of_the_weights(kind, learn):
    """By hand after every update; it acts and is bundled, the latest weights explore, and no gradient reaches it."""
    env = Pendulum(4)
    algorithm = kind(env, seed=1, averaging=0.8, **learn)
    wanted = [value.detach().clone() for value in algorithm.network.parameters()]
    count = algorithm.count_update

    def counted():
        count()
        for mean, latest in zip(wanted, algorithm.network.parameters(), strict=True):
            mean.copy_(0.8 * mean + 0.2 * latest.detach())

    algorithm.count_update = counted
    for _ in range(3):
        algorithm.follow()
        algorithm.take(rollout(env, algorithm, 16))
        algorithm.learn()
    assert algorithm.updates > 5
    assert not any(value.requires_grad for value in algorithm.average.parameters())
    torch.testing.assert_close([*algorithm.average.parameters()], wanted)
    seen = torch.randn(5, 3, generator=generator())
    mean = algorithm.average(algorithm.normaliser(seen))[0].tanh()
    torch.testing.assert_close(algorithm.act(seen), mean)
    torch.testing.assert_close(algorithm.bundle(MANIFEST).act(seen), mean)
    assert not torch.allclose(algorithm.network(algorithm.normaliser(seen))[0].tanh(), mean)
