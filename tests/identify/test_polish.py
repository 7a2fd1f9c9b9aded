"""The last steps on problems with known answers."""

import numpy as np
import torch

from op3.identify.polish import polish
from op3.identify.sensitivity import Box

SIZE = 4
BOX = {f"p{i}": (0.0, 2.0) for i in range(SIZE)}
TRUTH = np.array([0.55, 0.4, 0.6, 0.45])
"""As a share of the ranges."""


def valley(jump: float):
    """Residuals that say much of three combinations and a hundredth of it of the fourth, and jump everywhere."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(SIZE, SIZE)))[0]
    design = rng.normal(size=(500, SIZE)) @ (np.array([[1.0], [1.0], [1.0], [0.01]]) * axes.T)
    waves, phase = rng.normal(size=(500, SIZE)), rng.uniform(0, 6, 500)
    noise = 0.002 * rng.normal(size=500)

    def residuals(unit: torch.Tensor) -> torch.Tensor:
        away = unit.numpy() - TRUTH
        return torch.from_numpy(away @ design.T + noise + jump * np.sign(np.sin(3e3 * away @ waves.T + phase)))

    return residuals, axes[:, 3], design


def start_along(weak: np.ndarray) -> dict[str, float]:
    return dict(zip(BOX, (2 * (TRUTH + 0.25 * weak)).tolist(), strict=True))


def test_a_valley_is_walked_along_in_two_steps():
    """From a quarter of the ranges up a valley whose slope is a ten thousandth, two steps come to its bottom."""
    residuals, weak, _ = valley(jump=0.0)
    end = polish(residuals, Box.of(BOX), start_along(weak), steps=2)
    found = np.array(list(end.values.values())) / 2
    # noise of 0.002 in 500 rows leaves 0.002 / (0.01 sqrt(500)) = 0.009 of the ranges
    assert abs((found - TRUTH) @ weak) < 0.03
    assert len(end.history) <= 3
    assert np.all(np.diff(end.history) <= 0)


def test_jumps_do_not_hide_a_valley():
    """Differences over a hundredth of the ranges take jumps for information; the arms grow until they do not."""
    residuals, weak, design = valley(jump=0.004)
    middle = dict(zip(BOX, (2 * TRUTH).tolist(), strict=True))
    jacobian = polish(residuals, Box.of(BOX), middle, steps=0).sensitivity.jacobian
    told = np.linalg.norm(jacobian @ weak)
    short = np.eye(SIZE) * 0.01
    ends = residuals(torch.from_numpy(np.concatenate([TRUTH + short, TRUTH - short]))).numpy()
    feigned = np.linalg.norm(((ends[:SIZE] - ends[SIZE:]) / 0.02).T @ weak)
    truth = np.linalg.norm(design @ weak)
    assert feigned > 5 * truth
    assert 0.5 * truth < told < 2 * truth
