"""Windows around a motion: the same trajectories as MuJoCo's, and friction that holds."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.robot import JOINTS, pose
from op3.servo import catalogue
from op3.servo.effect import secant_values
from op3.sim import (
    BatchSimulation,
    MeasuredMotion,
    Window,
    WindowSimulation,
    load_model,
    trajectory_dynamics,
)
from op3.sim.joint_step import between, pull_back, solve_dry, solve_linear
from op3.sim.translated import Translated
from op3.tasks.setups import Setup

LEG = ("r_hip_yaw", "r_hip_roll", "r_hip_pitch", "r_knee", "r_ank_pitch", "r_ank_roll")
PERIOD = 0.008
TICKS = 120


@pytest.fixture(scope="module")
def recorded():
    """A leg on the stand that follows three sines, as MuJoCo simulates it: setup, model, motion."""
    setup, model = Setup.of_mount("stand"), load_model("paper")
    time = np.arange(TICKS) * PERIOD
    columns = [JOINTS.index(joint) for joint in LEG]
    target = np.tile(pose("stand"), (TICKS, 1))
    for k, column in enumerate(columns):
        target[:, column] += 0.2 * np.sin(2 * np.pi * (0.7 + 0.3 * k) * time)
    simulation = BatchSimulation(
        setup.mj_model, setup.scene.joint_names, model, 1, base_body=setup.base_body, joint_names=setup.joints
    )
    gains = {"p_gain": torch.full((1, 20), 4.0), "d_gain": torch.full((1, 20), 0.1)}
    simulation.reset(target[0], {"position_target": torch.tensor(target[:1]), **gains})
    rows = []
    for tick in range(TICKS):
        rows.append(
            {key[1]: value.numpy()[0, columns] for key, value in simulation.measure().items() if key[0] == "joint"}
        )
        simulation.command(position_target=torch.tensor(target[tick : tick + 1]))
        simulation.advance()
    q, v, i = (np.stack([row[name] for row in rows]) for name in ("position", "velocity", "current"))
    names = [setup.scene.joint_names[column] for column in columns]
    motion = MeasuredMotion(
        period=PERIOD,
        position=q,
        velocity=v,
        acceleration=np.gradient(v, PERIOD, axis=0),
        read_position=q,
        read_velocity=v,
        current=i,
        time=time[:, None],
        inputs={
            "position_target": target[:, columns],
            "p_gain": np.full_like(q, 4.0),
            "d_gain": np.full_like(q, 0.1),
            "bus_voltage": np.full_like(q, model.bus_voltage),
        },
        dynamics=trajectory_dynamics(setup.mj_model, names, q, v, setup.scene.initial_qpos(target[0])),
        changes={},
    )
    return model, motion


def test_windows_follow_mujoco(recorded):
    """A fifth of a second from MuJoCo's own states ends within 0.3 mrad and 5 mrad/s of MuJoCo's trajectory."""
    model, motion = recorded
    windows = [Window(0, tick) for tick in range(8, TICKS - 26, 9)]
    channels = WindowSimulation(model, [motion], windows, 25, LEG).run()
    for name, truth, tolerance in (("position", motion.position, 3e-4), ("velocity", motion.velocity, 5e-3)):
        want = np.stack([truth[w.tick : w.tick + 26] for w in windows])
        error = channels["joint", name].numpy()[0] - want
        assert np.sqrt(np.square(error).mean()) < tolerance


def test_candidates_are_what_they_are_alone(recorded):
    """A candidate's windows are the same, to rounding, simulated alone or among others, in chunks or at once."""
    model, motion = recorded
    simulation = WindowSimulation(model, [motion], [Window(0, 20), Window(0, 60)], 10, LEG)
    friction = torch.tensor([0.05, 0.1, 0.2], dtype=torch.float64)
    together = simulation.run({"coulomb_friction": friction}, 3)
    alone = simulation.run({"coulomb_friction": friction[1:2]}, 1)
    pieces = simulation.run({"coulomb_friction": friction}, 3, chunk=2)
    key = ("joint", "position")
    assert torch.allclose(together[key][1], alone[key][0], rtol=0, atol=1e-6)
    assert torch.allclose(together[key], pieces[key], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "name",
    ["latency", "backlash", "compliance", "lugre", "velocity_filter", "current_lag", "current_offset", "load_friction"],
)
def test_windows_in_numpy_are_those_in_torch(recorded, name, monkeypatch):
    """With laws, memory and springs that are balanced at the start, numpy and torch agree to rounding."""
    model, motion = recorded
    translate, made = Translated.of, []
    monkeypatch.setattr(Translated, "of", lambda *arguments: made.append(translate(*arguments)) or made[-1])
    kind = catalogue()[name]
    model = model if name in model.effect_names else model.with_effect(kind())
    values = secant_values(kind.secants[0], {known: model.value(known) for known in model.parameters()})
    model = model.with_values({known: value for known, value in values.items() if known in model.parameters()})
    friction = {"coulomb_friction": torch.tensor([0.05, 0.2], dtype=torch.float64)}
    in_numpy, in_torch = (
        WindowSimulation(
            model, [motion], [Window(0, 20), Window(0, 60)], 12, LEG, dtype=torch.float64, translated=translated
        ).run(friction, 2)
        for translated in (True, False)
    )
    assert len(made) == 1
    assert made[0] is not None
    for key, channel in in_torch.items():
        np.testing.assert_allclose(in_numpy[key], channel, rtol=0, atol=1e-9, err_msg=str(key))


