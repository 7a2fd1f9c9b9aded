"""How much of a change free runs can bear."""

import pytest

from op3.diagnose.soften import softened
from op3.robot import squat
from op3.servo.effects import Coulomb, VelocityFilter
from op3.sim import load_model
from op3.tasks import play, squat_task


def log_of(robot):
    return play(squat_task(robot, squat(frequency=1.0, duration=0.8), mount="stand"))


def test_free_runs_find_the_way_that_a_model_may_go():
    """Six tenths of what was asked for is what the robot has, in all joints and in the one that differs."""
    base = load_model("paper").without("coulomb").with_effect(Coulomb(), {"coulomb_friction": 0.06})
    knee = "coulomb_friction@joint=l_knee"
    asked = base.with_values({"coulomb_friction": 0.11, knee: 0.16})
    robot = base.with_values({"coulomb_friction": 0.09, knee: 0.12})
    found = softened(base, asked, [log_of(robot)])
    model, share = found[0]
    assert share == pytest.approx(0.6)
    assert model.estimate("coulomb_friction@joint=r_knee").value == pytest.approx(0.09)
    assert model.estimate(knee).value == pytest.approx(0.12)
    assert softened(base, asked, [log_of(base)]) == []
    assert [share for _, share in softened(base, asked, [log_of(asked)])] == pytest.approx([0.8, 0.6, 0.4, 0.2])


def test_an_effect_that_the_base_lacks_begins_at_nothing():
    """A filter that is asked for at 10 ms and is there at 4 is switched on at 4."""
    base = load_model("paper")
    asked = base.with_effect(VelocityFilter(), {"velocity_time_constant": 0.01})
    found = softened(base, asked, [log_of(asked.with_values({"velocity_time_constant": 0.004}))])
    assert found[0][0].value("velocity_time_constant") == pytest.approx(0.004)
    assert found[0][1] == pytest.approx(0.4)
