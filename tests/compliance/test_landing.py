"""Landings on scripted traces, and comparison of alike ones."""

import numpy as np
import pytest

from op3.compliance.landing import Landings, compare_landings, find_landings
from tests.envs.scripted import still


def test_peaks_of_a_scripted_landing():
    """A swing 15 mm high ends at 3 s with 90 N, 30 m/s^2 and 0.25 m/s; peaks after 50 ms do not count."""
    time = np.arange(5000)
    force = np.full((5000, 1, 2), 16.0, dtype=np.float32)
    force[2700:3000, 0, 0] = 0.0
    force[3020, 0, 0], force[3100, 0, 0] = 90.0, 200.0
    sole = np.zeros((5000, 1, 2), dtype=np.float32)
    sole[2700:3000, 0, 0], sole[3000:, 0, 0] = 0.020, 0.005
    acceleration = np.full((5000, 1), 1.0, dtype=np.float32)
    acceleration[3030] = 30.0
    traces = still(5000, force=force, acceleration=acceleration, sole=sole, ahead=(0.25 * time / 1000)[:, None])
    found = find_landings(traces, np.array([5000]))
    assert found.episode.tolist() == [0]
    expected = (90.0, 30.0, 0.25, 0.015)
    assert [found.force[0], found.acceleration[0], found.speed[0], found.height[0]] == pytest.approx(expected, abs=1e-5)


def landings(count: int, force: float, speed: float, seed: int) -> Landings:
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((3, count))
    return Landings(
        np.arange(count) // 10, force + 100 * (noise[0] * 0.05 + speed) + noise[1], np.full(count, 5.0),
        speed + 0.05 * noise[0], 0.02 + 0.001 * noise[2],
    )  # fmt: skip


def test_alike_landings_are_compared():
    """Peaks that grow by 100 N per m/s, and are 10 N higher at one speed: alike landings differ by 10 N."""
    ours, theirs = landings(300, 60.0, 0.20, 0), landings(300, 50.0, 0.28, 1)
    assert abs(ours.force.mean() - theirs.force.mean()) < 3
    found = compare_landings(ours, theirs)
    assert found.force is not None
    assert found.force[0] == pytest.approx(10.0, abs=1.0)
    assert found.force[1] < 10 < found.force[2]


def test_nothing_alike_nothing_compared():
    """Walks at speeds that do not overlap are not compared."""
    found = compare_landings(landings(100, 60.0, 0.1, 0), landings(100, 60.0, 0.9, 1))
    assert (found.pairs, found.force) == (0, None)