@pytest.mark.parametrize("name", ["latency", "backlash", "lugre", "velocity_filter", "current_lag", "voltage_sag"])
def test_runs_with_other_parameters_take_up_the_translation(recorded, name, monkeypatch):
    """Whether a run starts from a translation of its own or from an earlier run's, its numbers are the same."""
    renew, renewed = Translated.renew, []
    monkeypatch.setattr(Translated, "renew", lambda *arguments: renewed.append(renew(*arguments)) or renewed[-1])
    model, motion = recorded
    kind = catalogue()[name]
    model = model if name in model.effect_names else model.with_effect(kind())
    values = secant_values(kind.secants[0], {known: model.value(known) for known in model.parameters()})
    model = model.with_values({known: value for known, value in values.items() if known in model.parameters()})
    windows = [Window(0, 20), Window(0, 60)]
    used = WindowSimulation(model, [motion], windows, 8, LEG)
    for friction in (0.05, 0.1, 0.02):
        parameters = {
            "coulomb_friction": torch.tensor([friction, 0.2], dtype=torch.float64),
            "armature": torch.tensor([0.01, 0.01 + 0.1 * friction], dtype=torch.float64),
        }
        fresh = WindowSimulation(model, [motion], windows, 8, LEG).run(parameters, 2)
        for key, channel in used.run(parameters, 2).items():
            np.testing.assert_array_equal(channel, fresh[key], err_msg=str(key))
    assert renewed == [name != "backlash"] * 2  # which lets its parameters decide what a step does


def test_the_same_windows_under_another_model(recorded):
    """What shares the gathered motion finds what is gathered anew, and leaves the first simulation as it was."""
    model, motion = recorded
    other = model.with_effect(catalogue()["load_friction"](), {"load_friction": 0.1})
    windows = [Window(0, 20), Window(0, 60)]
    first = WindowSimulation(model, [motion], windows, 10, LEG)
    before, key = first.run()["joint", "position"], ("joint", "position")
    assert torch.equal(first.under(other).run()[key], WindowSimulation(other, [motion], windows, 10, LEG).run()[key])
    assert torch.equal(first.run()[key], before)
    assert not torch.equal(first.under(other).run()[key], before)


@given(seed=st.integers(0, 10**6), edits=st.integers(0, 3))
def test_dynamics_between_ticks_with_edits(seed, edits):
    """A straight line between two ticks, of the plain dynamics and of every edit at its weight."""
    rng = np.random.default_rng(seed)
    plain, added = rng.normal(size=(2, 4, 5)), rng.normal(size=(edits, 2, 4, 5))
    weights = rng.normal(size=(edits, 3, 5)) * (rng.random((edits, 3, 1)) < 0.7)
    out, share = np.empty((4, 3 if edits else 1, 5)), rng.random()
    places = np.array([one.ctypes.data for one in added], np.int64)
    between(plain[0], plain[1], share, weights, places, out)
    line = np.array([1.0 - share, share])
    want = np.einsum("t,tew->ew", line, plain)[:, None] + np.einsum("t,ntew,ncw->ecw", line, added, weights)
    np.testing.assert_allclose(np.broadcast_to(out, want.shape), want, rtol=0, atol=1e-12)


@given(seed=st.integers(0, 10**6))
def test_pull_is_gradient_and_damping_within_limbs(seed):
    """Matrices of two limbs times how far and how much faster joints are than was measured."""
    rng = np.random.default_rng(seed)
    gradient, damping = rng.normal(size=(4, 4, 2, 5)), rng.normal(size=(4, 4, 5))
    q, v, accounted = rng.normal(size=(3, 4, 2, 5))
    measured_q, measured_v = rng.normal(size=(2, 4, 5))
    out = np.empty_like(q)
    pull_back(gradient, damping, q, v, measured_q, measured_v, accounted, np.array([[0, 3], [3, 4]]), out)
    linked = np.array([[1, 1, 1, 0]] * 3 + [[0, 0, 0, 1]])
    away, faster = q - accounted - measured_q[:, None], v - measured_v[:, None]
    want = np.einsum("ik,ikcw,kcw->icw", linked, gradient, away) + np.einsum("ik,ikw,kcw->icw", linked, damping, faster)
    np.testing.assert_allclose(out, want, rtol=0, atol=1e-12)


