"""The servo law as functions: closed forms and invariants."""

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from op3.servo import law

torque = st.floats(-5.0, 5.0, allow_nan=False)
efficiency = st.floats(0.3, 1.0)


def passive_loss(motor: float, load: float, forward_loss: float, backward_loss: float) -> float:
    torques = scalar(motor), scalar(load)
    leads = law.motor_leads(*torques)
    return law.dte_passive_loss(*torques, leads, scalar(forward_loss), scalar(backward_loss)).item()


def scalar(value: float) -> torch.Tensor:
    return torch.tensor([[value]], dtype=torch.float64)


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
    result = law.dte_brake(scalar(motor), scalar(load), scalar(forward), scalar(backward))
    assert result.item() == pytest.approx(brake, abs=1e-12)


@given(torque, torque, efficiency, efficiency)
def test_passive_dte_holds_exactly_where_the_printed_rule_does(motor, load, forward, backward):
    """A joint at rest stays at rest under the passive bound iff eq. (3) is antagonistic."""
    net = motor + load
    bound = passive_loss(motor, load, 1 - forward, 1 - backward)
    printed_net = net + law.dte_brake(scalar(motor), scalar(load), scalar(forward), scalar(backward)).item()
    margin = abs(abs(net) - bound)
    if motor * load < 0 and margin > 1e-9:
        assert (abs(net) < bound) == (abs(printed_net) < 1e-12)


@given(torque, torque, efficiency, efficiency)
def test_passive_dte_loses_what_the_printed_rule_loses_in_motion(motor, load, forward, backward):
    """Where a joint moves with the winning torque, both forms leave the same net torque."""
    net = motor + load
    bound = passive_loss(motor, load, 1 - forward, 1 - backward)
    printed_net = net + law.dte_brake(scalar(motor), scalar(load), scalar(forward), scalar(backward)).item()
    if abs(net) > bound + 1e-9 and motor * load != 0:
        passive_net = net - bound * (1 if net > 0 else -1)
        assert passive_net == pytest.approx(printed_net, abs=1e-9)


def test_printed_rule_can_add_energy():
    """Falling with the load while the motor wins on paper: the brake pushes along the motion."""
    motor, load, velocity = 1.0, -0.9, -2.0
    brake = law.dte_brake(scalar(motor), scalar(load), scalar(0.95), scalar(0.7)).item()
    assert brake * velocity > 0


def test_slip_of_a_hold_happens_at_the_backward_efficiency():
    """With eta_fw = 1, a load of 1 N m is held down to a motor torque of eta_bw and no lower."""
    for motor, holds in ((0.701, True), (0.699, False)):
        bound = passive_loss(motor, -1.0, 0.0, 0.3)
        assert (abs(motor - 1.0) <= bound) == holds


@given(st.floats(-3, 3), st.floats(-20, 20), st.floats(1, 10), st.floats(5, 15))
def test_current_controller_never_exceeds_the_bus(current, back_emf, resistance, bus):
    """The applied voltage lies within the bus voltage, and equals R I* + emf where that fits."""
    voltage = law.current_control(scalar(current), scalar(back_emf), scalar(resistance), scalar(bus)).item()
    assert abs(voltage) <= bus
    wanted = resistance * current + back_emf
    if abs(wanted) <= bus:
        assert voltage == pytest.approx(wanted, abs=1e-12)


@given(st.floats(0, 50))
def test_stribeck_friction_fades_from_its_static_value(speed):
    """At rest the whole excess acts; it never grows with speed, as the printed formula would."""
    value = law.stribeck_fade(scalar(speed), scalar(0.1)).item()
    assert law.stribeck_fade(scalar(0.0), scalar(0.1)).item() == 1.0
    assert 0.0 <= value <= 1.0


@given(st.floats(-8, 8), st.floats(0.0, 0.15), st.floats(0.01, 0.3))
def test_a_lifted_voltage_keeps_its_sign_and_the_bus(voltage, lift, fade):
    """The driver never lowers a voltage, never turns it round, adds at most its lift, and cannot exceed the bus."""
    bus = 8.0
    lifted = law.lifted_voltage(scalar(voltage), scalar(bus), scalar(lift), scalar(fade)).item()
    assert lifted * voltage >= 0
    assert abs(voltage) - 1e-12 <= abs(lifted) <= min(bus, abs(voltage) + bus * lift) + 1e-12


