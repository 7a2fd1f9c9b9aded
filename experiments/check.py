"""Look at a robot file: its joints, what of its model acts, and a picture of it at home.

python experiments/check.py robot=<robot.yaml> [out=<picture>.png]

As a command: op3 check <robot.yaml>. Exit code 1 where the file cannot be right.
"""

from pathlib import Path

import hydra
from omegaconf import DictConfig
from support import check_given, one_sentence

from op3.command_line import launch
from op3.report.frames import RenderError
from op3.report.robot_table import draw_robot, robot_table
from op3.robot import load_robot
from op3.robot.robot import robot_files


@hydra.main(config_path="../conf/check", config_name="check", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Print the table of a robot, and draw it."""
    with one_sentence():
        check_given(cfg, "robot", "a robot file")
        robot = load_robot(cfg.robot)
        print(robot_table(robot))
        out = cfg.out if robot.path in robot_files().values() else cfg.out or robot.path.with_suffix(".png")
        if out is not None:
            try:
                print(f"drawn at home: {draw_robot(robot, Path(out))}")
            except RenderError as error:
                print(f"no picture: {error}")


if __name__ == "__main__":
    launch(main, "check", __doc__)
