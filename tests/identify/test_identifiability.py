"""Identifiability on linear problems, whose information is known."""

import numpy as np
import pytest
import torch

from op3.identify.identifiability import identifiability, in_words, noise_scale
from op3.identify.intervals import intervals_of
from op3.identify.polish import polish
from op3.identify.sensitivity import Box

NAMES = ("backward_efficiency", "coulomb_friction", "armature")
BOX = {name: (0.0, 1.0) for name in NAMES}
MIDDLE = {name: 0.5 for name in NAMES}
BLOCKS = np.split(np.arange(400), 10)


def analyse(design: np.ndarray, noise: np.ndarray, channels=None, at=MIDDLE):
    """Identifiability of a regression around the middle of the box, or another point."""

    def residuals(unit: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy((unit.numpy() - 0.5) @ design.T + noise)

    sensitivity = polish(residuals, Box.of(BOX), at, steps=0).sensitivity
    channels = channels or {"joint/position": np.arange(400)}
    return identifiability(sensitivity, BLOCKS, channels, intervals_of(sensitivity, BLOCKS))


def test_two_parameters_that_do_the_same_are_named():
    """Only the sum of two parameters shows in the data: the sentence says that one trades for the other."""
    rng = np.random.default_rng(0)
    design = rng.normal(size=(400, 3))
    design[:, 1] = design[:, 0] + 1e-6 * rng.normal(size=400)
    known = analyse(design, 0.1 * rng.normal(size=400))
    assert len(known.unknown) == 1
    assert "trade off" in known.unknown[0]
    assert "with a lower" in known.unknown[0]
    assert "armature" not in known.unknown[0]
    assert known.identifiable == {"backward_efficiency": False, "coulomb_friction": False, "armature": True}
    assert known.correlation[0, 1] == pytest.approx(-1.0, abs=0.02)


def test_singular_values_are_those_of_the_whitened_design():
    """With independent noise of sigma, they are the design's divided by sigma."""
    rng = np.random.default_rng(1)
    design = rng.normal(size=(400, 3))
    known = analyse(design, 0.2 * rng.normal(size=400))
    expected = np.linalg.svd(design / 0.2, compute_uv=False)
    np.testing.assert_allclose(known.singular_values, expected, rtol=0.25)
    assert known.unknown == []


def test_a_noisy_channel_counts_less():
    """Each channel is divided by its own noise: what only the noisy one shows is known less well."""
    rng = np.random.default_rng(2)
    design = np.zeros((400, 3))
    even, odd = np.arange(0, 400, 2), np.arange(1, 400, 2)
    design[even, 0], design[odd, 1] = rng.normal(size=200), rng.normal(size=200)
    design[:, 2] = rng.normal(size=400)
    noise = rng.normal(size=400)
    noise[odd] *= 100.0
    known = analyse(design, noise, {"joint/position": even, "joint/current": odd})
    assert known.noise["joint/current"] > 20 * known.noise["joint/position"]
    assert "coulomb friction" in known.unknown[0]


def test_noise_that_lasts_counts_for_fewer_samples():
    """Noise that is the same throughout a block counts as one sample per block."""
    rng = np.random.default_rng(3)
    white = rng.normal(size=400)
    lasting = np.repeat(rng.normal(size=10), 40)
    index = np.arange(400)
    assert noise_scale(white, index, BLOCKS) == pytest.approx(1.0, rel=0.3)
    expected = np.sqrt(np.mean(lasting**2) * 40)
    assert noise_scale(lasting, index, BLOCKS) == pytest.approx(expected)


def test_a_parameter_that_ended_at_its_bound_is_no_finding():
    """However narrow its interval, the range ended there and not the data."""
    rng = np.random.default_rng(4)
    known = analyse(rng.normal(size=(400, 3)), 0.01 * rng.normal(size=400), at={**MIDDLE, "armature": 0.995})
    assert known.at_bound == ["armature"]
    assert known.identifiable == {"backward_efficiency": True, "coulomb_friction": True, "armature": False}


def test_one_parameter_alone_is_said_so():
    """A direction along one parameter is no trade-off."""
    assert in_words(NAMES, np.array([0.05, 0.99, 0.1])) == "coulomb friction is not identifiable from these logs"
