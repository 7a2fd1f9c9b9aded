"""Velocity commands: what is drawn."""

import numpy as np
import pytest

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
