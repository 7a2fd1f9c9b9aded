"""Intervals against tables."""

import pytest

from op3.common.sample_intervals import mean_interval, wilson_interval


def test_interval_of_a_mean():
    """Of 1, 2, 3 the mean is 2, the deviation 1, and t for two degrees of freedom is 4.303: 2 +- 2.484."""
    assert mean_interval([1.0, 2.0, 3.0]) == pytest.approx((2 - 4.3027 / 3**0.5, 2 + 4.3027 / 3**0.5), abs=1e-3)


def test_interval_of_a_share():
    """10 of 10 leave 72 to 100 %, and half of 20 leaves 30 to 70 % (Wilson's interval, tabulated)."""
    assert wilson_interval(10, 10) == pytest.approx((0.7225, 1.0), abs=1e-4)
    assert wilson_interval(10, 20) == pytest.approx((0.2993, 0.7007), abs=1e-4)


def test_wilson_agrees_with_published_values():
    """0 of 120 proves less than 3.1 % (two-sided 95 %); 3 of 120 gives [0.9, 7.1] %; 1 of 2 is [9.5, 90.5] %."""
    assert wilson_interval(0, 120) == pytest.approx((0.0, 3.8415 / (120 + 3.8415)), abs=1e-4)
    assert wilson_interval(3, 120) == pytest.approx((0.00854, 0.0709), abs=3e-4)
    assert wilson_interval(1, 2) == pytest.approx((0.0945, 0.9055), abs=1e-3)
