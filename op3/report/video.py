"""Short films of a simulated robot, as animated PNG beside the page."""

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from op3.report.picture import animated_png

SIZE = (240, 240)
"""Height and width [pixel]."""


def film(
    model: mujoco.MjModel,
    qpos: np.ndarray,
    path: str | Path,
    rate: float,
    say: Callable[[str], None] = print,
) -> Path | None:
    """Draw states and write them as ``.png`` that browsers play; None where MuJoCo cannot render here.

    Args:
        model: compiled scene.
        qpos: [frame, nq]; the camera follows the first three numbers, the trunk's place.
        path: of the file to write.
        rate: frames per second [Hz].
        say: takes the reason where nothing can be drawn.
    """
    path, data = Path(path), mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.distance, camera.azimuth, camera.elevation = 1.1, 140.0, -12.0
    frames = []
    try:
        with mujoco.Renderer(model, *SIZE) as renderer:
            for state in qpos:
                data.qpos[:] = state
                mujoco.mj_kinematics(model, data)
                mujoco.mj_camlight(model, data)
                camera.lookat[:] = (state[0], state[1], qpos[0, 2])
                renderer.update_scene(data, camera=camera)
                renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
                frames.append(renderer.render())
    except Exception as error:  # OpenGL reports a missing display or driver in many ways, none of them shared
        say(f"no video: MuJoCo cannot render here ({' '.join(str(error).split())[:80]}); try MUJOCO_GL=egl")
        return None
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(animated_png(frames, rate))
    return path
