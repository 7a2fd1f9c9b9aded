"""Short films of a robot, simulated or as its log tells, as animated WebP."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from op3.report.frames import RenderError, draw_frames
from op3.robot import Scene
from op3.rollout import Rollout


def film(
    scene: Scene,
    qpos: np.ndarray,
    path: str | Path,
    rate: float,
    say: Callable[[str], None] = print,
    follow: bool = True,
) -> Path | None:
    """Draw states and write them as ``.webp`` that browsers play; None where MuJoCo cannot render here.

    Args:
        scene: in which the robot is; it is compiled anew, because simulations leave out what only pictures show.
        qpos: [frame, nq], the first three numbers the trunk's place.
        path: of the file to write.
        rate: frames per second [Hz].
        say: takes the reason where nothing can be drawn.
        follow: whether the camera goes with the trunk; one that stands still makes a far smaller file.
    """
    path = Path(path)
    try:
        frames = draw_frames(scene.compile(), qpos, follow=follow)
    except RenderError as error:
        say(f"no video: {error}")
        return None
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".part")
    first, *others = map(Image.fromarray, frames)
    options = {
        "save_all": True,
        "append_images": others,
        "duration": round(1000 / rate),
        "loop": 0,
        "quality": 40,
        "method": 4,
    }
    first.save(unfinished, "WEBP", **options)
    unfinished.replace(path)  # a film that exists is whole
    return path


TILTED = np.radians(12.0)
"""No board of a task tilts further [rad]."""


def states_of_log(log: Rollout, scene: Scene, rate: float) -> np.ndarray:
    """A robot's states as its encoders and IMU tell them, for `film`.

    A log does not know where the robot is: it is put such that the middle of its soles stays where it began, and a
    board lies under them as they do. Good for looking at, not for measuring.

    Args:
        log: of one episode on the robot, all joints.
        scene: that it happened on; "floor" or a board.
        rate: frames per second [Hz].

    Returns:
        [frame, nq].
    """
    model = scene.compile()
    data = mujoco.MjData(model)
    order = [log.joints.index(name.rsplit("/", 1)[-1]) for name in scene.joint_names]
    soles = [i for i in range(model.nsite) if "sole" in model.site(i).name]
    feet = sorted({int(model.site_bodyid[i]) for i in soles})
    rows = np.arange(0, log.rows, max(1, round(log.metadata.rate / rate)))
    joints, orientation = log.array("joint/position")[rows][:, order], log.array("imu/orientation")[rows]
    states = np.repeat(scene.initial_qpos(joints[0])[None], len(rows), 0)
    board = states.shape[1] - 7 - len(order)
    centre: np.ndarray | None = None
    for state, angles, (roll, pitch, yaw) in zip(states, joints, orientation, strict=True):
        state[3:7] = _turned(roll, pitch, yaw - orientation[0, 2])
        state[7 : 7 + len(order)] = angles
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        middle = data.site_xpos[soles].mean(0)
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
