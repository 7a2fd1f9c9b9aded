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


def test_a_scale_below_one_draws_slower_commands():
    """Half the scale halves every range."""
    command = Velocity(1, 4000.0, **RANGES, scale=0.5)
    command.begin(Episodes(np.array([0]), np.array([3]), np.zeros((1, 1)), np.zeros((1, 1))))
    assert np.abs(command._schedule[0].numpy()).max(0) == pytest.approx([0.15, 0.05, 0.25], rel=0.05)
    with pytest.raises(ValueError, match="interval must be above 0 s, got 0"):
        Velocity(1, 10.0, **RANGES, interval=0)
