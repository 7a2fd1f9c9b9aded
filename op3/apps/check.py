"""Check a robot file: print its joints and the parts of its model in use, and draw its home pose.

op3 check robot=<robot.yaml> [out=<picture>.png]

As a command: op3 check <robot.yaml>. Exit code 1 if the file has an error.
"""

import sys
from pathlib import Path

from omegaconf import DictConfig

from op3.apps.command_result import CommandResult
from op3.apps.current_run import output_folder
from op3.report.frames import RenderError
from op3.report.robot_table import draw_robot, robot_table
from op3.robot import load_robot
from op3.robot.robot import robot_files


def main(cfg: DictConfig) -> CommandResult:
    """Print the joint table of a robot, and draw the robot."""
    robot = load_robot(cfg.robot)
    out, files = cfg.out, []
    if out is None and robot.path not in robot_files().values():
        out = robot.path.with_suffix(".png")
    if out is not None:
        try:
            files.append(draw_robot(robot, Path(out)))
        except RenderError as error:
            print(f"no picture: {error}", file=sys.stderr)
    return CommandResult(output_folder(), robot_table(robot), files=tuple(files))
