"""What is read from a policy's log."""

import numpy as np
import pytest

from op3.robot import load_robot
from op3.rollout import Metadata, Rollout
from op3.tasks.behaviour import gains, gait_profile, in_stance, mean_tilt
from op3.tasks.task import find_task
from tests.op3_table import CONTROLLED_JOINTS, JOINTS

PERIOD = 0.008
ROWS = 500


def walking_log() -> Rollout:
    """4 s in which the right leg is stiff (5 A/rad) in stance and soft (1 A/rad) in swing; the left is always at 3."""
    time = np.arange(ROWS)[:, None] * PERIOD
    gain = np.full((ROWS, len(JOINTS)), 6.0)
    gain[:, [JOINTS.index(joint) for joint in CONTROLLED_JOINTS]] = 3.0
    right = [JOINTS.index(joint) for joint in CONTROLLED_JOINTS if joint.startswith("r_")]
    # the right foot is half a cycle behind and swings in the first 0.3 of its cycle of 1 s
    phase = np.remainder(time[:, 0] + 0.5, 1.0)
    gain[:, right] = np.where(phase < 0.3, 1.0, 5.0)[:, None]
    position = np.zeros((ROWS, len(JOINTS)))
    position[:, JOINTS.index("r_ank_pitch")] = np.sin(2 * np.pi * time[:, 0])
    orientation = np.tile([0.03, 0.04, 1.0], (ROWS, 1))
    arrays = {
        "time": time,
        "joint/position": position,
        "command/position": position,
        "command/p_gain": gain,
        "imu/orientation": orientation,
    }
    metadata = Metadata(joints=JOINTS, robot="simulated", mount="floor", rate=125.0, policy_rate=31.25)
    return Rollout.from_arrays(arrays, metadata)


def test_stance_is_seven_tenths_of_the_cycle_and_the_feet_alternate():
    """Each foot carries in 70 % of the cycle; the right foot's stance is the left's half a cycle later."""
    stance = in_stance(walking_log(), "walk")
    assert stance.mean(0) == pytest.approx([0.7, 0.7], abs=0.02)
    half = round(0.5 / PERIOD)
    agree = (stance[half:, 1] == stance[:-half, 0]).mean()
    assert agree > 0.97
    assert in_stance(walking_log(), "balance").all()


def test_gains_in_stance_and_swing():
    """With the left leg at 3 and the right at 5 in stance and 1 in swing, the means are 4 and 2 A/rad."""
    values = gains(walking_log(), "walk")
    assert values["gain_stance"] == pytest.approx(4.0, abs=0.05)
    assert values["gain_swing"] == pytest.approx(2.0, abs=0.05)
    # 0.7 * 4 + 0.3 * 2
    assert values["gain"] == pytest.approx(3.4, abs=0.05)
    assert set(gains(walking_log(), "balance")) == {"gain"}


def test_gains_of_a_quadruped_are_those_of_its_four_legs():
    """Diagonal feet stand together: legs that are stiff while the clock says so have that gain in stance."""
    robot, time = load_robot("quadruped"), np.arange(ROWS)[:, None] * PERIOD
    task = find_task("walk", robot="quadruped")
    arrays = {key: np.zeros((ROWS, len(robot.joints))) for key in ("joint/position", "command/position")}
    metadata = Metadata(joints=robot.joints, robot="simulated", mount="floor", rate=125.0, policy_rate=31.25)
    log = Rollout.from_arrays({"time": time, "command/p_gain": np.ones((ROWS, 12)), **arrays}, metadata)
    stance = in_stance(log, task)
    assert (stance[:, 0] == stance[:, 3]).all()
    assert (stance[:, 1] == stance[:, 2]).all()
    assert stance.mean(0) == pytest.approx([0.7] * 4, abs=0.02)
    stiff = np.concatenate([np.where(foot, 5.0, 1.0)[:, None].repeat(3, 1) for foot in stance.T], 1)
    values = gains(Rollout.from_arrays({"time": time, "command/p_gain": stiff, **arrays}, metadata), task)
    assert (values["gain_stance"], values["gain_swing"]) == (5.0, 1.0)


def test_mean_tilt():
    """A trunk rolled by 0.03 and pitched by 0.04 rad is tilted by 0.05 rad, whatever its yaw."""
    assert mean_tilt(walking_log()) == pytest.approx(0.05)


def test_gait_profile_over_the_phase():
    """The profile of a sine is that sine at the middle of each bin, and the gain is low where the foot swings."""
    profile = gait_profile([walking_log()], "walk", "r_ank_pitch", bins=20)
    np.testing.assert_allclose(profile.target, np.sin(2 * np.pi * profile.phase), atol=0.03)
    assert profile.gain[profile.stance].mean() == pytest.approx(5.0, abs=0.1)
    assert profile.gain[~profile.stance].mean() == pytest.approx(1.0, abs=0.4)
    with pytest.raises(ValueError, match="has no gait"):
        gait_profile([walking_log()], "balance")
