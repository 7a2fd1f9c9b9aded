"""Draw the OP3 in three poses, side by side, as one PNG.

MUJOCO_GL=egl python experiments/render.py [--out docs/images/op3.png] [--poses stand squat_high squat_low]
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from op3.robot import build_scene, pose

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "op3.png"
PANEL = (400, 460)
"""Width and height of one pose [pixel]."""


def draw(name: str) -> np.ndarray:
    """One pose on the floor, uint8 ``[height, width, 3]``; the camera stands still, so heights compare."""
    scene = build_scene("floor")
    model = scene.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = scene.initial_qpos(pose(name))
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (0.02, 0.0, 0.22)
    camera.distance, camera.azimuth, camera.elevation = 0.95, 140.0, -10.0
    with mujoco.Renderer(model, PANEL[1], PANEL[0]) as renderer:
        renderer.update_scene(data, camera=camera)
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        return renderer.render()


def main() -> None:
    """Draw the poses and write the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=PICTURE, help="the PNG to write")
    parser.add_argument("--poses", nargs="+", default=["stand", "squat_high", "squat_low"])
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate([draw(name) for name in options.poses], axis=1)).save(options.out, optimize=True)
    print(options.out)


if __name__ == "__main__":
    main()
