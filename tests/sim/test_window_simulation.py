"""Windows around a motion: the same trajectories as MuJoCo's, and friction that holds."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.replay.setups import Setup
from op3.robot import pose
from op3.servo import RobotModel, catalogue
from op3.servo.effects import CurrentPD, Motor
from op3.servo.machine_code import scalar
from op3.sim import (
    BatchSimulation,
    MeasuredMotion,
    TrajectoryDynamics,
    Window,
    WindowSimulation,
    load_model,
    trajectory_dynamics,
)
from op3.sim.window_steps import coupled, solve_dry, solve_linear
from tests.op3_table import JOINTS
from tests.secants import secant_values

LEG = ("r_hip_yaw", "r_hip_roll", "r_hip_pitch", "r_knee", "r_ank_pitch", "r_ank_roll")
PERIOD = 0.008
TICKS = 120


@pytest.fixture(scope="module")
def recorded():
    """A leg on the stand that follows three sines, as MuJoCo simulates it: setup, model, motion."""
    setup, model = Setup.of_mount("stand", robot="op3"), load_model("paper")
    time = np.arange(TICKS) * PERIOD
    columns = [JOINTS.index(joint) for joint in LEG]
    target = np.tile(pose("stand", "op3"), (TICKS, 1))
    for k, column in enumerate(columns):
        target[:, column] += 0.2 * np.sin(2 * np.pi * (0.7 + 0.3 * k) * time)
    target[:, JOINTS.index("r_hip_roll")] += 0.2  # away from the other leg
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


def secant(model, name: str):
    """The model with an effect at its first secant."""
    kind = catalogue()[name]
    model = model if name in model.effect_names else model.with_effect(kind())
    values = secant_values(kind.secants[0], {known: model.value(known) for known in model.parameters()})
    return model.with_values({known: value for known, value in values.items() if known in model.parameters()})


@pytest.mark.parametrize("name", ["latency", "compliance", "lugre", "velocity_filter", "voltage_sag", "packet_drop"])
def test_candidates_are_what_they_are_alone(recorded, name):
    """A candidate's windows are the same to the last bit alone or among others, and shared by threads."""
    model, motion = recorded
    windows = [Window(0, 20), Window(0, 60)]
    simulation = WindowSimulation(secant(model, name), [motion], windows, 10, LEG, dtype=torch.float64)
    friction = torch.tensor([0.05, 0.1, 0.2], dtype=torch.float64)
    together = simulation.run({"coulomb_friction": friction}, 3)
    alone = simulation.run({"coulomb_friction": friction[1:2]}, 1)
    simulation.num_threads = 4
    for key, channel in simulation.run({"coulomb_friction": friction}, 3).items():
        assert torch.equal(channel, together[key])
        assert torch.equal(channel[1], alone[key][0])


def test_edits_of_bodies_and_a_false_zero_change_the_dynamics(recorded):
    """Twice the edit at half the weight is the same; a zero error weighs its edit by how far a joint stands off."""
    model, motion = recorded
    rng = np.random.default_rng(0)

    def added(scale: float) -> TrajectoryDynamics:
        none = {name: np.zeros_like(value) for name, value in vars(motion.dynamics).items()}
        return TrajectoryDynamics(**{**none, "bias": scale * bias})

    bias = rng.normal(size=motion.dynamics.bias.shape)
    key = ("joint", "velocity")

    def run(model, changes, **values):
        simulation = WindowSimulation(model, [replace(motion, changes=changes)], [Window(0, 20)], 10, LEG)
        return simulation.run({name: torch.tensor([value]) for name, value in values.items()})[key]

    heavy, shifted = (model.with_effect(catalogue()[name]()) for name in ("link_mass", "encoder_offset"))
    plain = run(heavy, {("link_mass_offset", 3): added(1.0)}, link_mass_offset=0.0)
    once = run(heavy, {("link_mass_offset", 3): added(1.0)}, link_mass_offset=0.1)
    twice = run(heavy, {("link_mass_offset", 3): added(2.0)}, link_mass_offset=0.05)
    assert torch.equal(plain, run(model, {}))
    assert not torch.equal(plain, once)
    torch.testing.assert_close(once, twice)
    off = run(shifted, {("encoder_offset", 3): added(1.0)}, encoder_offset=0.02)
    assert not torch.allclose(off, run(shifted, {}, encoder_offset=0.02))


def test_gyroscopic_torques_do_not_throw_light_joints_about():
    """Two joints of 1 g dm^2 that turn each other at 200 rad/s keep the speed that they are off by, or lose it."""
    none, light = np.zeros((60, 2)), np.tile(1e-4 * np.eye(2) + 1e-6, (60, 1, 1))
    turning = np.tile(np.array([[0.0, 0.02], [-0.02, 0.0]]), (60, 1, 1))
    dynamics = TrajectoryDynamics(light, none, 0 * light, turning, none, np.zeros((60, 2, 3)))
    inputs = {"p_gain": none, "d_gain": none, "bus_voltage": none + 11.1}
    motion = MeasuredMotion(PERIOD, *[none] * 6, np.arange(60)[:, None] * PERIOD, inputs, dynamics, {})
    model = RobotModel((CurrentPD(), Motor())).with_values({"armature": 0.0})
    off = torch.full((1, 2), 0.5, dtype=torch.float64)
    windows = WindowSimulation(model, [motion], [Window(0, 10)], 40, ("one", "other"))
    speed = windows.run(velocity_offset=off)["joint", "velocity"][0, 0].norm(dim=-1)
    assert speed[0] == pytest.approx(0.5**0.5, rel=1e-3)
    assert (speed <= 1.01 * speed[0]).all()


