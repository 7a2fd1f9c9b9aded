"""Least squares on problems with known answers."""

import numpy as np
import pytest
import torch

from op3.identify.refine import refine
from op3.identify.sensitivity import Box


def rosenbrock(unit: torch.Tensor) -> torch.Tensor:
    """Residuals of Rosenbrock's function on [-2, 2]^2; its minimum is at (1, 1)."""
    x, y = (4 * unit - 2).unbind(1)
    return torch.stack([1 - x, 10 * (y - x * x)], 1)


BOX = Box.of({"x": (-2.0, 2.0), "y": (-2.0, 2.0)})


def test_finds_the_minimum_of_a_curved_valley():
    """From a far start the valley of Rosenbrock's function is followed to its end."""
    result = refine(rosenbrock, BOX, [{"x": -1.2, "y": 1.0}], max_iterations=60, tolerance=1e-9)
    assert result.values["x"] == pytest.approx(1.0, abs=2e-3)
    assert result.values["y"] == pytest.approx(1.0, abs=4e-3)
    assert np.all(np.diff(result.history) <= 0)


def test_stays_within_bounds():
    """With the minimum outside the box, the best point on its border is found."""
    result = refine(lambda u: u - 1.7, Box.of({"a": (0.0, 1.0)}), [{"a": 0.2}])
    assert result.values["a"] == pytest.approx(1.0)


def test_the_best_of_several_starts_wins():
    """A wavy residual has many minima; the start near the deepest one decides."""

    def wavy(unit: torch.Tensor) -> torch.Tensor:
        x = 10 * unit
        return torch.cat([0.3 * (x - 8), torch.sin(2 * x - 16)], 1)

    starts = [{"x": v} for v in (1.0, 4.0, 7.8)]
    result = refine(wavy, Box.of({"x": (0.0, 10.0)}), starts, tolerance=1e-9)
    assert result.values["x"] == pytest.approx(8.0, abs=1e-2)
