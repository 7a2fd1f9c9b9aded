"""Effects that need bodies, springs or ground, against integration in fine steps, MuJoCo's own elements and statics."""

import mujoco
import numpy as np
import pytest
import torch

from op3.replay import Setup
from op3.servo import Effect, RobotModel
from op3.servo.effects import (
    Backlash,
    CableSpring,
    Cogging,
    Compliance,
    Coulomb,
    CurrentLag,
    CurrentPD,
    FootCompliance,
    FootFriction,
    GroundTilt,
    Latency,
    LinkCentreOfMass,
    LinkMass,
    LuGre,
    Motor,
    PositionServo,
)
from op3.sim import BatchSimulation, attach_servos

RATIO = 0.1
"""Damping of contacts, more than that of gears: without it 2 s of rattling are a matter of chance."""

ARMATURE, LINK, MOMENT = 0.005, 0.3 * 0.1**2 + 1e-4, 0.3 * 9.81 * 0.1
"""Of the pendulum of `conftest`: inertias [kg m^2] of rotor and link, and largest moment of gravity [N m]."""
MOTOR = {"torque_constant": 0.006, "terminal_resistance": 5.0, "armature": ARMATURE}
CONSTANT = 0.006 * 353.5
FINE = (10, 1e-4, False)
"""MuJoCo's motor in steps of 0.1 ms, without gravity."""


def simulation(
    hinge, *effects: Effect, timestep=0.001, gravity=True, period=0.008, bus_voltage=100.0, **values
) -> BatchSimulation:
    """The pendulum with a current-driven servo and these effects."""
    root, joint = hinge(timestep=timestep, gravity=gravity)
    attach_servos([joint])
    model = RobotModel((CurrentPD(), Motor(), *effects), bus_voltage=bus_voltage).with_values({**MOTOR, **values})
    mj_model = mujoco.MjModel.from_xml_string(root.to_xml_string())
    return BatchSimulation(mj_model, ["hinge"], model, 1, control_period=period)


def _let_go(sim: BatchSimulation, load: float, *given) -> None:
    """Start with this load on the servo [N m], which tells on which flank a gap begins."""
    sim.reset(*given)
    sim.signals.load_torque = load
    sim.law.reset()


def target(time: float) -> float:
    return 0.4 * np.sin(4.0 * time)


def tracked(sim, duration: float) -> np.ndarray:
    """Positions at the ticks while the servo follows `target`."""
    sim.reset([0.0], {"p_gain": 3.0, "d_gain": 0.1})
    places = []
    for tick in range(round(duration / 0.008)):
        places.append(sim.measure()[("joint", "position")].item())
        sim.command(position_target=target(tick * 0.008))
        sim.advance()
    return np.array(places)


def two_bodies(half_gap: float, stiffness: float, coulomb: float, duration: float, ratio: float) -> np.ndarray:
    """The same motion of rotor and link with a spring and a gap between them, integrated in steps of 0.02 ms."""
    step, every = 2e-5, 400
    damping = 2 * ratio * np.sqrt(stiffness * ARMATURE)
    rotor = rate = link = speed = current = 0.0
    places = []
    for k in range(round(duration / step)):
        if k % every == 0:
            places.append(link)
            current = np.clip(3.0 * (target(k * step) - link) - 0.1 * speed, -2.3, 2.3)
        apart = rotor - link
        side = np.sign(apart) if abs(apart) > half_gap else 0.0
        torque = stiffness * (apart - side * half_gap) + damping * (rate - speed) if side or half_gap == 0 else 0.0
        if half_gap > 0 and torque * side < 0:
            torque = 0.0
        free = rate + step * (CONSTANT * current - torque) / ARMATURE
        rate = np.copysign(max(abs(free) - step * coulomb / ARMATURE, 0.0), free)
        speed += step * (torque - MOMENT * np.sin(link)) / LINK
        rotor += step * rate
        link += step * speed
    return np.array(places)


