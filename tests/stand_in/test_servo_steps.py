"""One servo alone: its joint is moved by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.robot import load_servo
from op3.stand_in import Hidden, HiddenWorld
from op3.stand_in.hidden_servos import HiddenServos
from op3.stand_in.integration import TICK, step_servos

QUIET = HiddenWorld(joint_spread=0.0, friction_drift=0.0, torque_noise=0.0, current_offset=0.0, bus_resistance=0.0)
FRICTIONLESS = QUIET.replace(coulomb_friction=0.0, static_friction_excess=0.0, viscous_friction=0.0)
STEP = QUIET.timestep


def bank(world: HiddenWorld, *hidden: Hidden, count: int = 1) -> HiddenServos:
    joints = tuple(f"joint_{number}" for number in range(count))
    makes = [load_servo("xm430-w350")] * count
    servos = HiddenServos(world, hidden, joints, makes, np.zeros(count), np.tile([-np.inf, np.inf], (count, 1)))
    servos.reset(np.zeros(count), np.random.default_rng(0))
    return servos


def run(servos: HiddenServos, current: float, velocity: float, duration: float = 0.2, position: float = 0.0) -> float:
    """Torque after moving steadily for a while [N m]."""
    count = len(servos.states)
    torque, speed = np.zeros(count), np.full(count, velocity)
    servos.states["goal"] = current
    for step in range(round(duration / STEP)):
        step_servos(*servos.records, np.full(count, position + velocity * step * STEP), speed, torque)
    return float(torque[0])


@pytest.mark.parametrize("current", [0.3, -0.8])
@pytest.mark.parametrize("speed", [0.3, 1.0])
def test_gear_loss_follows_the_sign_of_the_power(current, speed):
    """The joint gets eta_fw tau where the motor drives and tau / eta_bw where it is driven back."""
    world = FRICTIONLESS.replace(forward_efficiency=0.9, backward_efficiency=0.6)
    ideal = 353.5 * world.torque_constant * current
    assert run(bank(world), current, speed * np.sign(current)) == pytest.approx(0.9 * ideal, rel=1e-4)
    assert run(bank(world), current, -speed * np.sign(current)) == pytest.approx(ideal / 0.6, rel=1e-4)


@pytest.mark.parametrize(
    ("form", "left"),
    [
        ("gaussian", np.exp(-0.390625)),
        ("exponential", np.exp(-0.625)),
        ("lorentz", 1 / 1.390625),
        ("stretched", np.exp(-np.sqrt(0.625))),
        ("ramp", 0.6875),
    ],
)
def test_sliding_friction(form, left):
    """A dead servo moved at 0.05 of 0.08 rad/s resists with Coulomb, viscous and what is left of static friction."""
    world = QUIET.replace(
        coulomb_friction=0.1, static_friction_excess=0.06, viscous_friction=0.03, stribeck_velocity=0.08, fade_form=form
    )
    assert run(bank(world), 0.0, 0.05) == pytest.approx(-(0.1 + 0.06 * left + 0.0015), rel=1e-6)


@settings(max_examples=20, deadline=None)
@given(
    st.floats(0.01, 5.0),
    st.floats(0.2, 20.0),
    st.floats(0.0, 6.28),
    st.floats(-1.0, 1.0),
    st.floats(0.5, 1.0),
    st.floats(0.5, 1.0),
)
def test_losses_never_feed_energy(amplitude, frequency, phase, current, forward, backward):
    """Whatever the motion, the joint gets no more work than the motor gives.

    What the servos keep in strained teeth at the end is bound^2 / (2 stiffness) at most.
    """
    world = QUIET.replace(forward_efficiency=forward, backward_efficiency=backward)
    servos = bank(world)
    run(servos, current, 0.0, 0.01)
    at_joint = at_motor = 0.0
    torque = np.zeros(1)
    duration = max(0.3, 1 / frequency)
    for time in np.arange(0, duration, STEP):
        velocity = np.array([amplitude * np.sin(2 * np.pi * frequency * time + phase)])
        step_servos(*servos.records, np.zeros(1), velocity, torque)
        at_joint += float(torque[0] * velocity[0]) * STEP
        at_motor += 353.5 * world.torque_constant * float(servos.states["current"][0] * velocity[0]) * STEP
    # Strain is taken up at the end of a step, so each step may err by stiffness (velocity timestep)^2 / 2.
    step_error = 0.5 * world.bristle_stiffness * (amplitude * STEP) ** 2 * (2 + 4 * frequency * duration)
    assert at_joint <= at_motor + step_error + 1e-12


@pytest.mark.parametrize("form", ["prandtl", "lugre"])
def test_friction_holds_without_creep(form):
    """A load of nine tenths of the bound moves a dead servo by its strain and no further."""
    servos = bank(FRICTIONLESS.replace(coulomb_friction=0.1, bristle_form=form, viscous_friction=0.05))
    position, velocity, torque, seen = np.zeros(1), np.zeros(1), np.zeros(1), []
    for _ in range(8000):
        step_servos(*servos.records, position, velocity, torque)
        velocity += STEP * (torque + 0.09) / 0.01
        position += STEP * velocity
        seen.append(float(position[0]))
    assert abs(seen[-1] - seen[4000]) < 1e-6
    assert 0 < seen[-1] < 0.003


def test_current_loop():
    """The current approaches its goal with the loop's time constant; a hidden lag comes before it."""
    servos = bank(QUIET.replace(current_lag=0.0005))
    run(servos, 1.0, 0.0, 0.0005)
    assert servos.states["current"][0] == pytest.approx(1 - np.exp(-1), rel=1e-9)
    late = bank(QUIET.replace(current_lag=1e-6), Hidden("current_lag", 0.005))
    run(late, 1.0, 0.0, 0.005)
    assert late.states["current"][0] == pytest.approx(1 - np.exp(-1), rel=1e-6)


