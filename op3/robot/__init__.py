"""The OP3 itself: joints, model, poses, scenes and motions."""

from op3.robot.assets import asset_path, named_configs
from op3.robot.board import BoardDrive, BoardMotion, Tilts, Waves, WeightDrive, WeightSchedule, board_drive
from op3.robot.entity import RobotEntity
from op3.robot.excitations import chirp, multisine, push_down, soften, staircase, sway, triangle
from op3.robot.joints import (
    CONTROLLED_JOINTS,
    GEAR_RATIO,
    HELD_JOINTS,
    JOINTS,
    MIRROR,
    SERVO_IDS,
    SOFT_LIMITS,
    indices,
    mirror,
)
from op3.robot.kinematics import KEY_POINTS, center_of_mass, key_points, quaternion, sole_corners
from op3.robot.leg_excitations import LEG_JOINTS, Excitation, leg_suite, leg_walking
from op3.robot.motion_checks import check_motion, motion_faults
from op3.robot.motions import Motion, hold, squat
from op3.robot.op3_entity import OP3
from op3.robot.poses import POSES, pose, standing_height
from op3.robot.robot import Robot, load_robot
from op3.robot.robot_excitations import robot_suite, robot_walking
from op3.robot.scenes import SCENES, Scene, build_bench, build_scene
from op3.robot.servo_make import ServoMake, load_servo
from op3.robot.surfaces import draw_tiles, place_tiles, tile_ids
from op3.robot.walking import SinusoidalGait

__all__ = [
    "CONTROLLED_JOINTS",
    "GEAR_RATIO",
    "HELD_JOINTS",
    "JOINTS",
    "KEY_POINTS",
    "LEG_JOINTS",
    "MIRROR",
    "OP3",
    "POSES",
    "SCENES",
    "SERVO_IDS",
    "SOFT_LIMITS",
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
    "center_of_mass",
    "check_motion",
    "chirp",
    "draw_tiles",
    "hold",
    "indices",
    "key_points",
    "leg_suite",
    "leg_walking",
    "load_robot",
    "load_servo",
    "mirror",
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
    "staircase",
    "standing_height",
    "sway",
    "tile_ids",
    "triangle",
]