def limited_current(half_gap: float, stiffness: float, voltage: float, target: float, duration: float) -> np.ndarray:
    """The current at the ticks while a low voltage drives a loose gear to a target from rest, in steps of 0.02 ms."""
    step, every = 2e-5, 400
    damping = 2 * RATIO * np.sqrt(stiffness * ARMATURE)
    rotor = rate = link = speed = wanted = current = 0.0
    currents = []
    for k in range(round(duration / step)):
        if k % every == 0:
            wanted = np.clip(8.0 * (target - link) - 0.1 * speed, -2.3, 2.3)
            currents.append(current)
        ends = [(sign * voltage - CONSTANT * rate) / MOTOR["terminal_resistance"] for sign in (-1.0, 1.0)]
        current = np.clip(wanted, *ends)
        apart = rotor - link
        side = np.sign(apart) if abs(apart) > half_gap else 0.0
        torque = stiffness * (apart - side * half_gap) + damping * (rate - speed) if side else 0.0
        torque = torque if torque * side > 0 else 0.0
        rate += step * (CONSTANT * current - torque) / ARMATURE
        speed += step * (torque - MOMENT * np.sin(link)) / LINK
        rotor += step * rate
        link += step * speed
    return np.array(currents[1:])


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize(
    ("half_gap", "ratio", "duration"), [(0.002, RATIO, 2.0), (0.005, RATIO, 2.0), (0.005, Backlash.damping_ratio, 0.48)]
)
def test_backlash_at_1_ms_is_that_of_fine_steps(hinge, half_gap, ratio, duration):
    """The motion with play differs from that without; most of the difference is there at 1 ms."""
    truth = two_bodies(half_gap, 300.0, 0.05, duration, ratio)
    without = tracked(simulation(hinge, Coulomb(), coulomb_friction=0.05), duration)
    values = {"coulomb_friction": 0.05, "backlash_half_gap": half_gap, "contact_stiffness": 300.0}
    ours = tracked(simulation(hinge, Coulomb(), Backlash(damping_ratio=ratio), **values), duration)
    assert rms(ours - truth) < 0.45 * rms(without - truth)


@pytest.mark.parametrize("stiffness", [100.0, 500.0])
def test_nothing_but_the_contact_damps_a_contact(hinge, stiffness):
    """A rotor pressed into a soft gear swings on without damping; with it the swing falls off as the ratio says."""
    left = []
    for ratio in (0.0, 0.04):
        values = {"gear_compliance": 1 / stiffness, "coulomb_friction": 0.0}
        sim = simulation(hinge, Coulomb(), Compliance(damping_ratio=ratio), gravity=False, period=0.001, **values)
        _let_go(sim, 1.0, [0.0], {"p_gain": 0.0, "d_gain": 0.0})
        swing = []
        for _ in range(400):
            sim.advance()
            swing.append(sim.measure()[("joint", "velocity")].item())
        left.append(np.abs(swing[-60:]).max() / np.abs(swing[:60]).max())
    assert left[0] > 0.97
    assert left[1] < 0.3


def test_a_limited_current_tells_of_the_rotor_not_of_the_link(hinge):
    """In the gap the rotor races ahead, and its back-EMF leaves less current than the link's, which still rests."""
    values = {"coulomb_friction": 0.0, "backlash_half_gap": 0.01, "contact_stiffness": 300.0}
    ticks, voltage = 6, 6.0
    truth = limited_current(0.01, 300.0, voltage, 0.5, (ticks + 1) * 0.008)
    sim = simulation(hinge, Coulomb(), Backlash(damping_ratio=RATIO), bus_voltage=voltage, timestep=2.5e-4, **values)
    sim.reset([0.0], {"p_gain": 8.0, "d_gain": 0.1, "position_target": 0.0})
    sim.command(position_target=0.5)
    ours, by_link = [], []
    for _ in range(ticks):
        sim.advance()
        seen = sim.measure()
        ours.append(seen[("joint", "current")].item())
        by_link.append((voltage - CONSTANT * seen[("joint", "velocity")].item()) / MOTOR["terminal_resistance"])
    assert np.abs(by_link - truth[:ticks]).max() > 0.2
    np.testing.assert_allclose(ours, truth[:ticks], atol=0.06)


@pytest.mark.parametrize("latency", [0.0028, 0.0136])
@pytest.mark.parametrize("lag", [None, 0.0, 0.0005])
def test_a_command_that_arrives_within_a_step_is_read_as_in_fine_steps(hinge, latency, lag):
    """What a blocked servo reads at a tick shortly after an arrival is the command, as far as the current has come."""

    def currents(timestep: float) -> np.ndarray:
        more = () if lag is None else (CurrentLag(),)
        values = {"command_latency": latency, "coulomb_friction": 50.0} | (
            {} if lag is None else {"current_time_constant": lag}
        )
        sim = simulation(hinge, Latency(), *more, Coulomb(), timestep=timestep, gravity=False, **values)
        sim.reset([0.0], {"p_gain": 3.0, "d_gain": 0.0})
        seen = []
        for tick in range(40):
            sim.command(position_target=target(6 * tick * 0.008))
            sim.advance()
            seen.append(sim.measure()[("joint", "current")].item())
        return np.array(seen)

    truth = currents(5e-5)
    assert rms(currents(1e-3) - truth) < 0.01 * rms(np.diff(truth))


