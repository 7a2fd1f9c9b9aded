"""The servo law as functions: closed forms and invariants."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from op3.servo import law

torque = st.floats(-5.0, 5.0, allow_nan=False)
efficiency = st.floats(0.3, 1.0)


def passive_loss(motor: float, load: float, forward_loss: float, backward_loss: float) -> float:
    return law.dte_passive_loss(motor, load, 1.0 - forward_loss, 1.0 - backward_loss)


@pytest.mark.parametrize(
    ("motor", "load", "forward", "backward", "brake"),
    [
        (1.0, 0.5, 0.8, 0.7, -0.2),  # same direction: the motor drives, -(1 - 0.8) * 1.0
        (1.0, -0.5, 0.8, 0.7, -0.2),  # motor dominates: 0.8 - 0.5 > 0, still driving
        (0.5, -1.0, 0.8, 0.7, 0.3),  # load dominates: 0.5 - 0.7 < 0, back-driven, -(1 - 0.7) * -1.0
        (0.9, -1.0, 0.8, 0.7, 0.1),  # antagonistic: neither wins, -(0.9 - 1.0)
        (-0.9, 1.0, 0.8, 0.7, -0.1),  # the same mirrored
        (0.0, 1.0, 0.8, 0.7, -0.3),  # no motor torque: the load drives
    ],
)
def test_printed_dte_matches_cases_solved_by_hand(motor, load, forward, backward, brake):
    """Drive, back-drive and antagonistic hold give the brake torques of eq. (3)."""
    result = law.dte_brake(motor, load, forward, backward)
    assert result == pytest.approx(brake, abs=1e-12)


@given(torque, torque, efficiency, efficiency)
def test_passive_dte_holds_exactly_where_the_printed_rule_does(motor, load, forward, backward):
    """A joint at rest stays at rest under the passive bound iff eq. (3) is antagonistic."""
    net = motor + load
    bound = passive_loss(motor, load, 1 - forward, 1 - backward)
    printed_net = net + law.dte_brake(motor, load, forward, backward)
    margin = abs(abs(net) - bound)
    if motor * load < 0 and margin > 1e-9:
        assert (abs(net) < bound) == (abs(printed_net) < 1e-12)


@given(torque, torque, efficiency, efficiency)
def test_passive_dte_loses_what_the_printed_rule_loses_in_motion(motor, load, forward, backward):
    """Where a joint moves with the winning torque, both forms leave the same net torque."""
    net = motor + load
    bound = passive_loss(motor, load, 1 - forward, 1 - backward)
    printed_net = net + law.dte_brake(motor, load, forward, backward)
    if abs(net) > bound + 1e-9 and motor * load != 0:
        passive_net = net - bound * (1 if net > 0 else -1)
        assert passive_net == pytest.approx(printed_net, abs=1e-9)


@given(st.floats(-8, 8), st.floats(0.0, 0.15), st.floats(0.01, 0.3))
def test_a_lifted_voltage_keeps_its_sign_and_the_bus(voltage, lift, fade):
    """The driver never lowers a voltage, never turns it round, adds at most its lift, and cannot exceed the bus."""
    bus = 8.0
    lifted = law.lifted_voltage(voltage, bus, lift, fade)
    assert lifted * voltage >= 0
    assert abs(voltage) - 1e-12 <= abs(lifted) <= min(bus, abs(voltage) + bus * lift) + 1e-12


@given(torque, torque, st.floats(0.0, 0.9))
def test_load_friction_is_that_of_torques_pressed_together(motor, load, share):
    """Equal shares lose in proportion to the torque passed on: the sum where both oppose, the difference otherwise."""
    bound = law.load_friction(motor, load, share, share)
    expected = abs(motor) + abs(load) if motor * load < 0 else abs(abs(motor) - abs(load))
    assert bound == pytest.approx(share * expected, abs=1e-12)


@pytest.mark.parametrize(
    ("motor", "load", "bound"),
    [
        (0.3, -0.2, 2.0 * 0.2**2),  # the motor leads: the load's square counts
        (-0.3, 0.2, 2.0 * 0.2**2),
        (0.1, -0.2, 3.0 * 0.1**2),  # the load leads: the motor's square counts
        (0.3, 0.2, 0.0),  # the same direction
        (0.0, 0.2, 0.0),
    ],
)
def test_antagonistic_friction_counts_the_weaker_torque(motor, load, bound):
    """The square of the weaker torque where both oppose each other, nothing otherwise."""
    result = law.antagonistic_friction(motor, load, 3.0, 2.0)
    assert result == pytest.approx(bound, abs=1e-12)


def arrived(latency: float, steps_per_tick: int) -> np.ndarray:
    """Share of each of four commands in each step of a period, newest first, ``[step, command]``."""
    acted = [
        [law.acted(age, phase, latency * steps_per_tick / 0.008, float(steps_per_tick)) for age in range(4)]
        for phase in range(steps_per_tick)
    ]
    return np.diff(np.array(acted), axis=1, prepend=0.0)


@given(st.floats(0.0, 0.024), st.sampled_from([8, 32]))
def test_delayed_commands_are_shares_of_time(latency, steps):
    """In every step the shares of past commands are non-negative and sum to one."""
    shares = arrived(latency, steps)
    assert (shares >= 0).all()
    np.testing.assert_allclose(shares.sum(1), 1.0)


def test_latency_is_the_centroid_of_the_delayed_signal():
    """The average age of the commands in force is the latency plus half the hold, for any latency."""
    for latency in (0.0, 0.0034, 0.006, 0.0171):
        age = (np.arange(8)[:, None] + 0.5) * 0.001 + np.arange(4) * 0.008
        assert (arrived(latency, 8) * age).sum() / 8 == pytest.approx(latency + 0.004, abs=0.0005)


def test_loss_by_power_follows_the_direction_of_motion():
    """A motor of 2 N m that drives loses 0.2; driven back it loses 0.5, whichever way the load points, and mirrored."""
    for load in (-5.0, 0.0, 5.0):
        for motor, velocity, loss in ((2.0, 1.0, 0.2), (2.0, -1.0, 0.5), (-2.0, -1.0, 0.2), (-2.0, 1.0, 0.5)):
            assert law.dte_power_loss(motor, load, velocity, 0.9, 0.8) == pytest.approx(loss)


def test_loss_by_power_at_rest_follows_the_stronger_torque():
    """A joint that a larger load pulls against the motor loses as if driven back, one that the motor holds does not."""
    assert law.dte_power_loss(2.0, -3.0, 0.0, 0.9, 0.8) == pytest.approx(0.5)
    assert law.dte_power_loss(2.0, -1.0, 0.0, 0.9, 0.8) == pytest.approx(0.2)
