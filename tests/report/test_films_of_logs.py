"""A robot's states as its log tells them."""

import mujoco
import numpy as np
import pytest

from op3.motions import squat
from op3.replay import simulate_motion
from op3.report.video import states_of_log
from op3.scenes import build_scene
from op3.sim import load_model


@pytest.fixture(scope="module")
def log():
    """One second of a squat."""
    motion = squat()
    return simulate_motion(
        load_model("paper"), type(motion)(motion.time[:126], motion.position[:126], motion.joints, robot="op3")
    )


def test_joints_and_trunk_are_those_of_the_log(log):
    """At 12.5 Hz every tenth row is a frame; the trunk's frame leans as the IMU says."""
    scene = build_scene("floor", "op3")
    states = states_of_log(log, scene, 12.5)
    assert len(states) == 13
    np.testing.assert_allclose(states[:, 7:27], log.array("joint/position")[::10], atol=1e-12)
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, states[6, 3:7])
    roll, pitch, _ = log.array("imu/orientation")[60]
    assert -np.arcsin(matrix[6]) == pytest.approx(pitch, abs=1e-9)
    assert np.arctan2(matrix[7], matrix[8]) == pytest.approx(roll, abs=1e-9)


def test_the_soles_stay_where_they_began_and_a_board_lies_under_them(log):
    """The middle of the soles does not move; a robot that stands flat has a level board under it."""
    scene = build_scene("board", "op3")
    model, states = scene.compile(), states_of_log(log, build_scene("board", "op3"), 12.5)
    data = mujoco.MjData(model)
    soles = [i for i in range(model.nsite) if "sole" in model.site(i).name]
    middles = []
    for state in states:
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        middles.append(data.site_xpos[soles].mean(0))
    np.testing.assert_allclose(middles, np.broadcast_to(middles[0], (len(middles), 3)), atol=1e-9)
    assert np.abs(states[:, -2:]).max() < np.radians(3.0)
