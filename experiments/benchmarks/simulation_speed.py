"""Measure the cost of the servo law: alone, and relative to MuJoCo for 64 standing OP3s.

python experiments/benchmarks/simulation_speed.py
"""

import time
from collections.abc import Callable

import numpy as np
import torch
from mujoco.batch import Batch

from op3.replay import Setup
from op3.report import machine
from op3.robot import load_robot, pose
from op3.servo import Servos
from op3.sim import BatchSimulation, load_model

SIMS = 64
ROUNDS = 7
TICKS = 40
ROBOTS = (1, 32, 64, 600)
"""Numbers of robots with 20 joints for which the law alone is timed."""


def law_alone(robots: int) -> Callable[[], float]:
    """Duration of a call of the paper's full law, for some robots in motion [s]."""
    model = load_model("paper")
    law = Servos(model.effects, load_robot("op3").joints, robots, 0.001, 0.008)
    law.set(model.tensors(load_robot("op3").joints))
    rng, shape = np.random.default_rng(0), (robots, len(load_robot("op3").joints))
    for name, spread in (("position", 0.3), ("velocity", 2.0), ("load_torque", 0.5), ("position_target", 0.3)):
        setattr(law.signals, name, torch.from_numpy(rng.normal(0.0, spread, shape)))
    law.signals.torque_enable, law.signals.bus_voltage, law.signals.p_gain = 1.0, model.bus_voltage, 6.0
    law.reset()

    def call() -> float:
        law.tick()
        started = time.perf_counter()
        for _ in range(8):
            law.step()
        return (time.perf_counter() - started) / 8

    return lambda: min(call() for _ in range(TICKS))


def standing() -> BatchSimulation:
    """64 OP3s that have sunk into their stand pose, with the paper's full law."""
    setup = Setup.of_mount("floor", robot="op3")
    model, names = load_model("paper"), setup.scene.joint_names
    simulation = BatchSimulation(setup.mj_model, names, model, SIMS, base_body=setup.base_body)
    stand = pose("stand", "op3")
    commands = {"position_target": torch.from_numpy(stand), "p_gain": torch.tensor(6.0), "d_gain": torch.tensor(0.1)}
    simulation.reset(setup.scene.initial_qpos(stand), commands)
    for _ in range(125):
        simulation.advance()
    return simulation


def processor_seconds(batch: Batch, steps: int) -> float:
    """Processor time of a step of the whole batch without the law [s]."""
    started = time.process_time()
    for _ in range(steps):
        batch.step()
    return (time.process_time() - started) / steps


def main() -> None:
    """Measure several rounds, and print the best one."""
    torch.set_num_threads(1)
    print("machine: " + ", ".join(f"{key} {value}" for key, value in machine().items()))
    alone = {robots: law_alone(robots) for robots in ROBOTS}
    for robots, call in alone.items():
        print(f"law of {20 * robots:5d} joints {1e6 * min(call() for _ in range(ROUNDS)):8.1f} us per call")
    batch = standing().batch
    step = min(processor_seconds(batch, 100) for _ in range(ROUNDS))
    print(f"law's share of the processor time of a step of {SIMS} robots: {100 * alone[SIMS]() / step:.1f} %")


if __name__ == "__main__":
    main()
