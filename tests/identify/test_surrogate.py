"""The search with a surrogate of the residuals, on problems with known answers."""

import numpy as np
import pytest
import torch

from op3.identify.refine import refine
from op3.identify.sensitivity import Box
from op3.identify.surrogate import explore

SIZE = 6
TRUTH = np.array([0.7, 0.25, 0.6, 0.35, 0.8, 0.45])
MIXING = np.random.default_rng(1).standard_normal((60, SIZE))
RIPPLES = np.random.default_rng(2).standard_normal((60, SIZE))
BOX = Box.of({f"p{i}": (0.0, 1.0) for i in range(SIZE)})


def rugged(unit: torch.Tensor) -> torch.Tensor:
    """Residuals that bend gently and ripple on a small scale, as friction makes them; zero at `TRUTH`."""
    away = unit.numpy() - TRUTH
    smooth = away @ MIXING.T + 0.5 * np.square(away) @ MIXING[:, ::-1].T
    return torch.from_numpy(smooth + 0.12 * np.sin(60 * away @ RIPPLES.T))


def uniform(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(size=(count, SIZE))


def simulate(points: np.ndarray) -> np.ndarray:
    return rugged(torch.from_numpy(points)).numpy()


@pytest.mark.parametrize("seed", range(3))
def test_hollows_that_stop_least_squares_are_crossed(seed: int):
    """Least squares from the two best of forty points ends far from the truth; with rounds before, at it."""
    points = uniform(40, seed)
    order = np.argsort(np.square(simulate(points)).sum(1))
    starts = [BOX.values(points[i]) for i in order[:2]]
    alone = refine(rugged, BOX, starts, max_iterations=12)
    found = explore(rugged, points, simulate(points), rounds=7, seed=seed)
    assert np.abs(np.array(list(alone.values.values())) - TRUTH).max() > 0.1
    assert found.losses[0] < 0.3 * alone.loss
    assert np.abs(found.points[0] - TRUTH).max() < 0.06


def test_linear_residuals_are_solved_in_two_rounds():
    """Where nothing bends, the surrogate is Gauss-Newton and comes to the minimum at once."""

    def linear(unit: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy((unit.numpy() - TRUTH) @ MIXING.T)

    points = uniform(20, 0)
    found = explore(linear, points, linear(torch.from_numpy(points)).numpy(), rounds=2, batch=6)
    assert np.abs(found.points[0] - TRUTH).max() < 0.01


def test_the_search_repeats_itself():
    """The same seed proposes the same points, another seed others; all lie in the box."""
    points = uniform(20, 5)
    first, second, other = (
        explore(rugged, points, simulate(points), rounds=2, batch=5, seed=seed) for seed in (1, 1, 2)
    )
    assert np.array_equal(first.points, second.points)
    assert not np.array_equal(first.points, other.points)
    assert first.points.min() >= 0
    assert first.points.max() <= 1
    assert len(first.points) == 30


def test_what_diverged_does_not_teach():
    """A region where every simulation fails is left alone, and the minimum beside it is found."""

    def failing(unit: torch.Tensor) -> torch.Tensor:
        residual = rugged(unit)
        residual[unit[:, 0] > 0.85] = 10.0
        return residual

    points = uniform(40, 6)
    first = failing(torch.from_numpy(points)).numpy()
    found = explore(failing, points, first, rounds=6, failed_loss=5000.0)
    assert np.abs(found.points[0] - TRUTH).max() < 0.1
    with pytest.raises(ValueError, match="every simulation failed"):
        explore(failing, points, np.full_like(first, 10.0), rounds=1, failed_loss=5000.0)