def test_both_transmissions_together_are_one_in_series(hinge):
    """Backlash with the gear's compliance beside it is backlash with the sum of both compliances."""
    common = {"backlash_half_gap": 0.003, "coulomb_friction": 0.05}
    both = simulation(
        hinge,
        Coulomb(),
        Backlash(damping_ratio=RATIO),
        Compliance(damping_ratio=RATIO),
        contact_stiffness=300.0,
        gear_compliance=0.005,
        **common,
    )
    one = simulation(hinge, Coulomb(), Backlash(damping_ratio=RATIO), contact_stiffness=1 / (1 / 300 + 0.005), **common)
    np.testing.assert_allclose(tracked(both, 0.5), tracked(one, 0.5), atol=1e-9)


def test_the_load_tells_on_which_flank_a_gap_begins(hinge):
    """A link hanging to one side under its load starts on the flank that carries it, and stays there."""
    values = {"backlash_half_gap": 0.005, "contact_stiffness": 300.0, "coulomb_friction": 5.0}
    sim = simulation(hinge, Coulomb(), Backlash(damping_ratio=RATIO), **values)
    load = -MOMENT * np.sin(1.0)  # gravity pulls back
    _let_go(sim, load, [1.0])
    for _ in range(50):
        sim.advance()
    assert sim.measure()[("joint", "position")].item() == pytest.approx(1.0, abs=2e-4)
    _let_go(sim, -load, [1.0])  # the other flank: the link falls through the gap, and bends the teeth
    for _ in range(100):
        sim.advance()
    assert sim.measure()[("joint", "position")].item() == pytest.approx(1.0 - 0.010 - 2 * -load / 300, abs=1e-4)


@pytest.mark.parametrize("wheels", [0.0, 0.0008])
def test_what_lies_behind_a_spring_swings_with_the_link(hinge, wheels):
    """Behind a rotor that friction holds, the link swings at ``sqrt((K + m g l cos q) / (J + J_o))``."""
    stiffness = 50.0
    values = {"coulomb_friction": 50.0, "gear_compliance": 1 / stiffness, "wheel_inertia": wheels, "armature": ARMATURE}
    sim = simulation(hinge, Coulomb(), Compliance(damping_ratio=0.0), timestep=1e-4, period=0.001, **values)
    _let_go(sim, -1e-9, [0.05])  # the spring is not bent, and gravity pulls
    places = []
    for _ in range(400):
        sim.advance()
        places.append(sim.measure()[("joint", "position")].item())
    swing = np.array(places) - np.mean(places)
    turns = np.flatnonzero(np.diff(np.sign(swing)) != 0)
    frequency = np.pi * (len(turns) - 1) / ((turns[-1] - turns[0]) * 0.001)
    assert frequency == pytest.approx(np.sqrt((stiffness + MOMENT) / (LINK + wheels)), rel=0.02)


def driven(hinge, *effects: Effect, **values) -> tuple[np.ndarray, list[float]]:
    """Positions and voltages of the same servo driven by voltage, every millisecond."""
    root, joint = hinge(gravity=False)
    attach_servos([joint])
    loop = PositionServo(error_gain=1.0, max_duty=1.0, goal_speed=1e9)
    model = RobotModel((loop, Motor(drive="voltage"), *effects)).with_values({**MOTOR, **values})
    mj_model = mujoco.MjModel.from_xml_string(root.to_xml_string())
    sim = BatchSimulation(mj_model, ["hinge"], model, 1, control_period=0.001)
    sim.reset([0.0], {"firmware_gain": 0.4, "position_target": 0.0})
    places, voltages = [], []
    for tick in range(600):
        sim.command(position_target=0.4 * np.sin(0.01 * tick))
        sim.advance()
        places.append(sim.measure()[("joint", "position")].item())
        voltages.append(sim.signals.voltage.item())
    return np.array(places), voltages


def test_cogging_is_that_of_mujocos_dc_motor(hinge, dc_motor):
    """The ripple of MuJoCo's own motor, fed with the same voltages, gives the same motion."""
    values = {"cogging_amplitude": 0.04, "cogging_phase": 0.5, "cogging_periods": 20.0}
    ours, voltages = driven(hinge, Cogging(), **values)
    theirs = dc_motor(voltages, *FINE, cogging=[0.04, 20.0, 0.5])
    plain = dc_motor(voltages, *FINE)
    assert rms(ours - theirs) < 0.05 * rms(plain - theirs)


def test_bristles_are_those_of_mujocos_dc_motor(hinge, dc_motor):
    """LuGre friction of MuJoCo's own motor, at a tenth of the step and without bristle damping."""
    ours, voltages = driven(hinge, Coulomb(), LuGre(), coulomb_friction=0.1, bristle_compliance=0.01)
    theirs = dc_motor(voltages, *FINE, lugre=[100.0, 0.0, 0.1, 0.1, 0.1])
    rigid = dc_motor(driven(hinge, Coulomb(), coulomb_friction=0.1)[1], *FINE)
    assert rms(ours - theirs) < 0.1 * rms(rigid - theirs)


