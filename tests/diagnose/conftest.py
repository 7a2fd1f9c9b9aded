"""What the tests of the diagnosis share."""

import numpy as np
import pytest
from contenders import BLOCKS


@pytest.fixture
def control() -> np.ndarray:
    """The base explains nothing more."""
    return np.ones(BLOCKS)


@pytest.fixture
def rng() -> np.random.Generator:
    """Of the resampling."""
    return np.random.default_rng(0)
