"""The law in numpy: the same motion as in torch, whatever is on and whatever happens between steps."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import torch

from op3.robot import pose
from op3.servo import RobotModel, catalogue
from op3.servo.effect import secant_values
from op3.servo.effects import Viscous
from op3.sim import BatchSimulation, load_model
from op3.tasks import Setup

SETUP = Setup.of_mount("floor")
STAND = torch.from_numpy(pose("stand"))
GAINS = {"p_gain": torch.tensor(6.0), "d_gain": torch.tensor(0.1)}

UNNOTICED = ("imu_mount", "gyro_bias", "minimum_duty")
"""Effects on the trunk's sensors, and on a drive by voltage: no joint here can show them."""

STRONGER = {"packet_drop": {"drop_probability": 0.5}}
"""Where so short a motion would show nothing at a first secant."""


def simulation(model: RobotModel, translated: bool) -> BatchSimulation:
    made = BatchSimulation(
        SETUP.mj_model, SETUP.scene.joint_names, model, 2, base_body=SETUP.base_body, translated=translated
    )
    made.reset(SETUP.scene.initial_qpos(pose("stand")), {"position_target": STAND, **GAINS})
    return made


def motion(made: BatchSimulation, ticks: int = 20) -> torch.Tensor:
    """Joints of two robots: commands of all kinds, one put back on the way, parameters set anew and changed."""
    rows = []
    for tick in range(ticks):
        swing = torch.tensor([[0.3], [-0.2]]) * np.sin(0.4 * tick)
        made.command(
            position_target=STAND + swing,
            p_gain=torch.tensor(4.0 + 0.1 * tick),
            torque_enable=torch.tensor(float(tick != 9)),
            bus_voltage=torch.tensor(12.0 - 0.05 * tick),
            temperature=torch.tensor(40.0 + tick),
        )
        if tick == 6:
            start = {"position_target": STAND[None] + 0.02, "p_gain": torch.tensor(3.0)}
            made.reset(SETUP.scene.initial_qpos(pose("stand"))[None], start, 0.01, rows=np.array([1]))
        if tick == 12:
            made.set_parameters({"viscous_friction": torch.tensor([0.02, 0.05])})
        made.advance()
        measured = made.measure()
        rows.append(torch.cat([measured["joint", name] for name in ("position", "velocity", "current")], 1))
    return torch.stack(rows)


@pytest.fixture(scope="module")
def plain() -> torch.Tensor:
    return motion(simulation(load_model("paper"), False))


def with_effect(name: str) -> RobotModel:
    """The paper's model with an effect of a size that matters."""
    kind, model = catalogue()[name], load_model("paper")
    model = model if name in model.effect_names else model.with_effect(kind())
    values = STRONGER.get(name) or secant_values(
        kind.secants[0], {known: model.value(known) for known in model.parameters()}
    )
    return model.with_values({known: value for known, value in values.items() if known in model.parameters()})


@pytest.mark.parametrize(
    "name", [name for name, kind in catalogue().items() if kind.secants and name != "position_servo"]
)
def test_the_law_in_numpy_is_the_law(name, plain):
    """With any effect on at a size that matters, numpy and torch give the same logs, to rounding."""
    first, second = simulation(with_effect(name), True), simulation(with_effect(name), False)
    in_torch = motion(second)
    np.testing.assert_allclose(motion(first), in_torch, rtol=0, atol=1e-8)
    assert first.translated
    assert not second.translated
    assert name in UNNOTICED or not torch.equal(in_torch, plain)  # else nothing was compared


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


def test_actions_may_carry_gradients():
    """A policy's actions are commands like others, wherever they come from."""
    made = simulation(load_model("paper"), True)
    action = STAND.clone().requires_grad_()
    made.command(position_target=action * 1.0)
    made.advance()
    assert not made.measure()["joint", "position"].requires_grad


def test_in_and_out_of_inference_mode():
    """Steps within inference mode and without may follow one another."""
    first, second = simulation(load_model("paper"), True), simulation(load_model("paper"), False)
    for made in (first, second):
        with torch.inference_mode():
            made.command(position_target=STAND + 0.1)
            made.advance()
        made.command(position_target=STAND - 0.1)
        made.advance()
        with torch.inference_mode():
            made.advance()
    ends = [made.measure()["joint", "position"].clone() for made in (first, second)]
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-9)