def test_a_loop_in_the_servo_gets_what_the_servo_senses(recorded):
    """Where no reading is given the joints of a wrong log are not drawn towards it."""
    model, motion = recorded
    wrong = replace(motion, read_position=motion.position + 0.1)
    unread = replace(motion, read_position=np.full_like(motion.position, np.nan))
    ends = [WindowSimulation(model, [m], [Window(0, 40)], 25, LEG).run() for m in (motion, unread, wrong)]
    angles = [end["joint", "position"][0, 0, -1] for end in ends]
    assert (angles[1] - angles[0]).abs().max() < 0.1 * (angles[2] - angles[0]).abs().max()


def test_window_must_fit(recorded):
    """A window that begins before its lead, or ends behind the motion, is refused with both numbers."""
    model, motion = recorded
    with pytest.raises(ValueError, match="does not fit"):
        WindowSimulation(model, [motion], [Window(0, TICKS - 5)], 25, LEG)


@scalar
def dry(mass, total, velocity, force, bound, change, rooms, sweeps):
    """Sweeps over all joints as one limb."""
    for _ in range(sweeps):
        solve_dry(mass, total, velocity, force, bound, change, rooms, 0, len(change))


@scalar
def linear(mass, total, force, change, rows, first, last):
    """A limb's linear equations."""
    solve_linear(mass, total, force, change, rows, first, last)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_linear_step_solves_the_equations(seed):
    """Without dry friction the change of velocity is that of the linear equations, as numpy solves them."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6)) * 0.05
    mass, force = root @ root.T + np.eye(6) * 0.005, rng.normal(size=6) * 1e-3
    change, total = np.full(6, np.nan), np.diag(mass).copy()
    linear(mass, total, force, change, np.empty((6, 6)), 0, 6)
    np.testing.assert_allclose(change, np.linalg.solve(mass, force))
    alone = np.zeros(6)
    linear(mass, total, force, alone, np.empty((6, 6)), 2, 3)
    assert alone[2] == pytest.approx(force[2] / total[2])
    assert not alone[[0, 1, 3, 4, 5]].any()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_friction_solution_is_the_minimum(seed):
    """The sweeps minimise kinetic distance plus friction: no small move of any joint does better."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) * 0.05
    matrix = root @ root.T + np.diag(rng.uniform(0.005, 0.01, 3))
    velocity, force, bound = rng.normal(size=3) * 0.01, rng.normal(size=3) * 1e-3, rng.uniform(0, 2e-3, 3)
    found = np.zeros(3)
    dry(matrix, np.diag(matrix).copy(), velocity, force, bound, found, np.empty((2, 3)), 60)

    def cost(change: np.ndarray) -> float:
        return float(0.5 * change @ matrix @ change - change @ force + bound @ np.abs(velocity + change))

    for joint in range(3):
        for move in (1e-6, -1e-6):
            assert cost(found) <= cost(found + move * np.eye(3)[joint]) + 1e-12


def test_held_joint_stays_at_zero_and_what_is_no_number_shows():
    """Where friction can take the whole impulse, the joint's speed is exactly zero, coupled or not."""
    mass, total, force = np.array([[0.01, 0.004], [0.004, 0.02]]), np.array([0.01, 0.02]), np.array([1e-4, -2e-4])
    for pushed, bound, moves in ((force, 3e-4, False), (10 * force, 3e-4, True), (force, np.nan, True)):
        change = np.zeros(2)
        dry(mass, total, np.zeros(2), pushed, np.full(2, bound), change, np.empty((2, 2)), 1)
        assert change.all() == moves
    assert np.isnan(change).all()


def test_limbs_are_joints_that_masses_couple():
    """Two joints that push each other, and one alone."""
    mass = np.array([[[1.0, 0.1, 0.0], [0.1, 1.0, 0.0], [0.0, 0.0, 1.0]]])
    assert coupled(mass).tolist() == [[0, 2], [2, 3]]


def test_the_bus_falls_with_the_currents_that_it_lets_through(recorded):
    """Under a hard push of all joints a weak supply gives a sixth less."""
    model, motion = recorded
    pushed = {**motion.inputs, "p_gain": np.full_like(motion.position, 6.0)}
    pushed["position_target"] = motion.inputs["position_target"] + 1.0

    def currents(resistance: float) -> torch.Tensor:
        one = replace(motion, inputs=pushed, supply_resistance=resistance)
        return WindowSimulation(model, [one], [Window(0, 40)], 1, LEG).run()["joint", "current"][0, 0, -1].abs()

    assert (currents(0.5) < 0.85 * currents(0.0)).all()
