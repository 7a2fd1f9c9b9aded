"""Pictures of a robot's states, drawn in a process of their own.

OpenGL drivers print, hang on to a display, and abort the process where one is missing: MuJoCo's renderer ends it at the
second attempt without a screen. A run of hours is not to end with that.
"""

# Run as a script this file draws; so it imports nothing of this package.
# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

SIZE = (480, 480)
"""Height and width [pixel]."""

LONGEST = 300.0
"""After which a driver that has not drawn is given up [s]."""


class RenderError(RuntimeError):
    """Nothing can be drawn here; the message says why and what to do."""


def backends() -> tuple[str, ...]:
    """Values of ``MUJOCO_GL`` to try: the one that is set, else those that fit the machine."""
    chosen = os.environ.get("MUJOCO_GL", "")
    if chosen:
        return (chosen,)
    if sys.platform != "linux":
        return ("",)
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return ("glfw", "egl", "osmesa") if screen else ("egl", "osmesa")


def draw_frames(model: mujoco.MjModel, qpos: NDArray[np.float64], *, follow: bool = True) -> NDArray[np.uint8]:
    """Draw states.

    Args:
        model: compiled scene.
        qpos: ``[frame, nq]``, the first three numbers the trunk's place.
        follow: whether the camera goes with the trunk.

    Returns:
        ``[frame, height, width, 3]``.

    Raises:
        RenderError: if no driver draws.
    """
    with tempfile.TemporaryDirectory(prefix="op3-frames-") as folder:
        place = Path(folder)
        mujoco.mj_saveModel(model, str(place / "model.mjb"), None)
        np.save(place / "qpos.npy", np.asarray(qpos, dtype=np.float64))
        tried = backends()
        said = []
        for backend in tried:
            reason = _attempt(place, backend, follow)
            if reason is None:
                return np.load(place / "frames.npy")
            said.append(reason)
    raise RenderError(
        f"MuJoCo cannot render here with {' or '.join(name or 'its default' for name in tried)} ({said[0]});"
        " install an EGL driver (Debian: libegl1), or set MUJOCO_GL to what the machine has"
    )


def _attempt(place: Path, backend: str, follow: bool) -> str | None:
    """Why this backend could not draw; None if it has drawn."""
    # -P: the modules beside this file must not hide those of the standard library
    command = [sys.executable, "-P", str(Path(__file__).resolve()), str(place), "follow" if follow else "stay"]
    environment = {**os.environ, **({"MUJOCO_GL": backend} if backend else {})}
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, check=False, timeout=LONGEST, errors="replace"
        )
    except subprocess.TimeoutExpired:
        return f"it did not end within {LONGEST:g} s"
    if done.returncode == 0:
        return None
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    return lines[-1][:100] if lines else f"exit code {done.returncode}"


def _draw(place: Path, follow: bool) -> None:
    """Draw what `draw_frames` has written into a folder."""
    model = mujoco.MjModel.from_binary_path(str(place / "model.mjb"))
    qpos, data = np.load(place / "qpos.npy"), mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.distance, camera.azimuth, camera.elevation = 1.1, 140.0, -12.0
    # shadows and MuJoCo's multisampling take a processor ten times as long as all the rest
    model.vis.quality.offsamples = 0
    frames = np.empty((len(qpos), *SIZE, 3), np.uint8)
    with mujoco.Renderer(model, *SIZE) as renderer:
        for number, state in enumerate(qpos):
            data.qpos[:] = state
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            camera.lookat[:] = (*(state if follow else qpos[0])[:2], qpos[0, 2])
            renderer.update_scene(data, camera=camera)
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
            renderer.render(out=frames[number])
    np.save(place / "frames.npy", frames)


if __name__ == "__main__":
    _draw(Path(sys.argv[1]), sys.argv[2] == "follow")
