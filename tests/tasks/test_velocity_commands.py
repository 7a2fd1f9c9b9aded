"""Velocity commands: what is drawn."""

import numpy as np
import pytest
import torch

from op3.tasks.commands import Velocity
from op3.tasks.episodes import Episodes

RANGES = {"forward": (-0.1, 0.3), "sideways": (-0.1, 0.1), "turning": (-0.5, 0.5)}


@pytest.mark.parametrize(("corners", "largest"), [(0.0, 1.0), (1.0, 3**0.5)])
def test_corners_say_how_far_commands_are_combined(corners, largest):
    """Without corners all lie in the ellipsoid of the ranges, with them in the box; ends of single axes are reached."""
    command = Velocity(1, 4000.0, **RANGES, corners=corners)
    command.begin(Episodes(np.array([0]), np.array([3]), np.zeros((1, 1)), np.zeros((1, 1))))
    drawn = command._schedule[0].numpy()
    ends = np.array(list(RANGES.values())).T
    size = np.linalg.norm(drawn / np.where(drawn < 0, *ends), axis=1)
    assert size.max() == pytest.approx(largest, rel=0.1)
    assert (size > 1.0 + 1e-9).any() == (corners > 0)
    assert np.abs(drawn).max(0) == pytest.approx([0.3, 0.1, 0.5], rel=0.05)


def test_a_share_of_the_commands_has_one_number_alone():
    """Pure sideways and backward walking is never drawn from ranges alone."""
    command = Velocity(1, 4000.0, **RANGES, zero_share=0.1, straight_share=0.2, single_share=0.3)
    command.begin(Episodes(np.array([0]), np.array([3]), np.zeros((1, 1)), np.zeros((1, 1))))
    drawn = torch.stack([command.at(torch.tensor([2.0 * i])) for i in range(1900)])[:, 0] != 0
    alone = drawn.sum(1) == 1
    assert alone.double().mean() == pytest.approx(0.3, abs=0.03)
    assert drawn[alone].double().mean(0).tolist() == pytest.approx([1 / 3] * 3, abs=0.08)
    assert (~drawn.any(1)).double().mean() == pytest.approx(0.1, abs=0.03)
    assert (drawn[:, :2].all(1) & ~drawn[:, 2]).double().mean() == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize(
    "shares", [{"zero_share": 0.7, "single_share": 0.5}, {"turn_share": -0.1, "single_share": 0.5}]
)
def test_shares_that_are_no_probabilities_are_refused(shares):
    """Above 1 together, or one below 0, though their sum is not."""
    with pytest.raises(ValueError, match=r"single_share must be at least 0 and at most 1 together, got \("):
        Velocity(1, 10.0, **RANGES, **shares)


def test_each_episode_holds_its_commands_for_its_own_time():
    """Between the least and the greatest time, evenly in the logarithm; a single time is every episode's."""
    command = Velocity(400, 100.0, **RANGES, interval=[2.0, 10.0])
    rows = np.arange(400)
    command.begin(Episodes(rows, rows, np.zeros((400, 1)), np.zeros((400, 1))))
    ticks = torch.arange(0.0, 100.0, 0.1)
    drawn = torch.stack([command.at(torch.full((400,), time)) for time in ticks])
    held = 100.0 / ((drawn[1:] != drawn[:-1]).any(2).sum(0) + 1)
    assert held.min() > 1.8
    assert held.max() < 11.0
    assert held.log().mean() == pytest.approx(np.log(2.0 * 10.0) / 2, abs=0.1)
    for wrong in ([3.0, 2.0], 0.0, [1.0, 2.0, 3.0]):
        with pytest.raises(ValueError, match="interval must be above 0 s, or a least and a greatest time"):
            Velocity(1, 10.0, **RANGES, interval=wrong)


def test_a_share_of_the_commands_is_to_walk_straight_ahead():
    """At more than half of the greatest speed; the other shares are of the rest."""
    command = Velocity(1, 4000.0, **RANGES, zero_share=0.5, forward_share=0.6)
    command.begin(Episodes(np.array([0]), np.array([3]), np.zeros((1, 1)), np.zeros((1, 1))))
    drawn = torch.stack([command.at(torch.tensor([2.0 * i])) for i in range(1900)])[:, 0]
    ahead = (drawn[:, 0] > 0.15) & (drawn[:, 1:] == 0).all(1)
    assert ahead.double().mean() == pytest.approx(0.6, abs=0.03)
    assert drawn[ahead, 0].max() <= 0.3
    assert (drawn == 0).all(1).double().mean() == pytest.approx(0.2, abs=0.03)


def test_a_share_of_commands_straight_ahead_is_a_probability():
    """At 1 all walk forwards faster than half of the greatest speed; beyond it is refused."""
    command = Velocity(1, 4000.0, **RANGES, forward_share=1.0)
    command.begin(Episodes(np.array([0]), np.array([3]), np.zeros((1, 1)), np.zeros((1, 1))))
    forward, others = command._schedule[0, :, 0], command._schedule[0, :, 1:]
    assert forward.min() >= 0.15
    assert forward.max() <= 0.3
    assert not others.any()
    with pytest.raises(ValueError, match=r"forward_share must be between 0 and 1, got 1\.5"):
        Velocity(1, 10.0, **RANGES, forward_share=1.5)
