"""The composer entity: elements, sensors, observables."""

import numpy as np
import pytest
from dm_control import mjcf

from op3.robot import RobotEntity, build_scene, key_points, pose
from op3.robot.kinematics import rotation_matrix
from tests.op3_table import JOINTS, KEY_POINTS, OP3


@pytest.fixture(scope="module")
def tilted():
    """A robot in a tilted stand, and the physics of it."""
    scene = build_scene("stand", tilt_roll=0.2, tilt_pitch=-0.3)
    physics = mjcf.Physics.from_mjcf_model(scene.mjcf_model)
    with physics.reset_context():
        physics.bind(scene.joints).qpos = pose("stand")
        physics.bind(scene.joints).qvel = np.linspace(-1, 1, 20)
    return scene.robot, physics


def test_elements():
    """Joints, key points and soles come in the order of their names."""
    robot = RobotEntity(OP3)
    assert [joint.name for joint in robot.joints] == list(JOINTS)
    assert [site.name for site in robot.key_points] == list(KEY_POINTS)
    assert [sole.name for sole in robot.soles] == ["l_sole_long", "l_sole_wide", "r_sole_long", "r_sole_wide"]
    assert robot.imu.parent is robot.trunk


def test_nothing_is_actuated():
    """The entity brings no actuators: servos are attached by whoever models them."""
    assert RobotEntity(OP3).mjcf_model.find_all("actuator") == []


def test_joint_observables(tilted):
    """Joint observables are angles and velocities in the common order."""
    robot, physics = tilted
    np.testing.assert_allclose(robot.observables.joint_positions(physics), pose("stand"))
    np.testing.assert_allclose(robot.observables.joint_velocities(physics), np.linspace(-1, 1, 20))


def test_key_points_are_relative_to_the_trunk(tilted):
    """Key points do not depend on the tilt of the stand: they are in the trunk's frame."""
    robot, physics = tilted
    np.testing.assert_allclose(robot.observables.key_points(physics), key_points(pose("stand")), atol=1e-12)


def test_imu_at_rest(tilted):
    """A fixed IMU reads its tilt, no rate, and gravity upwards as specific force."""
    robot, physics = tilted
    w, x, y, z = robot.observables.imu_orientation(physics)
    assert np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)) == pytest.approx(0.2)
    assert np.arcsin(2 * (w * y - z * x)) == pytest.approx(-0.3)
    np.testing.assert_allclose(robot.observables.imu_gyro(physics), 0.0, atol=1e-12)
    up = rotation_matrix(0.2, -0.3).T @ [0.0, 0.0, 9.81]
    np.testing.assert_allclose(robot.observables.imu_accelerometer(physics), up, atol=1e-9)


def test_imu_in_free_fall():
    """A free robot that falls without touching anything feels no force."""
    scene = build_scene("floor")
    physics = mjcf.Physics.from_mjcf_model(scene.mjcf_model)
    with physics.reset_context():
        physics.data.qpos[:] = scene.initial_qpos(pose("stand"))
        physics.data.qpos[2] += 1.0
    assert scene.robot is not None
    np.testing.assert_allclose(scene.robot.observables.imu_accelerometer(physics), 0.0, atol=1e-9)