def test_window_must_fit(recorded):
    """A window that begins before its lead, or ends behind the motion, is refused with both numbers."""
    model, motion = recorded
    with pytest.raises(ValueError, match="does not fit"):
        WindowSimulation(model, [motion], [Window(0, TICKS - 5)], 25, LEG)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_linear_step_solves_the_equations(seed):
    """Without dry friction the change of velocity is that of the linear equations, as numpy solves them."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(5, 6, 6)) * 0.05
    matrix = root @ root.transpose(0, 2, 1) + np.eye(6) * 0.005
    force = rng.normal(size=(5, 6)) * 1e-3
    mass, total = np.moveaxis(matrix, 0, -1).copy(), np.diagonal(matrix, 0, 1, 2).T.copy()
    change = np.full_like(total, np.nan)
    solve_linear(mass, total, force.T.copy(), change, 0, 6)
    assert np.allclose(change.T, np.linalg.solve(matrix, force[..., None])[..., 0])
    alone = np.zeros_like(total)
    solve_linear(mass, total, force.T.copy(), alone, 2, 3)
    assert np.allclose(alone[2], force[:, 2] / total[2])
    assert not alone[[0, 1, 3, 4, 5]].any()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_friction_solution_is_the_minimum(seed):
    """The sweeps minimise kinetic distance plus friction: no small move of any joint does better."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) * 0.05
    matrix = root @ root.T + np.diag(rng.uniform(0.005, 0.01, 3))
    velocity, force, bound = rng.normal(size=3) * 0.01, rng.normal(size=3) * 1e-3, rng.uniform(0, 2e-3, 3)
    change = np.zeros((3, 1))
    known = [np.diag(matrix), velocity, force, bound]
    for _ in range(60):
        solve_dry(matrix[..., None], *(each[:, None].copy() for each in known), change, 0, 3)
    found = change[:, 0]

    def cost(change: np.ndarray) -> float:
        return float(0.5 * change @ matrix @ change - change @ force + bound @ np.abs(velocity + change))

    for joint in range(3):
        for move in (1e-6, -1e-6):
            assert cost(found) <= cost(found + move * np.eye(3)[joint]) + 1e-12


def test_held_joint_stays_at_zero():
    """Where friction can take the whole impulse, the joint's speed is exactly zero, coupled or not."""
    mass = np.array([[0.01, 0.004], [0.004, 0.02]])[..., None]
    total, force = np.array([[0.01], [0.02]]), np.array([[1e-4], [-2e-4]])
    change = np.zeros((2, 1))
    solve_dry(mass, total, np.zeros((2, 1)), force, np.full((2, 1), 3e-4), change, 0, 2)
    assert not change.any()
    solve_dry(mass, total, np.zeros((2, 1)), 10 * force, np.full((2, 1), 3e-4), change, 0, 2)
    assert change.all()


def test_the_bus_falls_with_the_currents_that_it_lets_through(recorded):
    """Under a hard push of all joints a weak supply gives a sixth less, in numpy as in torch."""
    model, motion = recorded
    pushed = {**motion.inputs, "p_gain": np.full_like(motion.position, 6.0)}
    pushed["position_target"] = motion.inputs["position_target"] + 1.0
    weak = replace(motion, inputs=pushed, supply_resistance=0.5)

    def currents(one: MeasuredMotion, translated: bool) -> torch.Tensor:
        simulation = WindowSimulation(model, [one], [Window(0, 40)], 1, LEG, translated=translated, dtype=torch.float64)
        return simulation.run()["joint", "current"][0, 0, -1].abs()

    fallen = currents(weak, True)
    assert torch.allclose(fallen, currents(weak, False), rtol=0, atol=1e-9)
    assert (fallen < 0.85 * currents(replace(weak, supply_resistance=0.0), True)).all()


def test_friction_that_is_no_number_shows():
    """A joint whose friction diverged does not look as if it was held."""
    one = np.ones((1, 1))
    change = np.zeros((1, 1))
    solve_dry(0.01 * one[None], 0.01 * one, one, 0.001 * one, np.nan * one, change, 0, 1)
    assert np.isnan(change).all()
