"""Laws of effects on signals alone, against closed forms."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from op3.diagnose.coordinates import CHAIN
from op3.servo import Effect, RobotModel, Servos, Signals, catalogue, parameter
from op3.servo.effects import (
    AsymmetricFriction,
    Coulomb,
    CurrentLag,
    CurrentOffset,
    CurrentPD,
    DirectionalEfficiency,
    EncoderNonlinearity,
    FrictionDrift,
    GyroBias,
    ImuMount,
    LeftRightAsymmetry,
    LoadFriction,
    LuGre,
    Motor,
    PacketDrop,
    PositionFriction,
    QuadraticDrag,
    Stribeck,
    TerminalResistance,
    TorqueConstant,
    TorqueConstantTemperature,
    VelocityFilter,
    Viscous,
    VoltageSag,
)
from op3.servo.signals import Trunk
from tests.secants import secant_values

MOTOR = {"torque_constant": 0.006, "terminal_resistance": 5.0, "armature": 0.005}
CONSTANT = 0.006 * 353.5
"""Joint-side torque constant of that motor [N m/A]."""
ALWAYS_ON = {"motor", "current_pd"}


def law_of(*effects: Effect, joints=("a",), timestep=0.001, **values) -> tuple[Servos, Signals]:
    """A current-driven servo with these effects, at rest, and its signals."""
    on = (CurrentPD(), Motor(), *effects)
    law = Servos(on, joints, 1, timestep, 0.008)
    law.set(RobotModel(on).with_values({**MOTOR, **values}).tensors(joints))
    law.signals.torque_enable, law.signals.bus_voltage, law.signals.temperature = 1.0, 11.1, 25.0
    law.reset()
    return law, law.signals


def command(signals: Signals, current) -> None:
    """Ask for a current [A] through the PD."""
    signals.p_gain = 1.0
    signals.position_target = signals.position + torch.as_tensor(current, dtype=torch.float64)


def drive(law: Servos, signals: Signals, steps: int = 1) -> list[float]:
    """Currents of the steps of one tick."""
    law.tick()
    currents = []
    for _ in range(steps):
        law.step()
        currents.append(signals.current[0, 0].item())
    return currents


@pytest.mark.parametrize("name", sorted(set(catalogue()) - ALWAYS_ON))
def test_every_effect_tells_the_diagnosis_how_to_find_it(name):
    """Secants within what physics allows, of parameters that are there; where it shows, what else may, who has it."""
    effect = catalogue()[name]
    own = {p.name for p in effect.parameters}
    assert effect.secants or own & set(CHAIN)  # what every base fits is no candidate
    for secant in effect.secants:
        assert set(secant) & own
        assert all(known in own or parameter(known).neutral is not None for known in secant)
        for key, value in secant_values(secant, {"command_latency": 0.006}).items():
            assert parameter(key).least <= value <= parameter(key).most
    assert effect.fingerprint
    assert effect.separating_experiment
    assert effect.confounders
    assert set(effect.confounders) <= set(catalogue()) - {name}
    assert ("robot" in effect.scopes) != any(p.per_joint for p in effect.parameters)


def test_torque_constant_and_resistance_errors_are_those_of_the_motor():
    """1 + e on either parameter gives the torque and current of a motor that has the product, saturated or not."""
    for current in (0.5, 5.0):
        law, signals = law_of(
            TorqueConstant(), TerminalResistance(), torque_constant_error=0.1, terminal_resistance_error=-0.2
        )
        other, expected = law_of(torque_constant=0.0066, terminal_resistance=4.0)
        for each, its in ((law, signals), (other, expected)):
            its.velocity = its.velocity + 1.0
            command(its, current)
            drive(each, its)
        torch.testing.assert_close(signals.applied_torque, expected.applied_torque)
        torch.testing.assert_close(signals.damping, expected.damping)


def test_a_hot_motor_gives_less_torque_per_current_and_draws_less():
    """At 65 C a magnet with 0.001/K has 4 % less torque constant; copper with 0.0039/K has 15.6 % more resistance."""
    law, signals = law_of(TorqueConstantTemperature(), magnet_temperature_coefficient=0.001)
    signals.temperature = signals.temperature + 40.0
    command(signals, 0.5)
    drive(law, signals)
    assert signals.motor_torque.item() == pytest.approx(0.5 * CONSTANT * 0.96)
    law, signals = law_of(TerminalResistance(), resistance_temperature_coefficient=0.0039)
    signals.temperature = signals.temperature + 40.0
    command(signals, 5.0)
    law.tick()
    signals.target_current = signals.target_current + 50.0
    law.step()
    assert signals.current.item() == pytest.approx(11.1 / (5.0 * 1.156))


def test_a_sagging_supply_settles_where_battery_and_motors_agree():
    """Two stalled motors on 0.3 ohm: I = V0 / (R + 2 Rb) each."""
    law, signals = law_of(VoltageSag(), joints=("a", "b"), supply_resistance=0.3)
    signals.position_target = signals.position + 100.0
    signals.p_gain = signals.p_gain + 100.0
    law.reset()
    law.tick()
    signals.target_current = signals.target_current * 100
    for _ in range(100):
        law.step()
        signals.phase = 1
    torch.testing.assert_close(signals.current, torch.full((1, 2), 11.1 / (5.0 + 0.6), dtype=torch.float64))
    assert (signals.bus_voltage == 11.1).all()


def test_lagging_current_is_the_mean_of_an_exponential():
    """After a step of the command the current of each step is the mean of 1 - exp(-t / Tc) over it."""
    law, signals = law_of(CurrentLag(), current_time_constant=0.003)
    command(signals, 0.0)
    law.reset()
    command(signals, 1.0)
    currents = drive(law, signals, 8)
    edges = np.arange(9) * 0.001
    integral = edges + 0.003 * np.exp(-edges / 0.003)
    np.testing.assert_allclose(currents, np.diff(integral) / 0.001, rtol=1e-12)


def test_a_current_offset_is_regulated_into_a_torque():
    """The servo reports what was asked for and carries less by the offset."""
    law, signals = law_of(CurrentOffset(), current_offset=0.03)
    command(signals, 0.5)
    drive(law, signals, 8)
    law.report()
    assert signals.measured_current.item() == pytest.approx(0.5)
    assert signals.motor_torque.item() == pytest.approx(CONSTANT * 0.47)


def test_lost_packets_hold_the_last_command_and_repeat_with_the_seed():
    """One packet in five is lost; which, follows from the seed; a lost one leaves the command of the tick before."""

    def arrived(seed: int) -> np.ndarray:
        law, signals = law_of(PacketDrop(seed=seed), drop_probability=0.2)
        law.reset()
        seen = []
        for tick in range(2000):
            command(signals, 1e-4 * (tick + 1))
            seen += drive(law, signals)
        return np.round(np.array(seen) / 1e-4).astype(int)

    first = arrived(1)
    sent = np.arange(1, 2001)
    lost = first != sent
    assert 0.17 < lost.mean() < 0.23
    np.testing.assert_array_equal(first[1:][lost[1:]], first[:-1][lost[1:]])
    np.testing.assert_array_equal(first, arrived(1))
    assert (first != arrived(2)).any()


@pytest.mark.parametrize(("probability", "kept"), [(0.001, [1, 1, 3]), (0.0, [1, 2, 3])])
def test_a_packet_that_is_known_to_be_lost_is_lost_where_any_are(probability, kept):
    """What is known of a packet counts, and not what is drawn; with a probability of 0 none is lost."""
    law, signals = law_of(PacketDrop(), drop_probability=probability)
    law.reset()
    seen = []
    for tick, known in enumerate((1.0, -1.0, 1.0)):
        signals.packet = torch.full_like(signals.packet, known)
        command(signals, 0.1 * (tick + 1))
        seen += drive(law, signals)
    assert seen == pytest.approx([0.1 * tick for tick in kept])


@pytest.mark.parametrize("shape", [0.0, 0.1, 0.25, 1 / 3, 0.5])
@pytest.mark.parametrize("lag", [0.0002, 0.005, 0.03])
def test_filtered_velocity_is_that_of_its_transfer_function(shape, lag):
    """Exactly, of a velocity that changes linearly in every step, however often the sensors are read."""
    law, signals = law_of(VelocityFilter(), velocity_time_constant=lag, velocity_filter_shape=shape)
    law.reset()
    velocity = np.cumsum(np.random.default_rng(0).standard_normal(100)) * 0.02
    velocity[0] = 0.0
    filtered = signal.TransferFunction([1.0], [max(shape, 1e-6) * lag**2, lag, 1.0])
    _, expected, _ = signal.lsim(filtered, velocity, 0.001 * np.arange(100))
    for step, now in enumerate(velocity):
        signals.velocity = torch.full_like(signals.velocity, now)
        if step % 8 == 0:
            law.tick()
        law.sense()
        assert signals.measured_velocity.item() == pytest.approx(expected[step], abs=1e-8)
        law.step()


@pytest.mark.parametrize("velocity", ["bent", "apart"])
def test_a_bent_encoder_reads_a_velocity_that_fits_its_angle(velocity):
    """The reported velocity is the derivative of the reported angle, or the true one where another sensor gives it."""
    law, signals = law_of(
        EncoderNonlinearity(velocity=velocity), encoder_nonlinearity=0.02, encoder_nonlinearity_phase=0.4
    )
    readings = []
    for position in (0.7 - 1e-6, 0.7 + 1e-6):
        signals.position = torch.full_like(signals.position, position)
        signals.velocity = torch.ones_like(signals.velocity)
        law.sense()
        readings.append(signals.measured_position.item())
        assert readings[-1] == pytest.approx(position + 0.02 * np.sin(position + 0.4))
    slope = (readings[1] - readings[0]) / 2e-6 if velocity == "bent" else 1.0
    assert signals.measured_velocity.item() == pytest.approx(slope, rel=1e-6)


def bound(effect: Effect, position: float, velocity: float, load: float = 0.0, **values) -> float:
    law, signals = law_of(effect, **values)
    signals.position = signals.position + position
    signals.velocity = signals.velocity + velocity
    signals.load_torque = signals.load_torque + load
    drive(law, signals)
    return signals.friction_bound.item()


def test_frictions_of_speed_direction_and_place_are_their_formulas():
    """Drag is c w^2; friction of place is full at its angle and none opposite; asymmetric friction keeps its mean.

    Half of the difference is added one way and taken away the other, where there is as much.
    """
    assert bound(QuadraticDrag(), 0.0, -3.0, quadratic_drag=0.01) == pytest.approx(0.09)
    for value, velocity, expected in ((0.05, 1.0, 0.125), (0.05, -1.0, 0.075), (-0.05, -1.0, 0.125), (0.3, -1.0, 0.0)):
        law, signals = law_of(AsymmetricFriction(), Coulomb(), asymmetric_friction=value, coulomb_friction=0.1)
        signals.velocity = signals.velocity + velocity
        drive(law, signals)
        assert signals.friction_bound.item() == pytest.approx(expected)
    # at rest the push of motor and load counts
    assert bound(AsymmetricFriction(), 0.0, 0.0, load=0.1, asymmetric_friction=0.05) == pytest.approx(0.025)
    assert bound(AsymmetricFriction(), 0.0, 0.0, load=-0.1, asymmetric_friction=0.05) == 0.0
    for position, expected in ((0.3, 0.06), (0.3 + np.pi / 2, 0.03), (0.3 + np.pi, 0.0)):
        values = {"position_friction": 0.06, "position_friction_angle": 0.3}
        assert bound(PositionFriction(), position, 1.0, **values) == pytest.approx(expected, abs=1e-12)


def test_friction_by_load_follows_the_torque_of_its_form():
    """With motor and load against each other their sum is lost from, in the other form twice the motor's torque."""
    for form, torque in (("sum", lambda motor, load: abs(motor - load)), ("motor", lambda motor, load: 2 * abs(motor))):
        law, signals = law_of(LoadFriction(form=form), load_friction=0.2)
        signals.velocity, signals.load_torque = signals.velocity + 1.0, signals.load_torque - 0.3
        command(signals, 0.5)
        drive(law, signals)
        motor = signals.motor_torque.item()
        assert motor > 0.1
        assert signals.friction_bound.item() == pytest.approx(0.2 * torque(motor, -0.3), rel=1e-9)


