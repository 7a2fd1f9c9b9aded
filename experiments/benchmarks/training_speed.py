"""Measure the gain from collecting and updating in parallel: a recipe with and without it, alternately.

python experiments/benchmarks/training_speed.py [--task walk] [steps=20000] [rounds=3]

Both variants learn exactly the same, so only the time differs. Collecting and updating start with
the first step, because most of a run consists of both.
"""

import argparse
import statistics
import tempfile
import time

import torch
from hydra.utils import instantiate

from op3.apps.compose import composed
from op3.apps.fields import plain
from op3.apps.train import describe, learner, robots
from op3.report import machine, run_provenance
from op3.train import Curriculum, TrainSettings, train


def seconds(cfg, overlap: bool) -> float:
    """Wall time of the run [s]."""
    task = instantiate(cfg.task)
    environment = robots(cfg, task)
    algorithm = learner(cfg, task, environment)
    manifest = describe(cfg, task, algorithm, run_provenance(seed=0))
    settings = TrainSettings(**{**plain(cfg.train), "overlap": overlap})
    options = {"curriculum": Curriculum(task.schedules), "say": lambda line: None}
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        train(algorithm, environment, lambda policy: {}, settings, manifest, folder, **options)
        return time.perf_counter() - began


def main() -> None:
    """Measure alternately, so that drift of the machine's speed affects both, and print the ratios."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("steps", type=int, nargs="?", default=20000, help="environment steps of one training")
    parser.add_argument("rounds", type=int, nargs="?", default=3, help="rounds, in which the variants run in turn")
    parser.add_argument("--task", default="walk")
    options = parser.parse_args()
    steps, rounds = options.steps, options.rounds
    never = steps + 1
    overrides = [
        f"task={options.task}", f"train.steps={steps}", "algorithm.warmup=2048", "algorithm.actor_after=0",
        "algorithm.checkpoint_buffer=false",
        *(f"train.{name}={never}" for name in ("evaluate_every", "checkpoint_every", "log_every")),
    ]  # fmt: skip
    cfg = composed("train", overrides)
    rows = [(seconds(cfg, True), seconds(cfg, False)) for _ in range(rounds + 1)][1:]  # the first warms up
    print("machine: " + ", ".join(f"{key} {value}" for key, value in machine().items()))
    for name, times in zip(("overlap", "serial"), zip(*rows, strict=True), strict=True):
        middle = statistics.median(times)
        print(f"{name:8s} {steps / middle:6.0f} steps/s, 3,000,000 steps in {3e6 * middle / steps / 3600:.2f} h")
    ratios = [serial / overlapped for overlapped, serial in rows]
    print(f"overlap against serial: {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})")


if __name__ == "__main__":
    main()
