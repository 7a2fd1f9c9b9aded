"""Describes a robot: a table of joints, the used parts of its model, and a picture."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from op3.common.writing import write_file
from op3.report.frames import draw_frames
from op3.robot.robot import Robot
from op3.scenes.scene import build_scene


def robot_table(robot: Robot) -> str:
    """Joints with servo, bus id, limits and home, joints without a servo, and how parts of the model are used."""
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
    """A PNG of the robot in its home pose on the stand; raises `RenderError` if rendering is not possible.

    Raises:
        ValueError: if the path does not end in .png.
    """
    if path.suffix != ".png":
        raise ValueError(f"out={path}: give a name that ends in .png")
    scene = build_scene("stand", robot=robot)
    picture = draw_frames(scene.compile(), scene.initial_qpos(robot.home)[None])[0]
    write_file(path, lambda unfinished: Image.fromarray(picture).save(unfinished, "PNG"))
    return path