@settings(max_examples=50, deadline=None)
@given(
    position=st.floats(-3, 3),
    velocity=st.floats(-10, 10),
    load=st.floats(-3, 3),
    value=st.floats(0, 1),
    kind=st.sampled_from([AsymmetricFriction, QuadraticDrag, PositionFriction, FrictionDrift]),
)
def test_friction_like_effects_never_drive(position, velocity, load, value, kind):
    """Whatever the state, the bound that they leave is not negative: a friction can only oppose."""
    known = kind.parameters[0]
    law, signals = law_of(kind(), Coulomb(), Viscous(), **{known.name: known.low + value * (known.high - known.low)})
    signals.position, signals.velocity = signals.position + position, signals.velocity + velocity
    signals.load_torque, signals.time = signals.load_torque + load, signals.time + 1000.0
    drive(law, signals)
    assert signals.friction_bound.item() >= 0


def test_warm_friction_is_what_is_left_of_it():
    """After one time constant 1 - c (1 - 1/e) of Coulomb and viscous friction is left; static excess stays."""
    values = {"coulomb_friction": 0.1, "viscous_friction": 0.02, "static_friction_excess": 0.05}
    law, signals = law_of(
        FrictionDrift(), Coulomb(), Viscous(), Stribeck(), friction_drift=0.4, friction_drift_time=60.0, **values
    )
    signals.velocity = signals.velocity + 2.0
    signals.time = signals.time + 60.0
    drive(law, signals)
    left = 1 - 0.4 * (1 - np.exp(-1))
    expected = left * (0.1 + 0.02 * 2.0) + 0.05 * np.exp(-2.0 / 0.1)
    assert signals.friction_bound.item() == pytest.approx(expected)
    assert signals.time.item() == pytest.approx(60.001)