def test_a_cable_pulls_without_loading_the_gear(hinge):
    """At rest the spring takes its part of gravity's moment, and the gear sees the rest."""
    sim = simulation(hinge, CableSpring(), cable_stiffness=0.2, cable_rest_angle=0.3)
    sim.reset([0.3], {"p_gain": 6.0, "position_target": 1.0, "d_gain": 0.3})
    for _ in range(400):
        sim.advance()
    position = sim.signals.position.item()
    needed = MOMENT * np.sin(position) + 0.2 * (position - 0.3)
    assert sim.signals.motor_torque.item() == pytest.approx(needed, rel=1e-3)
    load, pull = sim.signals.load_torque.item(), sim.signals.cable_spring_pull.item()
    assert load == pytest.approx(-MOMENT * np.sin(position), rel=1e-3)
    assert load + pull == pytest.approx(-needed, rel=1e-3), "what the gear sees"


def test_links_weigh_what_was_added_where_it_was_added(hinge):
    """Statics: m g l sin(q) with the added mass, and the shifted centre of mass."""
    sim = simulation(hinge, LinkMass(), LinkCentreOfMass(), link_mass_offset=0.1, link_com_offset_x=0.02)
    sim.reset([0.5], {"p_gain": 6.0, "d_gain": 0.3, "position_target": 0.5})
    for _ in range(400):
        sim.advance()
    angle = sim.signals.position.item()
    moment = 0.4 * 9.81 * (0.1 * np.sin(angle) - 0.02 * np.cos(angle))
    assert sim.signals.motor_torque.item() == pytest.approx(moment, rel=1e-3)


def test_a_tilted_ground_is_a_tilted_stand():
    """Gravity turned under a level stand loads all joints as a stand that is really tilted does, and the IMU agrees."""
    roll, pitch = 0.04, -0.03
    readings = []
    for tilt, effects, values in (
        ((roll, pitch), (), {}),
        ((0.0, 0.0), (GroundTilt(),), {"ground_roll": roll, "ground_pitch": pitch}),
    ):
        setup = Setup.of_mount("stand", tilt=tilt, robot="op3")
        model = RobotModel((CurrentPD(), Motor(), *effects)).with_values({**MOTOR, **values})
        sim = BatchSimulation(setup.mj_model, setup.scene.joint_names, model, 1, base_body=setup.base_body)
        start = torch.full((20,), 0.1, dtype=torch.float64)
        sim.reset(setup.scene.initial_qpos(start.numpy()), {"position_target": start, "p_gain": 5.0, "d_gain": 0.2})
        for _ in range(50):
            sim.advance()
        seen = sim.measure()
        readings.append(torch.cat([seen[("joint", "position")][0], seen[("imu", "orientation")][0]]))
    torch.testing.assert_close(readings[0], readings[1], atol=1e-9, rtol=0)


def on_floor(num_sims: int, *effects: Effect, **values: torch.Tensor | float) -> BatchSimulation:
    """OP3s on the floor that have stood for 0.8 s."""
    setup = Setup.of_mount("floor", robot="op3")
    model = RobotModel((CurrentPD(), Motor(), Coulomb(), *effects)).with_values(MOTOR)
    sim = BatchSimulation(setup.mj_model, setup.scene.joint_names, model, num_sims, base_body=setup.base_body)
    sim.set_parameters(values)
    start = torch.zeros(20, dtype=torch.float64)
    sim.reset(setup.scene.initial_qpos(start.numpy()), {"position_target": start, "p_gain": 6.0, "d_gain": 0.2})
    for _ in range(100):
        sim.advance()
    assert not sim.failed.any()
    return sim


def test_feet_slide_where_friction_is_less_than_the_slope():
    """On a slope of 0.04 a robot with friction 0.8 stays, one with 0.008 slides by about half g sin(slope) t^2."""
    sim = on_floor(2, FootFriction(), GroundTilt(), ground_pitch=0.04, foot_friction_error=torch.tensor([0.0, -0.99]))
    moved = sim._qpos[:, 0]
    assert moved[0].abs() < 0.01
    expected = 0.5 * 9.81 * (np.sin(0.04) - 0.008) * 0.8**2
    assert moved[1].item() == pytest.approx(expected, rel=0.2)


def test_softer_contacts_give_way_further():
    """In stance the feet sink in with the square of the contact's time: 8 and 16 ms against 4 ms as 48 to 240."""
    sim = on_floor(3, FootCompliance(), contact_time_added=torch.tensor([0.0, 0.004, 0.012]))
    sunk = sim._qpos[0, 2] - sim._qpos[:, 2]
    assert sunk[1] > 0
    assert (sunk[2] / sunk[1]).item() == pytest.approx(240 / 48, rel=0.2)
