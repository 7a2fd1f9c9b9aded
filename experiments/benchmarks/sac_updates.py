"""SAC updates per second on one core, with sampling: ratios measured in one run, rounds taken in turn.

python experiments/benchmarks/sac_updates.py [--hidden 256] [--rounds 7]

Stable-Baselines3 is measured where it is installed; the project does not need it.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch

from op3.report import machine
from op3.train import SAC, ReplayBuffer, SACSettings

BATCH, OBSERVATION, ACTION = 256, 124, 20
ROWS, ENVIRONMENTS = 600, 32


def transitions() -> dict[str, torch.Tensor]:
    """Random transitions [time, env]."""
    g = torch.Generator().manual_seed(0)
    shape = (ROWS, ENVIRONMENTS)
    terminated = torch.rand(shape, generator=g) < 0.01
    return {
        "observation": torch.randn(*shape, OBSERVATION, generator=g),
        "action": torch.rand(*shape, ACTION, generator=g) * 2 - 1,
        "reward": torch.randn(shape, generator=g),
        "next_observation": torch.randn(*shape, OBSERVATION, generator=g),
        "terminated": terminated,
        "done": terminated,
    }


def ours(hidden: int, **settings: object) -> Callable[[], object]:
    """Our update, one-step returns and no layer normalisation unless asked for, so as to compute what others do."""
    options = {"n_step": 1, "layer_norm": False, **settings}
    sac = SAC(OBSERVATION, ACTION, SACSettings(hidden=(hidden, hidden), **options), torch.Generator().manual_seed(0))
    replay = ReplayBuffer(ROWS * ENVIRONMENTS, ENVIRONMENTS, OBSERVATION, ACTION)
    replay.extend(**transitions())
    steps, discount = sac.settings.n_step, sac.settings.discount
    return lambda: sac.update(replay.sample(BATCH, steps, discount, sac.generator))


def torchrl(hidden: int) -> Callable[[], object]:
    """TorchRL's SACLoss, target updater and replay buffer, eager."""
    from tensordict import TensorDict
    from tensordict.nn import NormalParamExtractor, TensorDictModule
    from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
    from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
    from torchrl.objectives import SACLoss, SoftUpdate

    network = torch.nn.Sequential(
        MLP(in_features=OBSERVATION, out_features=2 * ACTION, num_cells=[hidden] * 2, activation_class=torch.nn.ReLU),
        NormalParamExtractor(),
    )
    actor = ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    value = ValueOperator(
        MLP(in_features=OBSERVATION + ACTION, out_features=1, num_cells=[hidden] * 2, activation_class=torch.nn.ReLU),
        in_keys=["observation", "action"],
    )
    loss = SACLoss(actor, value, num_qvalue_nets=2, loss_function="l2", target_entropy=-ACTION, action_spec=None)
    loss.make_value_estimator(gamma=0.98)
    updater = SoftUpdate(loss, eps=0.995)
    optimiser = torch.optim.Adam(loss.parameters(), 3e-4)
    data = {name: values.flatten(0, 1) for name, values in transitions().items()}
    flags = {name: data[name][:, None] for name in ("terminated", "done")}
    after = {"observation": data["next_observation"], "reward": data["reward"][:, None], **flags}
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(ROWS * ENVIRONMENTS), batch_size=BATCH)
    buffer.extend(
        TensorDict({"observation": data["observation"], "action": data["action"], "next": after}, [ROWS * ENVIRONMENTS])
    )

    def update() -> None:
        losses = loss(buffer.sample())
        optimiser.zero_grad()
        (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
        optimiser.step()
        updater.step()

    return update


def stable_baselines(hidden: int) -> Callable[[], object] | None:
    """Stable-Baselines3's SAC, or None where it is not installed."""
    try:
        import gymnasium
        from stable_baselines3 import SAC as Baseline
        from stable_baselines3.common.logger import configure
    except ImportError:
        return None

    class Nothing(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATION,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION,), np.float32)

    model = Baseline(
        "MlpPolicy",
        Nothing(),
        batch_size=BATCH,
        buffer_size=ROWS * ENVIRONMENTS,
        gamma=0.98,
        policy_kwargs={"net_arch": [hidden, hidden]},
        device="cpu",
        seed=0,
    )
    model.set_logger(configure(None, []))
    data = {name: values.flatten(0, 1).numpy() for name, values in transitions().items()}
    assert model.replay_buffer is not None
    for i in range(ROWS * ENVIRONMENTS):
        row = (
            data["observation"][i],
            data["next_observation"][i],
            data["action"][i],
            data["reward"][i],
            data["done"][i],
        )
        model.replay_buffer.add(*(np.asarray(value)[None] for value in row), [{}])
    return lambda: model.train(gradient_steps=1, batch_size=BATCH)


def rate(update: Callable[[], object], updates: int) -> float:
    """Updates per second of processor time, which other processes on the machine do not lengthen as much."""
    started = time.process_time()
    for _ in range(updates):
        update()
    return updates / (time.process_time() - started)


def main() -> None:
    """Measure in turn and print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hidden", type=int, default=256, help="units of each of two hidden layers")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--updates", type=int, default=40, help="per round")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    cases = {
        "op3, float32": ours(chosen.hidden),
        "op3, bfloat16 critics": ours(chosen.hidden, bfloat16=True),
        "op3, float32, as trained (layer norm, 3 steps)": ours(chosen.hidden, layer_norm=True, n_step=3),
        "op3, bfloat16, as trained": ours(chosen.hidden, layer_norm=True, n_step=3, bfloat16=True),
        "TorchRL SACLoss, eager": torchrl(chosen.hidden),
        "Stable-Baselines3": stable_baselines(chosen.hidden),
    }
    present = {name: update for name, update in cases.items() if update is not None}
    rates: dict[str, list[float]] = {name: [] for name in present}
    for update in present.values():
        rate(update, 5)
    for _ in range(chosen.rounds):
        for name, update in present.items():
            rates[name].append(rate(update, chosen.updates))
    reference = "Stable-Baselines3" if "Stable-Baselines3" in present else "TorchRL SACLoss, eager"
    facts = machine()
    print(f"{facts['processor']}, one thread of {facts['cpu_count']}; batch {BATCH}, observation {OBSERVATION}, "
          f"action {ACTION}, two layers of {chosen.hidden}; {chosen.rounds} rounds")  # fmt: skip
    print(f"{'':48s}{'updates/s':>10s}{'low':>8s}{'high':>8s}{'ratio':>8s}")
    for name, values in rates.items():
        ratio = statistics.median(a / b for a, b in zip(values, rates[reference], strict=True))
        print(f"{name:48s}{statistics.median(values):10.1f}{min(values):8.1f}{max(values):8.1f}{ratio:8.2f}")
    print(f"ratio: to {reference}, median over rounds; rates per second of processor time")
    if "Stable-Baselines3" not in present:
        print("Stable-Baselines3 is not installed; `pip install stable-baselines3` adds its row")


if __name__ == "__main__":
    main()
