"""Largest push survived."""

import numpy as np
import pytest

from op3.common.settings import CONTROL_PERIOD
from op3.compliance.pushing import Survival, survive_pushes
from op3.envs import make_env
from op3.envs.actors import find_actor
from op3.tasks import find_task
from op3.tasks.pushes import DIRECTIONS, Push


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


@pytest.fixture(scope="module")
def all_at_once() -> Survival:
    """Sixteen pushes of a stiff walk, each on a robot of its own."""
    return ladder(rows=16)


def ladder(rows: int) -> Survival:
    task = find_task("walk")
    return survive_pushes(find_actor("stiff", task), "paper", task, most=3.0, rungs=2, episodes=1, seed=3, rows=rows)


@pytest.mark.parametrize("rows", [3, pytest.param(7, marks=pytest.mark.slow)])
def test_every_push_is_survived_or_not_whatever_is_beside_it(all_at_once, rows):
    """Fewer robots than pushes, which restart at different times: push by push as with a robot for each."""
    assert 0 < all_at_once.survived.sum() < all_at_once.survived.size
    assert np.array_equal(ladder(rows).survived, all_at_once.survived)


def test_a_restart_leaves_the_pushes_of_the_others():
    """A robot that starts over gets the task's push, and the others keep what they were given."""
    env = make_env("walk_push", num_envs=3, num_threads=1)
    env.reset()
    event = env.mdp.event("pushing")
    event.replace(np.arange(3), [Push.towards(number, 2.0 + number, 1.0) for number in range(3)])
    env.begin({1: 4})
    impulse = np.zeros((3, 3))
    for time in np.arange(0.0, 4.0, CONTROL_PERIOD):
        event.tick(np.full(3, time))
        wrench = env.mdp._world.base_wrench
        impulse += CONTROL_PERIOD * wrench[:, :3]
    np.testing.assert_allclose(np.linalg.norm(impulse, axis=1), [2.0, 1.0, 4.0])
