"""Largest push survived."""

import numpy as np
import pytest

from op3.compliance.pushing import Survival, survive_pushes
from op3.envs.actors import find_actor
from op3.tasks import find_task
from op3.tasks.pushes import DIRECTIONS


def test_area_under_the_survival():
    """Thresholds spread evenly from 1 to 2 N s, on rungs of 0.1 N s: the mean threshold is 1.5 N s."""
    impulse = 3.0 * (np.arange(30) + 0.5) / 30
    thresholds = np.linspace(1.0, 2.0, 101)
    survived = np.tile(impulse[:, None] < thresholds, (DIRECTIONS, 1, 1))
    found = Survival(impulse, survived)
    assert found.mean_largest[0] == pytest.approx(1.5, abs=0.01)
    assert (found.largest[:, 1] < 1.5).all()
    assert (found.largest[:, 2] > 1.5).all()


def test_a_stiff_stand_is_pushed_over():
    """A standing robot survives a tenth of a newton second in all directions and 5 N s in none."""
    task = find_task("walk")
    found = survive_pushes(find_actor("hold", task), "paper", task, most=10.0, rungs=2, episodes=1)
    weak = survive_pushes(find_actor("hold", task), "paper", task, most=0.4, rungs=2, episodes=1)
    assert not found.survived[:, 1].any()
    assert weak.survived[:, 0].all()