@pytest.mark.parametrize(("velocity", "expected"), [(3.0, 1.0), (-3.0, 3.0)])
def test_voltage_limits_the_current(velocity, expected):
    """I cannot exceed (V - K w) / R; K is chosen so that K w = 5 V at 3 rad/s."""
    servos = bank(QUIET.replace(torque_constant=5 / (3 * 353.5), terminal_resistance=5.0, bus_voltage=10.0))
    run(servos, 9.0, velocity)
    # (10 - 5) / 5 = 1 A and (10 + 5) / 5 = 3 A
    assert servos.states["current"][0] == pytest.approx(expected, rel=1e-9)


def test_a_driver_that_applies_a_voltage():
    """Half the supply of 10 V less 2.5 V of back-EMF through 5 ohm: 0.5 A."""
    servos = bank(QUIET.replace(torque_constant=2.5 / (3 * 353.5), terminal_resistance=5.0, bus_voltage=10.0))
    servos.states["by_voltage"], servos.states["duty"] = 1, 0.5
    run(servos, 0.0, 3.0)
    assert servos.states["current"][0] == pytest.approx(0.5, rel=1e-6)


def test_bus_sag():
    """The battery gives the power R I^2 of 8.4 W at nearly 12 V, and loses its resistance times that current."""
    servos = bank(QUIET.replace(bus_resistance=0.2, bus_voltage=12.0), count=3)
    rng = np.random.default_rng(0)
    servos.states["goal"] = [1.0, -0.5, 0.5]
    for _ in range(100):
        step_servos(*servos.records, np.zeros(3), np.zeros(3), np.zeros(3))
    for _ in range(20):
        servos.tick(rng)
    bus = servos.robot["bus_voltage"][0]
    assert bus == pytest.approx(12.0 - 0.2 * 5.6 * (1.0 + 0.25 + 0.25) / bus, rel=1e-6)


def test_current_sensor_offset_is_regulated_away():
    """A servo regulates what its sensor reads, so an offset is an error of the true current."""
    servos = bank(QUIET.replace(current_offset=0.01))
    run(servos, 0.5, 0.0)
    assert servos.reading[0] == pytest.approx(0.5, abs=1e-9)
    assert abs(servos.states["current"][0] - 0.5) > 1e-4


def test_torque_noise():
    """The noise has the asked standard deviation and is band-limited."""
    servos = bank(QUIET.replace(torque_noise=0.004, torque_noise_bandwidth=40.0), count=20)
    rng = np.random.default_rng(0)
    samples = []
    for _ in range(4000):
        servos.tick(rng)
        samples.append(servos.states["noise"].copy())
    noise = np.array(samples)
    assert noise.std() == pytest.approx(0.004, rel=0.05)
    correlation = (noise[1:] * noise[:-1]).mean() / noise.var()
    assert correlation == pytest.approx(np.exp(-2 * np.pi * 40 * 0.001), abs=0.02)


def test_friction_drifts_within_its_width():
    """Over a period friction goes up and down by its half width, each servo in its own phase."""
    servos = bank(QUIET.replace(friction_drift=0.03, friction_drift_period=20.0), count=4)
    rng, seen = np.random.default_rng(0), []
    for time in np.arange(0, 20, 0.25):
        servos.robot["time"] = time
        servos.tick(rng)
        seen.append(servos.states["dry"] / QUIET.coulomb_friction)
    ratio = np.array(seen)
    assert ratio.max(0) == pytest.approx(np.full(4, 1.03), abs=1e-3)
    assert ratio.min(0) == pytest.approx(np.full(4, 0.97), abs=1e-3)
    assert len(set(ratio.argmax(0))) == 4


