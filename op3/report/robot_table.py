"""A robot by its file and its model: a table of joints, the used parts of the model, and a picture."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from op3.common.writing import write_file
from op3.report.frames import draw_frames
from op3.robot.robot import Robot
from op3.scenes.scene import build_scene


def robot_table(robot: Robot) -> str:
    """Joints with servo, bus id, limits and home, joints without a servo, and what became of parts of the model."""
    rows = [("joint", "servo", "bus id", "limits [rad]", "home [rad]")]
    for name, make, (low, high), home in zip(robot.joints, robot.servos, robot.limits, robot.home, strict=True):
        rows.append((name, make.name, str(robot.bus_ids[name]), f"{low:.2f} to {high:.2f}", f"{home:.2f}"))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [f"{robot.name}: {len(robot.joints)} joints with a servo, model {robot.model_path.name}"]
    lines += ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    for name, (driver, ratio, offset) in robot.followed.items():
        lines.append(f"{name}: held at {offset:g}" if driver is None else f"{name} = {offset:g} + {ratio:g} {driver}")
    return "\n".join([*lines, *map(str, robot.model_parts)])


def draw_robot(robot: Robot, path: Path) -> Path:
    """A picture of the robot at home on the stand, as PNG; a `RenderError` where nothing can draw.

    Raises:
        ValueError: if the path is not that of a PNG.
    """
    if path.suffix != ".png":
        raise ValueError(f"out={path}: give a name that ends in .png")
    scene = build_scene("stand", robot=robot)
    picture = draw_frames(scene.compile(), scene.initial_qpos(robot.home)[None])[0]
    write_file(path, lambda unfinished: Image.fromarray(picture).save(unfinished, "PNG"))
    return path
