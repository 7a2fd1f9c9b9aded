"""The law in numpy: the same motion as in torch, whatever is on and whatever happens between steps."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import torch

from op3.robot import pose
from op3.servo import RobotModel, Signals, catalogue
from op3.servo.compiled_step import CompiledStep, Untranslatable
from op3.servo.effect import secant_values
from op3.servo.effects import Viscous
from op3.sim import BatchSimulation, load_model
from op3.tasks import Setup

SETUP = Setup.of_mount("stand")
STAND = pose("stand")


def simulation(model: RobotModel, translated: bool) -> BatchSimulation:
    made = BatchSimulation(
        SETUP.mj_model, SETUP.scene.joint_names, model, 2, base_body=SETUP.base_body, translated=translated
    )
    start = {"position_target": torch.from_numpy(STAND), "p_gain": torch.tensor(6.0), "d_gain": torch.tensor(0.1)}
    made.reset(SETUP.scene.initial_qpos(STAND), start)
    return made


def motion(made: BatchSimulation, ticks: int) -> torch.Tensor:
    """Two robots under different commands, one put back on the way, the other with its parameters set anew."""
    rows = []
    for tick in range(ticks):
        swing = torch.tensor([[0.3], [-0.2]]) * np.sin(0.3 * tick)
        made.command(position_target=torch.from_numpy(STAND) + swing, torque_enable=torch.tensor(float(tick != 9)))
        if tick == 6:
            made.reset(SETUP.scene.initial_qpos(STAND)[None], {}, 0.0, rows=np.array([1]))
        if tick == 12:
            made.set_parameters({})
        made.advance()
        measured = made.measure()
        rows.append(torch.cat([measured[("joint", name)] for name in ("position", "velocity", "current")], 1))
    return torch.stack(rows)


@pytest.mark.parametrize(
    "name", [name for name, kind in catalogue().items() if kind.secants and name != "position_servo"]
)
def test_the_law_in_numpy_is_the_law(name):
    """With any effect on at a size that matters, numpy and torch give the same logs, to rounding."""
    kind, model = catalogue()[name], load_model("paper")
    model = model if name in model.effect_names else model.with_effect(kind())
    values = secant_values(kind.secants[0], {known: model.value(known) for known in model.parameters()})
    model = model.with_values({known: value for known, value in values.items() if known in model.parameters()})
    first, second = simulation(model, True), simulation(model, False)
    np.testing.assert_allclose(motion(first, 16), motion(second, 16), rtol=0, atol=1e-8)
    assert first.translated
    assert not second.translated


@dataclass(frozen=True)
class Stubborn(Viscous):
    """Friction that decides in Python."""

    name: ClassVar[str] = "stubborn"
    parameters = ()

    def prepare(self, values, clock):
        return values

    def apply(self, signals, prepared):
        if bool((signals.speed > 0.5).any()):
            signals.friction_bound = signals.friction_bound + 0.01


def test_what_cannot_be_translated_stays_in_torch():
    """An effect that decides by the numbers of the moment is not frozen as it decided first."""
    model = load_model("paper").with_effect(Stubborn())
    first, second = simulation(model, True), simulation(model, False)
    assert torch.equal(motion(first, 8), motion(second, 8))
    assert not first.translated


@pytest.mark.parametrize(
    ("step", "reason"),
    [
        (lambda signals: signals.velocity.add_(1.0), "in place"),
        (lambda signals: setattr(signals, "speed", signals.velocity.cumsum(1)), "cumsum"),
        (lambda signals: setattr(signals, "speed", signals.velocity * float(signals.position.sum())), "numbers decide"),
    ],
    ids=["in place", "unknown", "a number"],
)
def test_refusals_name_the_operation(step, reason):
    """What is no fixed list of known operations is refused."""
    with pytest.raises(Untranslatable, match=reason):
        CompiledStep(step, Signals.zeros(2, 3), ("speed",))


def test_numbers_that_do_not_change_are_computed_once():
    """Of a step in which parameters meet parameters, only what depends on the signals is left."""
    share = torch.full((2, 3), 0.5, dtype=torch.float64)

    def step(signals: Signals) -> None:
        signals.speed = signals.velocity * torch.exp(share * share) + share

    step_in_numpy = CompiledStep(step, Signals.zeros(2, 3), ("speed",))
    step_in_numpy.inputs["velocity"][...] = 2.0
    step_in_numpy()
    np.testing.assert_allclose(step_in_numpy.outputs["speed"], 2.0 * np.exp(0.25) + 0.5, rtol=1e-15)
    assert len(step_in_numpy) == 2  # a product and a sum