def test_sides_differ_by_the_antisymmetric_part():
    """Left 1 + a, right 1 - a, the head as it is; the same for torque."""
    joints = ("l_knee", "r_knee", "head_pan")
    law, signals = law_of(
        LeftRightAsymmetry(),
        Coulomb(),
        joints=joints,
        friction_asymmetry=0.2,
        torque_asymmetry=-0.1,
        coulomb_friction=0.1,
    )
    command(signals, 0.5)
    drive(law, signals)
    np.testing.assert_allclose(signals.friction_bound[0].numpy(), [0.12, 0.08, 0.1])
    np.testing.assert_allclose(signals.motor_torque[0].numpy(), 0.5 * CONSTANT * np.array([0.9, 1.1, 1.0]))


def test_a_supply_gives_what_its_resistance_leaves():
    """Two servos that ask for more than they get: ``R I = V0 - R_s sum |I| - K w`` in each."""
    law, signals = law_of(joints=("a", "b"))
    law.reset()
    signals.supply_resistance = 0.4
    command(signals, [2.2, 2.1])
    signals.velocity = torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    drive(law, signals)
    left = signals.bus_voltage - 0.4 * signals.current.sum() - CONSTANT * signals.velocity
    np.testing.assert_allclose(signals.current.numpy(), (left / MOTOR["terminal_resistance"]).numpy(), rtol=1e-6)
    assert signals.bus_voltage.unique().item() == pytest.approx(11.1), "the voltage without current stays what it is"


