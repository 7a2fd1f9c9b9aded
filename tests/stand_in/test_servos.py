"""The servos alone: their joints are moved by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.stand_in import World
from op3.stand_in.servos import ServoBank

TIMESTEP = 0.00025
QUIET = World(joint_spread=0.0, friction_drift=0.0, torque_noise=0.0, current_offset=0.0, bus_resistance=0.0)
FRICTIONLESS = QUIET.replace(coulomb_friction=0.0, static_friction_excess=0.0, viscous_friction=0.0)


def bank(world: World) -> ServoBank:
    servos = ServoBank(world, 1, TIMESTEP)
    servos.reset(np.random.default_rng(0))
    return servos


def run(servos: ServoBank, current: float, velocity: float, duration: float = 0.2) -> float:
    """Torque after moving steadily for a while [N m]."""
    for _ in range(round(duration / TIMESTEP)):
        torque = servos.step(np.array([current]), np.array([velocity]))
    return float(torque[0])


@pytest.mark.parametrize("current", [0.3, -0.8])
@pytest.mark.parametrize("speed", [0.3, 1.0])
def test_gear_loss_follows_the_sign_of_the_power(current, speed):
    """The joint gets eta_fw tau where the motor drives and tau / eta_bw where it is driven back."""
    world = FRICTIONLESS.replace(forward_efficiency=0.9, backward_efficiency=0.6)
    ideal = 353.5 * world.torque_constant * current
    assert run(bank(world), current, speed * np.sign(current)) == pytest.approx(0.9 * ideal, rel=1e-9)
    assert run(bank(world), current, -speed * np.sign(current)) == pytest.approx(ideal / 0.6, rel=1e-9)


def test_sliding_friction():
    """A dead servo moved steadily resists with Coulomb, viscous and Gaussian Stribeck friction."""
    world = QUIET.replace(
        coulomb_friction=0.1, static_friction_excess=0.06, viscous_friction=0.03, stribeck_velocity=0.08
    )
    # 0.1 + 0.06 exp(-(0.05 / 0.08)^2) + 0.03 * 0.05 and 0.1 + 0.03 * 2
    assert run(bank(world), 0.0, 0.05) == pytest.approx(-(0.1 + 0.06 * np.exp(-0.390625) + 0.0015), rel=1e-9)
    assert run(bank(world), 0.0, -2.0) == pytest.approx(0.16, rel=1e-9)


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
    duration = max(0.3, 1 / frequency)
    for time in np.arange(0, duration, TIMESTEP):
        velocity = amplitude * np.sin(2 * np.pi * frequency * time + phase)
        torque = float(servos.step(np.array([current]), np.array([velocity]))[0])
        at_joint += torque * velocity * TIMESTEP
        at_motor += 353.5 * world.torque_constant * float(servos.current[0]) * velocity * TIMESTEP
    # Strain is taken up at the end of a step, so each step may err by stiffness (velocity timestep)^2 / 2.
    step_error = 0.5 * world.bristle_stiffness * (amplitude * TIMESTEP) ** 2 * (2 + 4 * frequency * duration)
    assert at_joint <= at_motor + step_error + 1e-12


def test_current_loop():
    """The current approaches its goal with the loop's time constant."""
    world = QUIET.replace(current_lag=0.0005)
    servos = bank(world)
    run(servos, 1.0, 0.0, 0.0005)
    assert servos.current[0] == pytest.approx(1 - np.exp(-1), rel=1e-9)
    run(servos, 1.0, 0.0, 0.01)
    assert servos.current[0] == pytest.approx(1.0, rel=1e-8)


@pytest.mark.parametrize(("velocity", "expected"), [(3.0, 1.0), (-3.0, 3.0)])
def test_voltage_limits_the_current(velocity, expected):
    """I cannot exceed (V - K w) / R; K is chosen so that K w = 5 V at 3 rad/s."""
    world = QUIET.replace(torque_constant=5 / (3 * 353.5), terminal_resistance=5.0, bus_voltage=10.0)
    servos = bank(world)
    run(servos, 9.0, velocity)
    # (10 - 5) / 5 = 1 A and (10 + 5) / 5 = 3 A
    assert servos.current[0] == pytest.approx(expected, rel=1e-9)


def test_bus_sag():
    """The battery gives the power R I^2 of 8.4 W at nearly 12 V, and loses its resistance times that current."""
    servos = ServoBank(QUIET.replace(bus_resistance=0.2, bus_voltage=12.0), 3, TIMESTEP)
    rng = np.random.default_rng(0)
    servos.reset(rng)
    for _ in range(100):
        servos.step(np.array([1.0, -0.5, 0.5]), np.zeros(3))
    for _ in range(20):
        servos.step_slow(0.025, rng)
    power = 5.6 * (1.0 + 0.25 + 0.25)
    assert servos.bus_voltage == pytest.approx(12.0 - 0.2 * power / servos.bus_voltage, rel=1e-6)


def test_current_sensor_offset_is_regulated_away():
    """A servo regulates what its sensor reads, so an offset is an error of the true current."""
    world = QUIET.replace(current_offset=0.01)
    servos = bank(world)
    run(servos, 0.5, 0.0)
    assert servos.reading[0] == pytest.approx(0.5, abs=1e-9)
    assert abs(servos.current[0] - 0.5) > 1e-4


def test_torque_noise():
    """The noise has the asked standard deviation and is band-limited."""
    world = QUIET.replace(torque_noise=0.004, torque_noise_bandwidth=40.0)
    servos = ServoBank(world, 20, TIMESTEP)
    rng = np.random.default_rng(0)
    servos.reset(rng)
    samples = []
    for step in range(4000):
        servos.step_slow(step * 0.001, rng)
        samples.append(servos.step(np.zeros(20), np.zeros(20)).copy())
    noise = np.array(samples)
    assert noise.std() == pytest.approx(0.004, rel=0.05)
    correlation = (noise[1:] * noise[:-1]).mean() / noise.var()
    assert correlation == pytest.approx(np.exp(-2 * np.pi * 40 * 0.001), abs=0.02)


def test_friction_drifts_within_its_width():
    """Over a period friction goes up and down by its half width, each servo in its own phase."""
    world = QUIET.replace(friction_drift=0.03, friction_drift_period=20.0, static_friction_excess=0.0)
    servos = ServoBank(world, 4, TIMESTEP)
    rng = np.random.default_rng(0)
    servos.reset(rng)
    seen = []
    for time in np.arange(0, 20, 0.25):
        servos.step_slow(time, rng)
        for _ in range(20):
            torque = servos.step(np.zeros(4), np.full(4, 2.0))
        seen.append(-(torque + world.viscous_friction * 2.0) / world.coulomb_friction)
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
        servos.step_slow(0.0, np.random.default_rng(0))
    rise = 10.0 * world.terminal_resistance * 0.25
    assert servos.temperature[0] - 25.0 == pytest.approx(rise * (1 - np.exp(-1)), rel=1e-3)
