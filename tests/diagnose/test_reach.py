"""What a black box that is pushed into free runs leaves of a gap."""

import numpy as np
import pytest

from op3.diagnose import LogSplit, WindowResiduals, planned_suite
from op3.diagnose.reach import TorqueBox
from op3.diagnose.show import show, with_ceiling
from op3.robot import LEG_JOINTS, leg_suite
from op3.servo import Estimate, RobotModel
from op3.servo.effects import CableSpring
from op3.sim import load_model

KNEE = LEG_JOINTS.index("r_knee")
STIFFNESS, REST_ANGLE = 0.4, -0.9


def split_of(model: RobotModel) -> LogSplit:
    """Logs that a model gives; the last two show."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:10]
    logs = tuple(planned_suite(model, runs))
    return LogSplit(logs[:-4], logs[-4:-2], logs[-2:])


@pytest.fixture(scope="module")
def sprung() -> LogSplit:
    """Logs of a leg with a spring over its knee, of which the base knows nothing."""
    knee = Estimate(0.0, joints={"r_knee": STIFFNESS})
    return split_of(
        load_model("paper").with_effect(CableSpring(), {"cable_stiffness": knee, "cable_rest_angle": REST_ANGLE})
    )


def test_a_spring_is_learned_and_its_gap_closed(sprung):
    """The learned torque pulls the knee as the spring does, and free runs into which it is pushed come closer."""
    base = load_model("paper")
    box = TorqueBox(WindowResiduals(sprung), base)
    push = box.torques(sprung.show)
    for log, torque in zip(sprung.show, push, strict=True):
        assert torque.shape == (log.rows, len(LEG_JOINTS))
        spring = -STIFFNESS * (log.array("joint/position")[:, KNEE] - REST_ANGLE)
        assert np.corrcoef(spring, torque[:, KNEE])[0, 1] > 0.85
    before = show(base, base, sprung)["gap"]
    told = with_ceiling(before, sprung, base, push)["joint/position"]
    assert told["ceiling"] < 0.9 * told["before"]
    assert told["ceiling_interval"][0] <= told["ceiling"] <= told["ceiling_interval"][1]


def test_where_nothing_is_learned_the_ceiling_is_what_the_base_leaves():
    """Without a torque to push nothing is simulated, and the numbers are those of before."""
    gap = {"joint/position": {"before": 0.2, "before_interval": [0.1, 0.3], "ceiling": None}}
    model = load_model("paper")
    told = with_ceiling(gap, LogSplit((), (), ()), model, [])["joint/position"]
    assert (told["ceiling"], told["ceiling_interval"]) == (0.2, [0.1, 0.3])
    assert gap["joint/position"]["ceiling"] is None
