"""The closed-form pendulum against MuJoCo, and its own invariants."""

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.scenes import build_bench
from op3.servo import RobotModel
from op3.servo.effects import (
    AntagonisticFriction,
    Backlash,
    BearingFriction,
    Coulomb,
    CurrentPD,
    DirectionalEfficiency,
    DirectionalFriction,
    EncoderOffset,
    Latency,
    LinkInertia,
    LoadFriction,
    LuGre,
    MinimumDuty,
    Motor,
    PositionServo,
    Stribeck,
    Viscous,
)
from op3.sim import BatchSimulation, PendulumSimulation, attach_servos

VALUES = {
    "torque_constant": 0.45,
    "terminal_resistance": 3.0,
    "armature": 0.001,
    "coulomb_friction": 0.006,
    "static_friction_excess": 0.008,
    "viscous_friction": 0.002,
    "forward_efficiency": 0.7,
    "backward_efficiency": 0.6,
    "encoder_offset": -0.1,
    "derivative_gain": 0.02,
}
MORE = {
    MinimumDuty(): {"minimum_duty": 0.05, "minimum_duty_fade": 0.1},
    LinkInertia(): {"gyration_squared": 3e-4},
    BearingFriction(): {"bearing_friction": 3e-4},
    LoadFriction(): {"load_friction": 0.1, "load_friction_excess": 0.1},
    DirectionalFriction(): {
        "motor_friction": 0.2,
        "external_friction": 0.1,
        "motor_friction_excess": 0.1,
        "external_friction_excess": 0.05,
    },
    AntagonisticFriction(): {"motor_square": 5.0, "external_square": 5.0},
    Backlash(damping_ratio=0.1): {"backlash_half_gap": 0.003, "contact_stiffness": 300.0},
    LuGre(): {"bristle_compliance": 0.01},
}
"""Further effects of a bench, with values that matter."""


def bench_model() -> RobotModel:
    effects = (
        PositionServo(),
        Motor(gear_ratio=1.0, drive="voltage"),
        DirectionalEfficiency(),
        Coulomb(),
        Stribeck(),
        Viscous(),
        EncoderOffset(),
    )
    return RobotModel(effects, bus_voltage=6.0).with_values(VALUES)


def with_more(*effects, neutral: bool = False) -> RobotModel:
    """The bench model with further effects, at their neutral values or at those of `MORE`."""
    model = bench_model()
    for effect in effects:
        model = model.with_effect(effect, MORE[effect])
        if neutral:
            model = model.with_values({p.name: p.neutral for p in effect.parameters if p.neutral is not None})
    return model


def trajectory(simulation, start) -> np.ndarray:
    simulation.reset(start, {"firmware_gain": 16.0, "position_target": start, "torque_enable": 1.0}, measured=True)
    places = []
    for step in range(3000):
        time = step * 0.001
        simulation.command(
            position_target=torch.tensor(1.2 * np.sin(3 * time), dtype=torch.float64),
            torque_enable=1.0 if time < 2.0 else 0.0,
        )
        simulation.advance()
        if step % 5 == 0:
            places.append(simulation.measure()[("joint", "position")][:, 0].clone().numpy())
    return np.array(places)


@pytest.mark.parametrize(("mass", "length"), [(0.26, 0.05), (0.46, 0.1)])
@pytest.mark.parametrize(
    "more", [(), tuple(MORE)[:3], tuple(MORE)[3:6], tuple(MORE)[6:]], ids=["plain", "shaft", "load", "play"]
)
def test_agrees_with_mujoco(mass, length, more):
    """Three seconds of driving and free swing, with the effects of a bench on, agree within 3 mrad on average."""
    scene = build_bench(mass, length)
    attach_servos(scene.joints)
    mj_model: mujoco.MjModel = scene.compile()
    model = with_more(*more)
    engine = BatchSimulation(mj_model, scene.joint_names, model, 1, control_period=0.001)
    closed = PendulumSimulation(model, torch.tensor([mass]), torch.tensor([length]))
    difference = trajectory(engine, torch.tensor([[0.0]])) - trajectory(closed, torch.tensor([[0.0]]))
    assert np.abs(difference).mean() < 3e-3


@pytest.mark.parametrize("effect", MORE, ids=lambda effect: effect.name)
def test_effects_matter_and_are_nothing_at_their_neutral_values(effect):
    """At its neutral values an effect leaves every bit of the motion as it was; otherwise it moves the pendulum."""

    def run(model) -> np.ndarray:
        return trajectory(PendulumSimulation(model, torch.tensor([0.3]), torch.tensor([0.07])), torch.tensor([[0.0]]))

    plain = run(bench_model())
    np.testing.assert_array_equal(run(with_more(effect, neutral=True)), plain)
    assert np.abs(run(with_more(effect)) - plain).mean() > 1e-4


def test_the_register_does_not_see_the_lift():
    """The duty that is measured is the controller's; the motor gets more."""
    model = with_more(MinimumDuty())
    simulation = PendulumSimulation(model, torch.tensor([0.3]), torch.tensor([0.07]))
    simulation.reset([[0.0]], {"firmware_gain": 8.0, "position_target": 0.05})
    simulation.advance()
    duty = simulation.measure()[("joint", "duty")].item()
    # the goal of the sensor's frame, with the offset of the bench model; the goal's rate is zero at the start
    assert duty == pytest.approx(8.0 * 0.166 * (0.05 + 0.1), rel=1e-6)
    assert simulation.signals.voltage.item() / 6.0 > duty + 0.03


@settings(max_examples=40, deadline=None)
@given(st.floats(-3, 3), st.floats(-5, 5), st.floats(0.0, 0.3))
def test_friction_only_takes_energy(angle, velocity, friction):
    """A pendulum without motor torque never gains energy beyond the integrator's ripple."""
    effects = (CurrentPD(), Latency(), Motor(), Coulomb())
    values = {"coulomb_friction": friction, "armature": 0.001, "torque_constant": 1e-6, "command_latency": 0.0}
    simulation = PendulumSimulation(
        RobotModel(effects).with_values(values), torch.tensor([0.4]), torch.tensor([0.1]), timestep=0.001
    )
    simulation.reset([[angle]], {"p_gain": 0.0, "d_gain": 0.0}, [[velocity]])

    def energy() -> float:
        signals = simulation.signals
        kinetic = 0.5 * (0.4 * 0.01 + 0.001) * signals.velocity.item() ** 2
        return kinetic - 0.4 * 9.81 * 0.1 * np.cos(signals.position.item())

    start = energy()
    for _ in range(500):
        simulation.advance()
    assert energy() <= start + 0.02


def test_a_hold_inside_the_friction_does_not_move_at_all():
    """Stiction is exact: below the bound the velocity is zero."""
    model = RobotModel((CurrentPD(), Motor(), Coulomb())).with_values({"coulomb_friction": 0.25})
    simulation = PendulumSimulation(model, torch.tensor([0.4]), torch.tensor([0.05]))
    simulation.reset([[1.0]], {"p_gain": 0.0, "d_gain": 0.0})
    for _ in range(1000):
        simulation.advance()
    assert simulation.signals.position.item() == 1.0
