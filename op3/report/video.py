"""Short videos of a robot, simulated or from a log."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from PIL import Image

from op3.common.writing import write_file
from op3.report.frames import RenderError, draw_frames
from op3.rollout import Rollout
from op3.scenes import Scene


def film(
    scene: Scene,
    qpos: np.ndarray,
    path: str | Path,
    rate: float,
    say: Callable[[str], None] = print,
    follow: bool = True,
) -> Path | None:
    """Draw states ``[frame, nq]`` at a rate [Hz] and write them, see `write_film`; None if MuJoCo cannot render.

    Args:
        scene: scene with the robot, which is recompiled because simulations omit purely visual elements.
        qpos: states, whose first three numbers are the position of the trunk.
        rate: frames per second [Hz].
        say: function that receives the reason if rendering is not possible.
        follow: whether the camera follows the trunk.
    """
    try:
        return write_film(draw_frames(scene.compile(), qpos, follow=follow), path, rate)
    except RenderError as error:
        say(f"no video: {error}")
        return None


def write_film(pictures: Iterable[np.ndarray], path: str | Path, rate: float, quality: int = 40) -> Path:
    """Write pictures ``[height, width, 3]`` of even size to a file, atomically.

    Args:
        path: ``.mp4`` (H.264), or ``.webp``, which documents display like an image.
        rate: pictures per second [Hz].
        quality: quality of WebP, 0 to 100.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".webp":
        first, *others = map(Image.fromarray, pictures)
        options = {"append_images": others, "duration": round(1000 / rate), "loop": 0, "quality": quality, "method": 4}
        write_file(path, lambda unfinished: first.save(unfinished, "WEBP", save_all=True, **options))
    else:
        per_second = Fraction(rate).limit_denominator(1000)
        write_file(path, lambda unfinished: _write_mp4(pictures, unfinished, per_second))
    return path


def _write_mp4(pictures: Iterable[np.ndarray], path: Path, rate: Fraction) -> None:
    try:
        import av  # imported here because it takes half a second
    except ImportError:
        raise RenderError("an mp4 needs the package av: pip install 'op3[video]', or write a .webp") from None

    stream: Any = None
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        for picture in pictures:
            if stream is None:
                stream = container.add_stream("libx264", rate=rate, options={"crf": "23", "preset": "fast"})
                stream.height, stream.width, stream.pix_fmt = *picture.shape[:2], "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        if stream is not None:
            container.mux(stream.encode(None))


TILTED = np.radians(12.0)
"""Largest tilt of a board in any task [rad]."""


def states_of_log(log: Rollout, scene: Scene, rate: float) -> np.ndarray:
    """A robot's states from its encoders and IMU, for `film`.

    A log does not contain the position of a standing robot. The robot is placed so that the centre of its soles does
    not move, and a board is placed parallel to the soles. This is for viewing, not for measurement.

    Args:
        log: log of one episode on the robot; missing joints are drawn in the home pose.
        rate: frames per second [Hz].

    Returns:
        [frame, nq].
    """
    time = log.array("time")[:, 0] - log.array("time")[0, 0]
    rows = np.searchsorted(time, np.arange(int(log.duration * rate) + 1) / rate - 1e-6)
    names = [name.rsplit("/", 1)[-1] for name in scene.joint_names]
    home = scene.robot_file.home
    joints = np.stack([
        log.array("joint/position")[rows, log.joints.index(name)] if name in log.joints
        else np.full(len(rows), home[scene.robot_file.joints.index(name)])
        for name in names
    ], axis=1)  # fmt: skip
    if not scene.floating:
        return joints
    model, orientation = scene.compile(visual=False), log.array("imu/orientation")[rows]
    data = mujoco.MjData(model)
    assert scene.robot is not None
    soles = [model.site(site.full_identifier).id for site in scene.robot.key_points]
    feet = sorted({int(model.site_bodyid[i]) for i in soles})
    states = np.repeat(scene.initial_qpos(joints[0])[None], len(rows), 0)
    board = states.shape[1] - 7 - len(names)
    centre: np.ndarray | None = None
    for state, angles, (roll, pitch, yaw) in zip(states, joints, orientation, strict=True):
        state[3:7] = _turned(roll, pitch, yaw - orientation[0, 2])
        state[7 : 7 + len(names)] = angles
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        middle = data.site_xpos[soles].mean(0) if soles else data.xpos[1]
        centre = middle if centre is None else centre
        state[:3] += centre - middle
        if board:
            normal = np.mean([data.xmat[foot].reshape(3, 3)[:, 2] for foot in feet], 0)
            state[-2:] = np.clip((np.arctan2(normal[0], normal[2]), np.arctan2(-normal[1], normal[2])), -TILTED, TILTED)
    return states


def _turned(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """The quaternion of Rz(yaw) Ry(pitch) Rx(roll)."""
    quaternion = np.empty(4)
    mujoco.mju_euler2Quat(quaternion, np.array([yaw, pitch, roll]), "zyx")
    return quaternion
