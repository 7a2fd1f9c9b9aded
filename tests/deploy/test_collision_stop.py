"""A run ends before parts of the robot hit each other, by what is measured and by what is commanded."""

import numpy as np
import pytest
from deploy_rig import make_rig

from op3.deploy.exit_codes import ExitCode
from op3.deploy.limits import Limits
from op3.deploy.phases import GainRamp, HoldPose, Move
from op3.robot import pose
from op3.robot.self_collision import HORIZON, SelfCollision
from tests.op3_table import JOINTS, OP3
from tests.self_collision import PartDistances

LEFT, RIGHT = JOINTS.index("l_hip_roll"), JOINTS.index("r_hip_roll")


def crossed(angle: float) -> np.ndarray:
    """The stand pose with both legs turned inwards by an angle [rad]; the soles meet at 0.045."""
    position = pose("stand", "op3")
    position[LEFT], position[RIGHT] = angle, -angle
    return position


def test_a_collision_that_is_coming_is_seen_before_it_is_there():
    """Legs that close at 4 rad/s are reported while they are apart, and those at rest there are not."""
    parts, apart = SelfCollision(OP3, margin=0.0), crossed(0.035)
    closing = np.zeros(len(JOINTS))
    closing[LEFT], closing[RIGHT] = 4.0, -4.0
    distances = PartDistances()
    assert distances.least(apart, distances.legs) > 0
    assert parts.measured(apart, 0.0 * closing) is None
    found = parts.measured(apart, closing)
    assert found is not None
    assert found.distance == pytest.approx(distances.least(apart + HORIZON * closing, distances.legs), abs=1e-5)
    assert {name[2:] for name in found.parts} <= {"sole_wide", "sole_long", "ankle", "shin"}


def test_a_soft_joint_may_be_sent_further():
    """Legs that are apart: a target 0.2 rad inside is refused at the highest gain and not at a sixth of it."""
    parts, apart, inside = SelfCollision(OP3, margin=0.0), crossed(0.03), crossed(0.2)
    assert parts.commanded(apart, inside, np.full(len(JOINTS), 6.0)) is not None
    assert parts.commanded(apart, inside, np.full(len(JOINTS), 1.0)) is None
    assert parts.commanded(apart, inside, np.zeros(len(JOINTS))) is None


def test_the_deepest_pair_is_reported():
    """In 100 poses the overlap is that of `mj_geomDistance` over all pairs, the head's aside."""
    parts, distances = SelfCollision(OP3, margin=0.0), PartDistances()
    rng, low, high = np.random.default_rng(2), *OP3.limits.T
    low, high = low.copy(), high.copy()
    low[:2] = high[:2] = 0.0  # the head at home
    for position in rng.uniform(low, high, (100, len(JOINTS))):
        gap, least = parts.nearest(position), distances.least(position)
        assert (0.0 if gap is None else gap.distance) == pytest.approx(min(least, 0.0), abs=5e-4)


def test_a_pose_that_is_measured_ends_the_run(tmp_path):
    """Joints that are moved by something else: damped, then off, with the two parts in the message."""
    rig = make_rig(tmp_path)

    class Pushed(HoldPose):
        def command(self, elapsed, state):
            if elapsed > 20:
                rig.physics.position = crossed(0.03 + 0.002 * (elapsed - 20))
            return super().command(elapsed, state)

    outcome = rig.run([GainRamp(), Pushed(pose("stand", "op3"), 0.1, duration=2.0)])
    assert outcome.code == ExitCode.SELF_COLLISION
    assert outcome.reason.startswith("parts of the robot collide at the measured angles: ")
    assert " mm into " in outcome.reason
    assert outcome.release.ok


def test_a_pose_that_is_commanded_ends_the_run(tmp_path):
    """A stiff target inside the other leg is refused before anything of it is written; damped, then off."""
    rig = make_rig(tmp_path)
    outcome = rig.run([GainRamp(), HoldPose(crossed(0.2), duration=1.0)])
    assert outcome.code == ExitCode.SELF_COLLISION
    assert outcome.reason.startswith("parts of the robot collide at the commanded angles: ")
    asked = round(6.0 * 0.2 / 0.00269)  # counts that the target would have been worth
    assert max(abs(values["l_hip_roll"]) for _, values in rig.written("goal_current")) < asked / 2
    assert outcome.release.ok


def test_limits_of_overlap_are_settings(tmp_path):
    """With limits of 0.1 m the same target is carried out."""
    rig = make_rig(tmp_path)
    limits = Limits(overlap=0.1, overlap_ahead=0.1)
    outcome = rig.run([GainRamp(), Move(crossed(0.2)), HoldPose(crossed(0.2), duration=0.1)], limits=limits)
    assert outcome.code == ExitCode.OK
    assert rig.physics.position[LEFT] > 0.15


def test_parts_in_each_other_before_the_start(tmp_path):
    """Nothing is energised, and the parts are named."""
    rig = make_rig(tmp_path, position=crossed(0.2))
    outcome = rig.run()
    assert outcome.code == ExitCode.START_CHECK
    assert any("FAIL self-collision: " in line and "apart by hand" in line for line in rig.lines)
    assert rig.written("torque_enable") == []