def test_the_lift_is_whole_far_above_its_fade_and_nothing_at_zero():
    """At zero nothing is added; at ten fades the whole lift."""
    raised = law.lifted_voltage(scalar(4.0), scalar(8.0), scalar(0.05), scalar(0.05)).item()
    assert raised == pytest.approx(4.0 + 8.0 * 0.05, rel=1e-4)
    assert law.lifted_voltage(scalar(0.0), scalar(8.0), scalar(0.05), scalar(0.05)).item() == 0.0


@given(torque, torque, st.floats(0.0, 0.9))
def test_load_friction_is_that_of_torques_pressed_together(motor, load, share):
    """Equal shares lose in proportion to the torque passed on: the sum where both oppose, the difference otherwise."""
    bound = law.load_friction(scalar(motor), scalar(load), scalar(share), scalar(share)).item()
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
    result = law.antagonistic_friction(scalar(motor), scalar(load), scalar(3.0), scalar(2.0)).item()
    assert result == pytest.approx(bound, abs=1e-12)


@given(st.floats(0.0, 0.024), st.sampled_from([0.001, 0.00025]))
def test_delayed_commands_are_shares_of_time(latency, timestep):
    """In every step the weights of past commands are non-negative and sum to one."""
    weights = law.delay_weights(scalar(latency), timestep, 0.008, 4)
    assert weights.shape == (round(0.008 / timestep), 4, 1, 1)
    assert (weights >= 0).all()
    torch.testing.assert_close(weights.sum(1), torch.ones_like(weights[:, 0]))


def test_latency_is_the_centroid_of_the_delayed_signal():
    """The average age of the commands in force is the latency plus half the hold, for any latency."""
    period, timestep = 0.008, 0.001
    for latency in (0.0, 0.0034, 0.006, 0.0171):
        weights = law.delay_weights(scalar(latency), timestep, period, 4)[:, :, 0, 0]
        middle = (torch.arange(8, dtype=torch.float64) + 0.5) * timestep
        issued = -torch.arange(4, dtype=torch.float64) * period
        age = (weights * (middle[:, None] - issued[None])).sum() / 8
        assert age.item() == pytest.approx(latency + period / 2, abs=timestep / 2)


def test_position_loop_saturates():
    """A position servo's duty is proportional to the error and its rate, up to its limit."""
    duty = law.position_duty(scalar(1.0), scalar(2.0), scalar(0.5), scalar(0.01), 0.97)
    assert duty.item() == pytest.approx(0.52)  # 0.5 * 1 + 0.01 * 2
    assert law.position_duty(scalar(10.0), scalar(0.0), scalar(0.5), scalar(0.0), 0.97).item() == pytest.approx(0.97)


def test_law_is_differentiable():
    """Gradients flow from the losses to the efficiencies."""
    loss = scalar(0.3).requires_grad_()
    law.dte_passive_loss(scalar(0.2), scalar(-1.0), torch.tensor([[False]]), scalar(0.0), loss).sum().backward()
    assert loss.grad is not None
    assert loss.grad.item() == pytest.approx(1.0)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.01, 0.6))
@example(1051, 0.5625)  # needs a fourth step
def test_a_bus_settles_where_its_currents_hold_it(seed, supply_resistance):
    """``V = V0 - R_s sum |I(V)|`` to 50 mV, however many servos the fall itself limits."""
    generator = torch.Generator().manual_seed(seed)
    target = 1.5 * torch.randn(40, 12, generator=generator, dtype=torch.float64)
    back_emf = 2.0 * torch.randn(40, 12, generator=generator, dtype=torch.float64)
    opened, resistance = torch.full_like(target, 11.1), torch.full_like(target, 5.5)
    supply = torch.full((40, 1), supply_resistance, dtype=torch.float64)
    settled = law.settled_voltage(opened, supply, target, back_emf, resistance)

    def limits(voltage: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return (-voltage - back_emf) / resistance, (voltage - back_emf) / resistance

    current = torch.clamp(target, *limits(settled))
    missed = (opened - settled - supply * current.abs().sum(-1, keepdim=True)).abs()
    assert ((settled <= opened) & (settled >= law.LEAST_VOLTAGE)).all()
    # what the speed drives back raises the voltage, and has no one solution; a bus at its least has none
    driving = (current * target >= 0).all(-1) & (settled > law.LEAST_VOLTAGE).all(-1)
    assert driving.any() or supply_resistance > 0.3
    assert (missed[driving] < 0.05).all()
