"""Measure the cost of the batched environment: ratios within one run, with balancing OP3s.

python experiments/benchmarks/environment_speed.py [robots]
"""

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase

from op3.envs import make_env
from op3.report import machine
from op3.sim import BatchSimulation
from op3.tasks.task import TICKS

ROUNDS = 5
STEPS = 15
COMPOSER_STEPS = 12


def seconds(work: Callable[[], None], count: int) -> tuple[float, float]:
    """Wall time and processor time, over all threads, of one policy step of one robot [s]."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return (time.perf_counter() - wall) / count, (time.process_time() - processor) / count


def whole(env: EnvBase, steps: int) -> Callable[[], None]:
    """Policy steps through TorchRL, with resets of robots that are done."""
    stand = torch.from_numpy(env.action_map.stand()).float().expand(env.batch_size[0], -1)
    state = {"now": env.reset()}

    def work() -> None:
        for _ in range(steps):
            state["now"]["action"] = stand
            _, state["now"] = env.step_and_maybe_reset(state["now"])

    return work


def without_torchrl(env: EnvBase, steps: int) -> Callable[[], None]:
    """The same steps through the environment's own function, without TorchRL."""
    stand = torch.from_numpy(env.action_map.stand()).float().expand(env.batch_size[0], -1)
    given = TensorDict({"action": stand}, env.batch_size)

    def work() -> None:
        for _ in range(steps):
            env._step(given)

    return work


def bare(simulation: BatchSimulation, steps: int) -> Callable[[], None]:
    """Servo law and physics of the same robots alone."""

    def work() -> None:
        for _ in range(steps * TICKS):
            simulation.advance()

    return work


def main() -> None:
    """Measure alternately, so that drift of the machine's speed affects all, and print medians of ratios."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("robots", type=int, nargs="?", default=64, help="number of robots simulated in parallel")
    robots = parser.parse_args().robots
    env = make_env("balance", num_envs=robots)
    one = make_env("balance", backend="composer")
    step, inner, physics = whole(env, STEPS), without_torchrl(env, STEPS), bare(env.simulation, STEPS)
    alone = whole(one, COMPOSER_STEPS)
    rows = []
    for _ in range(ROUNDS + 1):
        # every measurement starts from robots that were just put down
        measured = []
        for work in (step, inner, physics):
            env.reset()
            measured.append(seconds(work, STEPS * robots))
        rows.append((*measured, seconds(alone, COMPOSER_STEPS)))
    rows = rows[1:]  # the first round warms up
    print("machine: " + ", ".join(f"{key} {value}" for key, value in machine().items()))
    names = ("environment", "without TorchRL", "BatchSimulation alone", "composer environment")
    for clock, label in enumerate(("wall time", "processor time, for a machine that is busy with other things")):
        times = [[value[clock] for value in row] for row in rows]
        print(f"{label}:")
        for name, values in zip(names, zip(*times, strict=True), strict=True):
            print(f"  {name:24s} {1 / statistics.median(values):8.0f} policy steps/s")
        ratios = {
            "environment against BatchSimulation alone": [b / e for e, _, b, _ in times],
            "environment against composer": [c / e for e, _, _, c in times],
            "share of TorchRL": [1 - i / e for e, i, _, _ in times],
        }
        for name, values in ratios.items():
            print(f"  {name}: {statistics.median(values):.2f} ({min(values):.2f} to {max(values):.2f})")


if __name__ == "__main__":
    main()