def test_warming_up():
    """A winding warms by thermal resistance times R I^2, with its time constant."""
    world = QUIET.replace(thermal_time=1.0, thermal_resistance=10.0, ambient_temperature=25.0)
    servos = bank(world)
    run(servos, 0.5, 0.0, 0.02)
    for _ in range(1000):
        servos.tick(np.random.default_rng(0))
    rise = 10.0 * world.terminal_resistance * 0.25
    assert servos.states["temperature"][0] - 25.0 == pytest.approx(rise * (1 - np.exp(-1)), rel=1e-3)


@pytest.mark.parametrize(("form", "lag"), [("lag", 0.01), ("two_lags", 0.01), ("difference", 0.01)])
def test_velocity_estimates_lag(form, lag):
    """Of a steady acceleration every form of estimate lags by its time constant, and one more effect adds its own."""
    for hidden, total in (((), lag), ((Hidden("velocity_filter", 0.008),), lag + 0.008)):
        servos = bank(QUIET.replace(velocity_lag=lag, velocity_form=form), *hidden)
        rng = np.random.default_rng(0)
        for tick in range(300):
            servos.states["velocity"], servos.states["position"] = tick * TICK, 0.5 * (tick * TICK) ** 2
            servos.tick(rng)
        assert 299 * TICK - servos.velocity[0] == pytest.approx(total, abs=0.0015)


def test_teeth_push_and_never_pull():
    """A gap of 4 mrad passes no torque inside, the stiffness of teeth outside, and none where they part."""
    servos = bank(FRICTIONLESS, Hidden("backlash", 0.004, ("joint_0",)))
    for angle, velocity, torque in ((0.003, 0.0, 0.0), (0.006, 0.0, 250.0 * 0.002), (0.006, -100.0, 0.0)):
        servos.reset(np.zeros(1), np.random.default_rng(0))
        servos.states["gear_position"], servos.states["gear_velocity"] = angle, velocity
        passed = np.zeros(1)
        step_servos(*servos.records, np.zeros(1), np.zeros(1), passed)
        assert passed[0] == pytest.approx(torque, abs=0.02)


@pytest.mark.parametrize(
    ("name", "size", "torque"),
    [("cable_spring", 0.5, -0.05), ("creep", 0.5, -0.05), ("hard_stop", 4.0, 0.0), ("encoder_offset", 0.1, 0.0)],
)
def test_what_acts_on_the_joint(name, size, torque):
    """At 0.1 rad from rest a spring of 0.5 N m/rad pulls back 0.05 N m, an obstacle 0.18 rad away nothing yet."""
    assert run(bank(FRICTIONLESS, Hidden(name, size)), 0.0, 0.0, STEP, 0.1) == pytest.approx(torque, abs=1e-3)


def test_an_encoder_finds_its_angle_again():
    """`angles` inverts what offset and eccentricity make of an angle."""
    servos = bank(QUIET, Hidden("encoder_offset", 0.02), Hidden("encoder_nonlinearity", 0.03))
    servos.states["position"] = servos.angles(np.array([0.4]))
    assert servos.encoders == pytest.approx([0.4], abs=1e-9)


def test_a_servo_of_another_make_is_in_proportion():
    """An STS3215 has its own gear, motor and supply, and friction in proportion of the stalled motors' torques.

    Without losses a motor at its usual supply stalls at K V / R, of the XM430 5.20 N m, of the STS3215 3.77 N m.
    """
    make, like = load_servo("sts3215"), load_servo("xm430-w350")
    servos = HiddenServos(QUIET, (), ("joint",), [make], np.zeros(1), np.array([[-1.0, 1.0]]))
    stalls = [one.output_constant * one.supply.si / one.motor.terminal_resistance.si for one in (make, like)]
    assert stalls == pytest.approx([3.77, 5.20], abs=0.01)
    assert servos.servos["coulomb"][0] == pytest.approx(QUIET.coulomb_friction * stalls[0] / stalls[1])
    more = QUIET.torque_constant / like.motor.torque_constant.si
    assert servos.servos["constant"][0] == pytest.approx(more * make.output_constant)
    assert servos.robot["open_voltage"][0] == pytest.approx(QUIET.bus_voltage * 7.4 / 11.1)


def test_a_position_loop_of_its_own():
    """A duty of 0.166 per rad and unit of gain: at 32 units and 0.05 rad off it is 0.266, and never above 0.97."""
    servos = HiddenServos(QUIET, (), ("joint",), [load_servo("sts3215")], np.zeros(1), np.array([[-3.0, 3.0]]))
    servos.reset(np.zeros(1), np.random.default_rng(0))
    for goal, duty in ((0.05, 0.166 * 32 * 0.05), (1.0, 0.97)):
        servos.states["goal"] = goal
        for _ in range(100):
            servos.tick(np.random.default_rng(0))
        assert servos.states["duty"][0] == pytest.approx(duty, abs=1e-6)