def slid(compliance: float, motion: np.ndarray) -> np.ndarray:
    """Friction torque of bristles moved by hand."""
    law, signals = law_of(LuGre(damping_ratio=0.0), Coulomb(), bristle_compliance=compliance, coulomb_friction=0.1)
    law.reset()
    law.tick()
    torques = []
    for velocity in motion:
        signals.velocity = torch.full_like(signals.velocity, velocity)
        law.step()
        signals.phase = 1
        torques.append(signals.applied_torque.item())
    return np.array(torques)


def test_bristles_bend_then_slip():
    """Over 0.2 mrad the torque is that of the spring, over 30 mrad that of Coulomb friction; back it has memory."""
    reversal = np.linspace(0.03, -0.01, 9)[1:]
    torques = slid(0.01, np.r_[np.full(20, 0.01), np.full(1000, 0.03), reversal, np.full(10, -0.01)])
    assert torques[19] == pytest.approx(-20 * 1e-5 / 0.01, rel=0.12)
    assert torques[1019] == pytest.approx(-0.1, rel=1e-3)
    back = 10 * 1e-5 - reversal[reversal < 0].sum() * 1e-3
    assert torques[-1] == pytest.approx(-0.1 + back / 0.01, rel=0.15)


@pytest.mark.parametrize("gear", [None, DirectionalEfficiency(form="power")])
def test_a_rotor_on_bristles_moves_as_at_steps_of_a_twentieth(gear):
    """A rotor swung by its motor: at 1 ms its speed is that at 0.05 ms to two hundredths of the swing.

    With the slip of the old speed it was off by four hundredths and more.
    """
    effects = [LuGre(), Coulomb(), *([gear] if gear else [])]
    values = {"bristle_compliance": 0.003, "coulomb_friction": 0.15, "armature": 0.007}
    values |= {"backward_efficiency": 0.7} if gear else {}

    def swing(step: float) -> np.ndarray:
        law, signals = law_of(*effects, timestep=step, **values)
        law.reset()
        velocity, speeds = 0.0, []
        for k in range(round(0.4 / step)):
            signals.velocity = torch.full_like(signals.velocity, velocity)
            command(signals, 0.4 * np.sin(20.0 * (k + 0.5) * step))
            law.tick()
            law.step()
            torque, damping = signals.applied_torque[0, 0].item(), signals.damping[0, 0].item()
            velocity += step * torque / (values["armature"] + step * damping)
            speeds.append(velocity)
        return np.array(speeds)

    fine = swing(5e-5)[19::20]
    assert np.abs(swing(1e-3) - fine).max() < 0.02 * np.abs(fine).max()


