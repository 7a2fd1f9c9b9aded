"""Robots and servos as data."""

from op3.common.assets import asset_path
from op3.robot.entity import RobotEntity
from op3.robot.kinematics import key_points, quaternion, standing_height
from op3.robot.robot import DEFAULT, Robot, load_robot, pose
from op3.robot.servo_make import ServoMake, load_servo, supply_shares

__all__ = [
    "DEFAULT",
    "Robot",
    "RobotEntity",
    "ServoMake",
    "asset_path",
    "key_points",
    "load_robot",
    "load_servo",
    "pose",
    "quaternion",
    "standing_height",
    "supply_shares",
]
