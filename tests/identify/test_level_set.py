"""Draws from the level set of a least-squares loss."""

import numpy as np
import pytest
import torch

from op3.identify.level_set import draw_level_set
from op3.identify.polish import polish
from op3.identify.sensitivity import Box

BOUNDS = {"a": (0.0, 1.0), "b": (0.0, 1.0), "c": (0.0, 1.0)}
CENTRE = np.array([0.5, 0.4, 0.9])
MATRIX = np.array([[20.0, 18.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 0.05], [0.0, 0.0, 0.0]])
"""Parameters a and b compensate each other, c hardly matters; the last residual is noise that nothing explains."""


def residuals(points):
    """Linear in the parameters, 1 at the optimum."""
    return torch.from_numpy((points.numpy() - CENTRE) @ MATRIX.T + np.array([0.0, 0.0, 0.0, 1.0]))


def loss(points):
    """Square of the residuals' length."""
    return np.square(residuals(torch.from_numpy(points)).numpy()).sum(1)


@pytest.fixture(scope="module")
def draws():
    """400 points where the loss of 1 has risen by a quarter at most."""
    found = polish(residuals, Box.of(BOUNDS), dict(zip(BOUNDS, CENTRE, strict=True)), steps=0).sensitivity
    hessian, gradient = found.jacobian.T @ found.jacobian, found.jacobian.T @ found.residual
    return draw_level_set(found.unit, hessian, gradient, 0.25, 400, np.random.default_rng(0))


def test_the_loss_rises_by_no_more_than_asked(draws):
    """The residuals are linear, so the ellipsoid is exact; draws fill it up to its edge and stay in the box."""
    rise = loss(draws) - 1.0
    assert rise.max() <= 0.25 + 1e-9
    assert rise.max() > 0.2
    assert draws.min() >= 0.0
    assert draws.max() <= 1.0


def test_parameters_that_compensate_each_other_move_together(draws):
    """Uniform on an ellipsoid, cov = rise H^-1 / (n + 2): the draws are correlated as its axes say."""
    hessian = (MATRIX.T @ MATRIX)[:2, :2]
    expected = np.linalg.inv(hessian)
    expected = expected[0, 1] / np.sqrt(expected[0, 0] * expected[1, 1])  # -0.96
    assert np.corrcoef(draws[:, :2].T)[0, 1] == pytest.approx(expected, abs=0.03)


def test_a_parameter_that_nothing_determines_fills_its_range(draws):
    """The loss hardly knows c: its draws reach from end to end."""
    assert draws[:, 2].min() < 0.1
    assert draws[:, 2].max() > 0.9
