"""Statistics of what an effect explains."""

import numpy as np
import pytest
from contenders import BLOCKS
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from op3.diagnose.evidence import difference_interval, pick_shares, signed_ranks


@given(st.lists(st.integers(-20, 20), min_size=8, max_size=60).filter(any))
def test_signed_ranks_are_wilcoxons(differences):
    """The standard score agrees with scipy's, with ties and zeros."""
    values = np.array(differences, dtype=float)
    score = stats.wilcoxon(values, alternative="greater", method="asymptotic", zero_method="wilcox").zstatistic
    assert signed_ranks(values) == pytest.approx(float(score), abs=1e-9)
    assert signed_ranks(-values) == pytest.approx(-float(score), abs=1e-9)


def test_shares_sum_to_one_and_follow_the_loss(rng):
    """Every resample has one winner, and a contender that is better in every block wins all."""
    losses = np.stack([np.full(BLOCKS, 2.0), np.full(BLOCKS, 1.0)])
    assert pick_shares(losses, rng).tolist() == [0.0, 1.0]


def test_interval_of_a_difference_covers_it(rng):
    """The difference of two losses lies in its interval."""
    better, worse = np.ones(BLOCKS), 1.2 + 0.1 * np.random.default_rng(3).normal(size=BLOCKS)
    low, high = difference_interval(better, worse, rng)
    assert low < (worse - better).sum() < high
