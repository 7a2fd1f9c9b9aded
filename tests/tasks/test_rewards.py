"""The reward terms against values worked out by hand, their limits, and the smoothed gait phase."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.robot import load_robot
from op3.robot.kinematics import rotation_matrix
from op3.tasks import rewards

number = st.floats(-50, 50)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_command_term_by_hand():
    """0.1 m/s too slow, 0.2 m/s sideways, tilted by (0.3, 0.4) rad, whose norm is 0.5; yaw does not count."""
    value = rewards.command_term(tensor(0.2, 0.2), tensor(0.3, 0.0), tensor(0.3, 0.4, 9.0), 15.0, 1.0)
    # K_xd = 15, K_yd = 1
    expected = -(1 - math.exp(-15 * 0.1)) - (1 - math.exp(-1 * 0.2)) - (1 - math.exp(-4 * 0.5))
    assert value.item() == pytest.approx(expected)


def test_smooth_term_by_hand():
    """Action moved by (0.3, 0.4), currents (0.3, 0.4) A, body rate 3 rad/s and acceleration 4 m/s^2."""
    value = rewards.smooth_term(rewards.norm(tensor(0.3, 0.4)), tensor(0.5), tensor(3.0 + 4.0))[0]
    expected = -(1 - math.exp(-0.1 * 0.5)) - (1 - math.exp(-0.05 * 5.0)) - (1 - math.exp(-0.1 * 7.0))
    assert value.item() == pytest.approx(expected)


def test_overload_term_by_hand():
    """Half the heat of 171 counts (0.45999 A) costs nothing; twice that current in two motors is an excess of 7."""
    fifth = 171 * 0.00269
    robot = load_robot("op3")

    def overload(*values: float) -> torch.Tensor:
        currents = torch.zeros(1, len(robot.joints), dtype=torch.float64)
        currents[0, : len(values)] = tensor(*values)
        return rewards.overload(SimpleNamespace(joint_current=currents), robot)

    assert overload(fifth * 0.7071, -0.3, 0.0).item() == 0.0
    value = overload(2 * fifth, -2 * fifth, 0.3)
    assert value.item() == pytest.approx(-(1 - math.exp(-7.0)))


def test_planted_by_hand():
    """In mid-swing of the left foot only the right one counts: its heel 5 mm up is a quarter of the height."""
    step = SimpleNamespace(foot_rise=tensor(0.05, 0.005)[None], foot_force=torch.zeros(1, 2))
    state = SimpleNamespace(step=step, phase=tensor(0.15))
    assert rewards.planted(state, height=0.02).item() == pytest.approx(-0.25, abs=2e-3)
    step.foot_rise = tensor(0.3, 0.3)[None]
    assert rewards.planted(state).item() == pytest.approx(-1.0, abs=2e-3)  # the most that one foot can lose


def test_bipedal_term_by_hand():
    """In mid-swing of the left foot its force counts and its speed does not; with the right foot it is the reverse."""
    swing_middle = torch.tensor(0.15, dtype=torch.float64)
    value = rewards.bipedal_term(rewards.swing_of_feet(swing_middle), tensor(10.0, 17.0), tensor(2.0, 0.5), 10.0)
    # the left foot's phase is 0.15, the middle of its swing; the right one's is 0.65, the middle of its stance
    expected = -(1 - math.exp(-(10.0**2) / 100)) - (1 - math.exp(-2 * 0.5**2))
    assert value.item() == pytest.approx(expected, abs=2e-3)


def test_swing_probability_is_a_smoothed_interval():
    """The series equals the convolution of the interval [0, 0.3] with a von Mises density, done numerically."""
    grid = np.linspace(0, 1, 4000, endpoint=False)
    density = np.exp(rewards.PHASE_CONCENTRATION * np.cos(2 * np.pi * grid))
    density /= density.sum()
    interval = (grid < 0.3).astype(float)
    expected = np.fft.ifft(np.fft.fft(interval) * np.fft.fft(density)).real
    computed = rewards.swing_probability(torch.from_numpy(grid)).numpy()
    np.testing.assert_allclose(computed, expected, atol=2e-3)  # the sum is exact to half a step of the grid
    assert computed.mean() == pytest.approx(0.3, abs=1e-3)


def test_gait_is_symmetric():
    """Half a cycle later, with the feet exchanged, the term is the same."""
    phase, force, speed = (
        torch.rand(20, dtype=torch.float64),
        torch.rand(20, 2).double() * 20,
        torch.rand(20, 2).double(),
    )
    here = rewards.bipedal_term(rewards.swing_of_feet(phase), force, speed, 10.0)
    there = rewards.bipedal_term(rewards.swing_of_feet((phase + 0.5) % 1), force.flip(-1), speed.flip(-1), 10.0)
    torch.testing.assert_close(here, there)


@settings(max_examples=60, deadline=None)
@given(st.lists(number, min_size=16, max_size=16))
def test_terms_are_bounded(values):
    """R_cmd and R_smt lie in [-3, 0], so that the reward of balancing lies in [1 - 1.8 - 0.3, 1]."""
    v = torch.tensor(values, dtype=torch.float64)
    command = rewards.command_term(v[:2], v[2:4], v[4:7], 2.0, 2.0)
    smooth = rewards.smooth_term(rewards.norm(v[:4]), rewards.norm(v[8:10]), rewards.norm(v[10:13]))
    assert -3 <= command <= 0
    assert -3 <= smooth <= 0
    reward = 1.0 + 0.6 * command + 0.1 * smooth
    assert -1.1 - 1e-12 <= reward <= 1


def test_perfect_is_one():
    """At rest, level, without current, the penalties are 0."""
    zero = torch.zeros(3, dtype=torch.float64)
    assert rewards.command_term(zero[:2], zero[:2], zero, 2.0, 2.0) == 0.0
    assert rewards.smooth_term(zero[0], zero[0], zero[0]) == 0.0


@settings(max_examples=30, deadline=None)
@given(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_body_at_rest_does_not_accelerate(roll, pitch, yaw):
    """In any attitude, gravity's specific force is an acceleration of zero."""
    force = rotation_matrix(roll, pitch, yaw).T @ [0.0, 0.0, 9.81]
    acceleration = rewards.body_acceleration(torch.from_numpy(force), tensor(roll, pitch, yaw))
    np.testing.assert_allclose(acceleration.numpy(), 0.0, atol=1e-12)
