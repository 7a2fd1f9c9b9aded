"""Intervals on linear problems, where the truth and the noise are known."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from op3.identify.intervals import followed_from_bounds, intervals_of
from op3.identify.polish import polish
from op3.identify.sensitivity import Box, Residuals, Sensitivity

NAMES = ("a", "b", "c", "d")
BOX = {name: (-10.0, 10.0) for name in NAMES}
TRUTH = np.array([1.0, -2.0, 0.5, 3.0])


def intervals(residuals, box, estimate, blocks, failed_loss=np.inf):
    """Intervals around an estimate that is left where it is."""
    return intervals_of(polish(residuals, Box.of(box), estimate, steps=0, failed_loss=failed_loss).sensitivity, blocks)


def problem(rng: np.random.Generator, rows: int, memory: float):
    """Residual function and least-squares estimate of a regression with autocorrelated noise."""
    design = rng.normal(size=(rows, len(NAMES)))
    noise = rng.normal(size=rows)
    for row in range(1, rows):
        noise[row] = memory * noise[row - 1] + np.sqrt(1 - memory**2) * noise[row]
    measured = design @ TRUTH + noise
    estimate = np.linalg.lstsq(design, measured, rcond=None)[0]

    def residuals(unit: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy((unit.numpy() * 20 - 10) @ design.T - measured)

    return residuals, dict(zip(NAMES, estimate, strict=True))


@pytest.mark.parametrize("memory", [0.0, 0.8])
def test_coverage(memory):
    """Over 150 random problems the 90 % intervals hold the truth in 85 to 97 %, also with correlated noise."""
    rng = np.random.default_rng(0)
    hits = []
    for _ in range(150):
        residuals, estimate = problem(rng, 400, memory)
        blocks = np.split(np.arange(400), 10)
        found = intervals(residuals, BOX, estimate, blocks)
        hits += [low <= truth <= high for (low, high), truth in zip(found.values(), TRUTH, strict=True)]
    assert 0.85 <= np.mean(hits) <= 0.97


def test_what_the_data_do_not_see_gets_its_whole_range():
    """A parameter without influence is said to be undetermined."""
    residuals, estimate = problem(np.random.default_rng(1), 200, 0.0)
    blind = {**BOX, "e": (0.0, 5.0)}
    found = intervals(lambda unit: residuals(unit[:, :4]), blind, {**estimate, "e": 1.0}, np.split(np.arange(200), 10))
    assert found["e"] == (0.0, 5.0)
    assert found["a"][1] - found["a"][0] < 1.0


def test_a_diverging_neighbourhood_is_no_knowledge():
    """Where a step of the finite differences diverges, its parameter's interval is the range."""
    residuals, estimate = problem(np.random.default_rng(2), 200, 0.0)

    def cliff(unit: torch.Tensor) -> torch.Tensor:
        result = residuals(unit)
        fallen = unit[:, 0] * 20 - 10 > estimate["a"] + 0.01
        return torch.where(fallen[:, None], 1e3, result)

    found = intervals(cliff, BOX, estimate, np.split(np.arange(200), 10), failed_loss=1e6)
    assert found["a"] == (-10.0, 10.0)
    assert found["b"][1] - found["b"][0] < 2.0


def test_jumps_are_not_taken_for_knowledge():
    """Where little more than a sum of two parameters matters, jumps of the residual widen the interval of each."""
    rng = np.random.default_rng(3)
    design = rng.normal(size=(400, 1)) * np.array([[1.0, 1.0]]) + 0.02 * rng.normal(size=(400, 2))
    noise = 0.002 * rng.normal(size=400)
    waves, phase = rng.normal(size=(400, 2)), rng.uniform(0, 6, 400)
    box = {"a": (-1.0, 1.0), "b": (-1.0, 1.0)}
    blocks = np.split(np.arange(400), 10)
    widths = {}
    for jump in (0.0, 0.05):

        def residuals(unit: torch.Tensor, jump: float = jump) -> torch.Tensor:
            value = unit.numpy() * 2 - 1
            return torch.from_numpy(value @ design.T - noise + jump * np.sign(np.sin(3e3 * value @ waves.T + phase)))

        low, high = intervals(residuals, box, {"a": 0.0, "b": 0.0}, blocks)["a"]
        assert low <= 0.0 <= high
        widths[jump] = high - low
    assert widths[0.0] < 0.05
    assert widths[0.05] > 2 * widths[0.0]


def test_an_effect_that_sets_in_at_a_bound_is_followed_away_from_it():
    """A parameter that acts only near its bound is not told by its slope there; one that acts everywhere is."""
    rng = np.random.default_rng(3)
    design, noise = rng.normal(size=(400, 2)), rng.normal(size=400)

    def problem_of(acts: Callable[[np.ndarray], np.ndarray]) -> tuple[Residuals, Sensitivity]:
        def residuals(unit: torch.Tensor) -> torch.Tensor:
            moved = np.stack([4.0 * (unit.numpy()[:, 0] - 0.5), acts(unit.numpy()[:, 1])], 1)
            return torch.from_numpy(noise + moved @ design.T)

        slope = (acts(np.array([1.0])) - acts(np.array([0.95]))) / 0.05
        jacobian = design * np.array([4.0, float(slope[0])])
        box, at, none = Box.of({"steady": (0.0, 1.0), "late": (0.0, 1.0)}), np.array([0.5, 1.0]), np.zeros(2)
        seen = (np.zeros((2, 400)), none > 0, jacobian.T @ jacobian, np.eye(2), none)
        return residuals, Sensitivity(box, at, noise, jacobian, *seen)

    told = {"steady": (0.45, 0.55), "late": (0.95, 1.0)}
    # from 0.97 down it does nothing more
    residuals, sensitivity = problem_of(lambda value: np.maximum(value - 0.97, 0.0) * 4.0)
    assert followed_from_bounds(residuals, sensitivity, told) == {"steady": (0.45, 0.55), "late": (0.0, 1.0)}
    residuals, sensitivity = problem_of(lambda value: (value - 1.0) * 4.0)
    assert followed_from_bounds(residuals, sensitivity, told) == told
