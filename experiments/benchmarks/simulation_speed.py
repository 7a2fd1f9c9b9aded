"""How much the servo law costs: ratios measured in one run, on 64 OP3s that stand, and of the law alone.

python experiments/benchmarks/simulation_speed.py
"""

import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from mujoco.batch import Batch

from op3.report import machine
from op3.robot import JOINTS, hold, pose
from op3.servo import ServoLaw, Signals
from op3.servo.compiled_step import CompiledStep
from op3.sim import BatchSimulation, load_model
from op3.tasks import Setup, playback_environment, squat_task

SIMS = 64
ROUNDS = 7
TICKS = 40


def standing(translated: bool) -> BatchSimulation:
    """64 OP3s that have sunk into their stand pose, with the paper's full law in numpy or in torch."""
    setup = Setup.of_mount("floor")
    simulation = BatchSimulation(
        setup.mj_model,
        setup.scene.joint_names,
        load_model("paper"),
        SIMS,
        base_body=setup.base_body,
        translated=translated,
    )
    stand = pose("stand")
    commands = {"position_target": torch.from_numpy(stand), "p_gain": torch.tensor(6.0), "d_gain": torch.tensor(0.1)}
    simulation.reset(setup.scene.initial_qpos(stand), commands)
    for _ in range(125):
        simulation.advance()
    return simulation


def law_alone(robots: int, joints: int, dtype: torch.dtype) -> Callable[[], float]:
    """The paper's law of some robots, whose joints lie together in memory; in runs against call by call."""
    names, model = JOINTS[:joints], load_model("paper")
    law = ServoLaw(model.effects, 0.001, 0.008, names)
    columns = {name: value.expand(1, joints).to(dtype) for name, value in model.tensors(names).items()}
    law.set_parameters({name: value.T.repeat(1, robots).contiguous().T for name, value in columns.items()})
    signals = Signals.zeros(robots, joints, dtype=dtype)
    rng = np.random.default_rng(0)
    for name in ("position", "velocity", "load_torque", "position_target"):
        setattr(signals, name, torch.from_numpy(rng.normal(0.0, 0.3, (joints, robots))).to(dtype).T)
    signals.torque_enable, signals.bus_voltage = torch.ones_like(signals.position), signals.position * 0 + 12.0
    law.reset(signals)
    law.tick(signals)
    law.act(signals)
    step = CompiledStep(law.act, signals, ("applied_torque", "damping", "friction_bound", "current"))

    def ratio() -> float:
        seconds = []
        for work in (step, step.call_by_call):
            started = time.perf_counter()
            for _ in range(TICKS):
                for memory in (*step.inputs.values(), *step.state.values()):
                    if memory.dtype == np.int64:
                        memory[...] = 0  # the number of the step in its period, which ends
                work()
            seconds.append(time.perf_counter() - started)
        return seconds[1] / seconds[0]

    return ratio


def seconds_per_step(work: Callable[[], None], steps: int) -> float:
    """Wall time of one physics step of one robot [s]."""
    started = time.perf_counter()
    work()
    return (time.perf_counter() - started) / steps


def law(simulation: BatchSimulation) -> float:
    """A step with the law."""

    def work() -> None:
        for _ in range(TICKS):
            simulation.advance()

    return seconds_per_step(work, TICKS * simulation.substeps * SIMS)


def bare(batch: Batch, steps: int) -> float:
    """A step of the same batch, state and threads without the law: torques and friction as last written."""

    def work() -> None:
        for _ in range(steps):
            batch.step()

    return seconds_per_step(work, steps * SIMS)


def composer() -> Callable[[], float]:
    """A step through dm_control composer, one robot."""
    motion = hold(pose("stand"), 1000.0)
    environment = playback_environment(squat_task(load_model("paper"), motion))
    environment.reset()
    for _ in range(125):
        environment.step(np.zeros(0))

    def work() -> None:
        for _ in range(TICKS):
            environment.step(np.zeros(0))

    return lambda: seconds_per_step(work, TICKS * 8)


def main() -> None:
    """Measure in turn, so that a drift of the machine's speed meets all, and print medians of ratios."""
    torch.set_num_threads(1)
    simulation, in_torch, one = standing(True), standing(False), composer()
    state = simulation.batch.state.copy()
    rows = []
    for _ in range(ROUNDS):
        for each in (simulation, in_torch):  # from the same stand: held torques let the robots sway after a while
            each.batch.state[...] = state
        with_law, with_torch = law(simulation), law(in_torch)
        simulation.batch.state[...] = state
        rows.append((with_law, with_torch, bare(simulation.batch, TICKS * simulation.substeps), one()))
    print("machine: " + ", ".join(f"{key} {value}" for key, value in machine().items()))
    for name, values in zip(
        ("law", "law in torch", "bare Batch.step", "composer"), zip(*rows, strict=True), strict=True
    ):
        print(f"{name:16s} {1e6 * statistics.median(values):8.1f} us per step and robot")
    against = {
        "full law against bare Batch.step": [row[2] / row[0] for row in rows],
        "full law against law in torch": [row[1] / row[0] for row in rows],
        "full law against composer": [row[3] / row[0] for row in rows],
    }
    for robots, joints, dtype in ((1, 20, torch.float64), (64, 20, torch.float64), (3840, 6, torch.float32)):
        ratio = law_alone(robots, joints, dtype)
        against[f"law of {robots} robots with {joints} joints against call by call"] = [ratio() for _ in range(ROUNDS)]
    for name, ratios in against.items():
        print(f"{name}: {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f}, {ROUNDS} rounds)")


if __name__ == "__main__":
    main()
