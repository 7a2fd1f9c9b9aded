"""How long the first use of effects takes: of all, of combinations that are new, and of an effect that is new.

python experiments/benchmarks/first_use.py
"""

import time
from math import sin

import torch

from op3.replay import Setup
from op3.servo import Effect, Parameter, RobotModel, Stage, catalogue, register
from op3.sim import BatchSimulation, load_model

VOLTAGE_DRIVEN = ("position_servo", "minimum_duty")


class Detent(Effect):
    """Torque of the rotor's magnets, as in docs/extend.md."""

    name = "detent"
    stage = Stage.GEAR
    equation = source = "-"
    parameters = (Parameter("detent_amplitude", "N m", 0.0, 0.1, 0.02, 0.0, "at the joint"),)

    @staticmethod
    def apply(s, p):
        """Add the ripple."""
        s.applied_torque += p.detent_amplitude * sin(24.0 * s.position)


def first_use(model: RobotModel, setup: Setup) -> str:
    """Four robots made, reset, moved and read."""
    wall, processor = time.perf_counter(), time.process_time()
    names, start = setup.scene.joint_names, torch.zeros(20, dtype=torch.float64)
    robots = BatchSimulation(setup.mj_model, names, model, 4, base_body=setup.base_body, num_threads=1)
    robots.reset(setup.scene.initial_qpos(start.numpy()), {"position_target": start})
    robots.advance()
    robots.measure()
    return f"{time.perf_counter() - wall:.2f} s, {time.process_time() - processor:.3f} s of processor time"


def main() -> None:
    """Print wall and processor time of each."""
    torch.set_num_threads(1)
    setup, paper = Setup.of_mount("floor"), load_model("paper")
    print("the paper's law, compiled or read from the disk:", first_use(paper, setup))
    off = [name for name in catalogue() if name not in (*paper.effect_names, *VOLTAGE_DRIVEN)]
    for names in (off[:3], off[4:9], off[10:], off):
        model = paper
        for name in names:
            model = model.with_effect(catalogue()[name]())
        print(f"a new combination of {len(model.effects)} effects:", first_use(model, setup))
    print("a new effect:", first_use(paper.with_effect(register(Detent)()), setup))


if __name__ == "__main__":
    main()
