"""The composer entity: elements, sensors, observables."""

from op3.robot import RobotEntity
from tests.op3_table import JOINTS, KEY_POINTS, OP3


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
