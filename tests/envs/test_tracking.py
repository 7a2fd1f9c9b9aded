"""How well a walk obeys its commands, on courses worked out by hand and on a robot that stands."""

import numpy as np
import pytest

from op3.envs.actors import find_actor
from op3.envs.tracking import Course, held, measure_obedience, walk_course
from op3.tasks import find_task
from op3.tasks.task import POLICY_PERIOD


def course(velocity: np.ndarray, command: np.ndarray, fallen_from: int | None = None) -> Course:
    """One robot."""
    steps = len(velocity)
    upright = np.ones((steps, 1), dtype=bool)
    upright[fallen_from if fallen_from is not None else steps :] = False
    return Course(command[:, None], velocity[:, None], np.zeros((steps, 1)), np.zeros((steps, 1, 2)), upright)


def test_errors_by_hand():
    """Half of what is asked for forwards, a sway of a stride's period sideways that averages out, exact turning."""
    steps, stride = 250, round(1.0 / POLICY_PERIOD)
    command = np.tile([0.2, 0.0, 0.3], (steps, 1))
    velocity = command * [0.5, 1.0, 1.0]
    velocity[:, 1] = 0.1 * np.sin(2 * np.pi * np.arange(steps) / stride)
    np.testing.assert_allclose(course(velocity, command).errors(1.0), [0.1, 0.0, 0.0], atol=1e-9)


def test_a_stride_counts_under_one_command_and_upright():
    """A stride that a change of the command divides, or a fall, does not count; one that starts late does."""
    steps, stride = 250, round(1.0 / POLICY_PERIOD)
    command = np.zeros((steps, 3))
    command[100:, 0] = 0.2
    velocity = command.copy()
    velocity[200:, 0] = -5.0  # lies on the floor
    made = course(velocity, command, fallen_from=200)
    assert made.errors(1.0)[0] == pytest.approx(0.0, abs=1e-9)
    velocity[100 : 100 + stride, 0] = 0.0
    assert made.errors(1.0)[0] > 0.02


def test_a_robot_that_stands_obeys_a_zero_command_alone():
    """The stiff hold misses a commanded speed by all of it, and stops at once."""
    task = find_task("walk_command", duration=5.0)
    actor = find_actor("hold", task)
    walked = walk_course(actor, "paper", held(task, (0.1, 0.0, 0.0), 3.0), robots=2, seed=0, num_threads=1)
    assert walked.upright.all()
    assert walked.errors(1.0)[0] == pytest.approx(0.1, abs=0.01)
    with pytest.raises(ValueError, match="task walk commands no velocity; give task=walk_command"):
        measure_obedience(actor, "paper", find_task("walk"))
