"""The OP3 itself: joints, model, poses, scenes and motions."""

from op3.robot.assets import asset_path, named_configs
from op3.robot.board import BoardDrive, BoardMotion, Tilts, Waves, WeightDrive, WeightSchedule, board_drive
from op3.robot.joints import (
    CONTROLLED_JOINTS,
    GEAR_RATIO,
    HELD_JOINTS,
    JOINT_AXES,
    JOINTS,
    MIRROR,
    SERVO_IDS,
    SOFT_LIMITS,
    indices,
    mirror,
)
from op3.robot.kinematics import KEY_POINTS, center_of_mass, key_points, quaternion, sole_corners
from op3.robot.motions import Motion, hold, squat
from op3.robot.op3_entity import OP3
from op3.robot.poses import POSES, pose, standing_height
from op3.robot.scenes import SCENES, Scene, build_bench, build_scene
from op3.robot.surfaces import draw_tiles, place_tiles, tile_ids
from op3.robot.walking import SinusoidalGait

__all__ = [
    "CONTROLLED_JOINTS",
    "GEAR_RATIO",
    "HELD_JOINTS",
    "JOINTS",
    "JOINT_AXES",
    "KEY_POINTS",
    "MIRROR",
    "OP3",
    "POSES",
    "SCENES",
    "SERVO_IDS",
    "SOFT_LIMITS",
    "BoardDrive",
    "BoardMotion",
    "Motion",
    "Scene",
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
    "draw_tiles",
    "hold",
    "indices",
    "key_points",
    "mirror",
    "named_configs",
    "place_tiles",
    "pose",
    "quaternion",
    "sole_corners",
    "squat",
    "standing_height",
    "tile_ids",
]