def test_bristles_take_up_the_load_of_a_resting_joint():
    """A joint at rest under a load stays at rest: its bristle is bent from the beginning."""
    law, signals = law_of(LuGre(), Coulomb(), bristle_compliance=0.01, coulomb_friction=0.5)
    law.reset()
    law.tick()
    law.step()
    rests = torch.ones_like(signals.velocity, dtype=torch.bool)
    law.balance(torch.full_like(signals.velocity, 0.3), rests)
    law.step()
    assert signals.applied_torque[0, 0].item() == pytest.approx(-0.3, rel=1e-6)
    law.balance(torch.full_like(signals.velocity, 0.9), rests)
    law.step()
    assert signals.applied_torque[0, 0].item() == pytest.approx(-0.5, rel=1e-6), "friction bounds it"


def test_imu_reads_in_its_own_frame_and_the_gyroscope_adds_its_bias():
    """Against rotation matrices made by hand."""
    effects = (ImuMount(), GyroBias())
    values = {"imu_roll": 0.03, "imu_pitch": -0.02, "imu_yaw": 0.05, "gyro_bias_y": 0.01}
    law, _ = law_of(*effects, **values)

    def turn(axis: int, angle: float) -> np.ndarray:
        matrix, (i, j) = np.eye(3), [k for k in range(3) if k != axis]
        sign = -1.0 if axis == 1 else 1.0
        matrix[i, i] = matrix[j, j] = np.cos(angle)
        matrix[i, j], matrix[j, i] = -sign * np.sin(angle), sign * np.sin(angle)
        return matrix

    mount = turn(2, 0.05) @ turn(1, -0.02) @ turn(0, 0.03)
    body = turn(0, 0.4)
    rates = np.array([0.3, -0.2, 0.5])
    quaternion = torch.tensor([[np.cos(0.2), np.sin(0.2), 0.0, 0.0]], dtype=torch.float64)
    seen = law.sense_trunk(Trunk(quaternion, torch.from_numpy(rates)[None]))
    np.testing.assert_allclose(seen.angular_velocity[0].numpy(), mount.T @ rates + [0, 0.01, 0], atol=1e-12)
    w, x, y, z = seen.quaternion[0].tolist()
    up = [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z]
    np.testing.assert_allclose(up, (body @ mount).T @ [0, 0, 1], atol=1e-12)
