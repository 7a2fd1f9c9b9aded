"""Updates per second of soft actor-critic with the balancing and walking recipes, compared with TorchRL and others.

python experiments/benchmarks/learner_speed.py [--rounds 7] [--updates 10]

An update draws a batch of n-step returns, of which half is mirrored, normalises it, and makes a gradient step of
critics, policy and temperature, on one core. TorchRL's path is what its documentation shows: MLP critics with layer
normalisation, `SACLoss` and `SoftUpdate` with their defaults. Stable-Baselines3 is measured if it is installed, with
one-step returns and without layer normalisation or mirrored samples. The variants run alternately, and the ratios are
medians over the rounds.
"""

import argparse
import statistics
import time
import warnings
from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import LossModule, SACLoss

from op3.report import machine
from op3.tasks import find_task
from op3.train import SAC, OffPolicy
from op3.train.algorithm import NORMALISED
from op3.train.networks import bfloat16_is_faster

ROWS, ENVIRONMENTS = 300, 64
RECIPES = {
    "balance": {"hidden": (128, 128), "batch": 1024},
    "walk": {"hidden": (256, 256), "batch": 768},
}
"""Settings in conf/recipe and conf/algorithm that determine the size of an update."""

COMMON = {"n_step": 5, "discount": 0.97, "mirrored": 0.5, "warmup": 0, "buffer": ROWS * ENVIRONMENTS}


class Shape(EnvBase):
    """The shape of a task, which is all that `update` needs of an environment."""

    def __init__(self, observation: int, action: int):
        super().__init__(batch_size=[ENVIRONMENTS])
        self.observation_spec = Composite(observation=Unbounded((ENVIRONMENTS, observation)), shape=(ENVIRONMENTS,))
        self.action_spec = Bounded(-1.0, 1.0, (ENVIRONMENTS, action))

    _step = _reset = None  # type: ignore[assignment]

    def _set_seed(self, seed: int | None) -> None: ...


class Stock(OffPolicy):
    """Soft actor-critic as TorchRL's documentation shows it."""

    def make_loss(self) -> LossModule:
        """The loss with its defaults."""
        units = list(self.settings.hidden)
        critic = MLP(
            self.observation_size + self.action_size,
            1,
            num_cells=units,
            activation_class=torch.nn.ReLU,
            norm_class=torch.nn.LayerNorm,
            norm_kwargs=[{"normalized_shape": size} for size in units],
        )
        value = ValueOperator(critic, in_keys=[NORMALISED, "action"])
        loss = SACLoss(
            self.stochastic_actor(), value, alpha_init=0.01, target_entropy=-1.6 * self.action_size, loss_function="l2"
        )
        loss.make_value_estimator(gamma=self.settings.discount)
        return loss


def sizes(task: str) -> tuple[int, int]:
    """Numbers in an observation and in an action."""
    chosen = find_task(task)
    return chosen.observation_size, chosen.action_map().size


def rollout(observation: int, action: int) -> TensorDict:
    """Random transitions [env, time]."""
    g = torch.Generator().manual_seed(0)
    shape = (ENVIRONMENTS, ROWS)
    done = torch.rand(*shape, 1, generator=g) < 0.01
    after = {
        "observation": torch.randn(*shape, observation, generator=g),
        "reward": torch.randn(*shape, 1, generator=g),
        "terminated": done,
        "done": done,
    }
    actions = torch.rand(*shape, action, generator=g) * 2 - 1
    return TensorDict(
        {"observation": torch.randn(*shape, observation, generator=g), "action": actions, "next": after}, shape
    )


def updates_of(kind: type[OffPolicy], task: str, **settings: object) -> Callable[[], object]:
    """An update of an algorithm with the recipe of a task."""
    chosen = find_task(task)
    (size, actions), mirror = sizes(task), chosen.mirror(chosen.action_map())
    algorithm = kind(Shape(size, actions), mirror=mirror, **{**RECIPES[task], **COMMON, **settings})
    algorithm.take(rollout(size, actions))
    return lambda: algorithm.update(algorithm.buffer.sample())


def stable_baselines(task: str) -> Callable[[], object] | None:
    """The SAC of Stable-Baselines3; None if it is not installed."""
    try:
        import gymnasium
        from stable_baselines3 import SAC as Baseline
        from stable_baselines3.common.logger import configure
    except ImportError:
        return None
    size, actions = sizes(task)

    class Nothing(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (actions,), np.float32)

    model = Baseline(
        "MlpPolicy",
        Nothing(),
        batch_size=RECIPES[task]["batch"],
        buffer_size=ROWS * ENVIRONMENTS,
        policy_kwargs={"net_arch": list(RECIPES[task]["hidden"])},
        device="cpu",
        seed=0,
    )
    model.set_logger(configure(None, []))
    assert model.replay_buffer is not None
    for row in rollout(size, actions).reshape(-1)[:20_000]:
        after = row["next"]
        values = (row["observation"], after["observation"], row["action"], after["reward"], after["done"])
        model.replay_buffer.add(*(value.numpy()[None] for value in values), [{}])
    return lambda: model.train(gradient_steps=1, batch_size=RECIPES[task]["batch"])


def rate(update: Callable[[], object], updates: int) -> float:
    """Updates per second of processor time, which depends less on other processes than wall time."""
    started = time.process_time()
    for _ in range(updates):
        update()
    return updates / (time.process_time() - started)


def main() -> None:
    """Measure alternately, and print one table for each recipe."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--updates", type=int, default=10, help="updates per round")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", category=UserWarning)
    facts = machine()
    print(
        f"{facts['processor']}, one thread of {facts['cpu_count']}; {chosen.rounds} rounds of {chosen.updates} updates"
    )
    faster = bfloat16_is_faster(torch.device("cpu"))
    print(f"bfloat16=null takes {'bfloat16' if faster else 'float32'} here")
    for task, recipe in RECIPES.items():
        cases = {
            "TorchRL SACLoss, float32": updates_of(Stock, task),
            "op3, float32": updates_of(SAC, task),
            "op3, critics in bfloat16": updates_of(SAC, task, bfloat16=True),
            "Stable-Baselines3": stable_baselines(task),
        }
        present = {name: update for name, update in cases.items() if update is not None}
        rates: dict[str, list[float]] = {name: [] for name in present}
        for update in present.values():
            rate(update, 3)
        for _ in range(chosen.rounds):
            for name, update in present.items():
                rates[name].append(rate(update, chosen.updates))
        units, batch = recipe["hidden"][0], recipe["batch"]
        print(f"{task}: batch {batch}, two layers of {units}")
        print(f"  {'':30s}{'updates/s':>10s}{'samples/s':>10s}{'low':>8s}{'high':>8s}{'ratio':>8s}")
        reference = rates["TorchRL SACLoss, float32"]
        for name, values in rates.items():
            middle = statistics.median(values)
            ratio = statistics.median(a / b for a, b in zip(values, reference, strict=True))
            print(f"  {name:30s}{middle:10.1f}{middle * batch:10.0f}{min(values):8.1f}{max(values):8.1f}{ratio:8.2f}")
    print("ratio: to TorchRL's path; all rates per second of processor time")


if __name__ == "__main__":
    main()
