"""Resetting some simulations of a batch: they restart, the others do not notice."""

import numpy as np
import pytest
import torch

from op3.replay import Setup
from op3.robot import pose
from op3.servo import RobotModel, catalogue
from op3.sim import BatchSimulation, load_model

COMMANDS = {"p_gain": torch.tensor(6.0), "d_gain": torch.tensor(0.1)}


def simulation(num_sims: int, model: RobotModel | None = None) -> tuple[BatchSimulation, np.ndarray]:
    setup = Setup.of_mount("floor", robot="op3")
    model = model or load_model("paper")
    made = BatchSimulation(setup.mj_model, setup.scene.joint_names, model, num_sims, base_body=setup.base_body)
    return made, setup.scene.initial_qpos(pose("stand", "op3"))


def start(made: BatchSimulation, qpos: np.ndarray) -> None:
    made.reset(qpos, {"position_target": torch.from_numpy(pose("stand", "op3")), **COMMANDS}, 0.0)


def swing(made: BatchSimulation, ticks: int, first: int = 0) -> torch.Tensor:
    """Knees and hips follow a sine; the state after every tick, [tick, sim, state]."""
    states = []
    for tick in range(first, first + ticks):
        target = torch.from_numpy(pose("stand", "op3")) + 0.2 * np.sin(0.2 * tick)
        made.command(position_target=target)
        made.advance()
        states.append(torch.from_numpy(made.batch.state.copy()))
    return torch.stack(states)


def test_others_are_not_disturbed():
    """Simulations that are not reset go on to the last bit as if nothing had happened."""
    (touched, qpos), (untouched, _) = simulation(3), simulation(3)
    for made in (touched, untouched):
        start(made, qpos)
        swing(made, 10)
    rows = np.array([1])
    touched.reset(qpos[None], {"p_gain": torch.ones(1, 20)}, 0.0, rows=rows)
    assert torch.equal(swing(touched, 10, 10)[:, [0, 2]], swing(untouched, 10, 10)[:, [0, 2]])


def with_memory() -> RobotModel:
    """The paper's model and effects that remember: each at its first secant."""
    model = load_model("paper")
    for name in ("backlash", "velocity_filter", "lugre", "voltage_sag", "current_lag"):
        effect = catalogue()[name]()
        own = {p.name for p in effect.parameters}
        model = model.with_effect(effect, {n: v for n, v in effect.secants[0].items() if n in own})
    return model


@pytest.mark.parametrize("model", [load_model("paper"), with_memory()], ids=["paper", "memory"])
def test_rows_start_as_in_a_new_simulation(model):
    """A simulation that is reset alone moves to the last bit like one that was reset with all others."""
    (partly, qpos), (wholly, _) = simulation(2, model), simulation(2, model)
    start(partly, qpos)
    swing(partly, 7)
    commands = {"position_target": torch.from_numpy(pose("stand", "op3"))[None], **COMMANDS}
    partly.reset(qpos[None], commands, np.full((1, 26), 0.01), rows=np.array([0]))
    wholly.reset(qpos, {"position_target": torch.from_numpy(pose("stand", "op3")), **COMMANDS}, 0.01)
    for made in (partly, wholly):
        made.command(**COMMANDS)
    # the state's first number is time, which counts from the reset in both
    assert torch.equal(swing(partly, 10)[:, 0], swing(wholly, 10)[:, 0])


def test_measured_rows_are_refused():
    """Readings can place all simulations or none."""
    made, qpos = simulation(2)
    with pytest.raises(ValueError, match="give readings or rows, not both"):
        made.reset(qpos[None], measured=True, rows=np.array([0]))
