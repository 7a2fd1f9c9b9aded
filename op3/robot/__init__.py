"""Robots and servos as data, scenes and motions; what is the OP3's by nature is in `op3_motions` and `op3_suites`."""

from op3.assets import asset_path, named_configs
from op3.robot.board import BoardDrive, BoardMotion, Tilts, Waves, WeightDrive, WeightSchedule, board_drive, stack
from op3.robot.entity import RobotEntity
from op3.robot.excitations import chirp, multisine, staircase, triangle
from op3.robot.kinematics import key_points, quaternion, sole_corners, standing_height
from op3.robot.motion_checks import check_motion, motion_faults
from op3.robot.motions import Motion, hold
from op3.robot.op3_motions import SinusoidalGait, push_down, soften, squat, sway
from op3.robot.op3_suites import Excitation, leg_suite, leg_walking, robot_suite, robot_walking
from op3.robot.robot import DEFAULT, Robot, load_robot, pose
from op3.robot.scenes import SCENES, Scene, build_bench, build_scene
from op3.robot.servo_make import ServoMake, load_servo, supply_shares
from op3.robot.surfaces import draw_tiles, place_tiles, tile_ids

__all__ = [
    "DEFAULT",
    "SCENES",
    "BoardDrive",
    "BoardMotion",
    "Excitation",
    "Motion",
    "Robot",
    "RobotEntity",
    "Scene",
    "ServoMake",
    "SinusoidalGait",
    "Tilts",
    "Waves",
    "WeightDrive",
    "WeightSchedule",
    "asset_path",
    "board_drive",
    "build_bench",
    "build_scene",
    "check_motion",
    "chirp",
    "draw_tiles",
    "hold",
    "key_points",
    "leg_suite",
    "leg_walking",
    "load_robot",
    "load_servo",
    "motion_faults",
    "multisine",
    "named_configs",
    "place_tiles",
    "pose",
    "push_down",
    "quaternion",
    "robot_suite",
    "robot_walking",
    "soften",
    "sole_corners",
    "squat",
    "stack",
    "staircase",
    "standing_height",
    "supply_shares",
    "sway",
    "tile_ids",
    "triangle",
]
