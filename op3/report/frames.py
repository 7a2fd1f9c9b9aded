"""Pictures of a robot's states, drawn in a separate process.

OpenGL drivers print messages, need a display, and abort the process without one: without a screen, MuJoCo's renderer
ends the process at the second attempt. This must not end a run of several hours.
"""

# This file is also the script that draws, so it imports nothing from this package.
# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

SIZE = (540, 540)
"""Height and width [pixel]."""

BEHIND = 0.004
"""Offset of a simulated overlay to the back [m]."""

Colour = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""

LONGEST = 300.0
"""Time in which a driver must render a frame [s]."""


class RenderError(RuntimeError):
    """Rendering is not possible on this machine; the message states the reason and the remedy."""


def backends() -> tuple[str, ...]:
    """Values of ``MUJOCO_GL`` to try: the environment's value, otherwise all that suit the machine."""
    chosen = os.environ.get("MUJOCO_GL", "")
    if chosen:
        return (chosen,)
    if sys.platform != "linux":
        return ("",)
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return ("glfw", "egl", "osmesa") if screen else ("egl", "osmesa")


def draw_frames(
    model: mujoco.MjModel,
    qpos: NDArray[np.float64],
    *,
    follow: bool = True,
    size: tuple[int, int] = SIZE,
    overlays: Sequence[Colour] = (),
) -> NDArray[np.uint8]:
    """Draw states of a compiled scene, as pictures ``[frame, height, width, 3]``.

    Args:
        qpos: ``[frame, nq]``; with overlays ``[robot, frame, nq]``, where the first robot is solid.
        follow: whether the camera follows the trunk of a free robot.
        size: height and width [pixel].
        overlays: colour of each robot after the first.

    Raises:
        RenderError: if no driver can render.
    """
    if not shapes(model):
        raise RenderError("no link of the robot has a visible shape; add geoms or meshes to its model")
    robots, said = np.asarray(qpos, dtype=np.float64), []
    with tempfile.TemporaryDirectory(prefix="op3-frames-") as folder:
        place = Path(folder)
        mujoco.mj_saveModel(model, str(place / "model.mjb"), None)
        np.savez(place / "asked.npz", qpos=robots if robots.ndim == 3 else robots[None], follow=follow, size=size,
                 overlays=np.reshape(overlays, (-1, 3)))  # fmt: skip
        for backend in backends():
            reason = _attempt(place, backend)
            if reason is None:
                return np.load(place / "frames.npy")
            said.append(reason)
    raise RenderError(
        f"MuJoCo cannot render here with {' or '.join(name or 'its default' for name in backends())} ({said[0]});"
        " install EGL (Debian: libegl1, libgl1), or set MUJOCO_GL to an available backend"
    )


def _attempt(place: Path, backend: str) -> str | None:
    """The reason why this backend could not render; None on success."""
    # -P: the modules beside this file must not hide those of the standard library
    command = [sys.executable, "-P", str(Path(__file__).resolve()), str(place)]
    environment = {**os.environ, **({"MUJOCO_GL": backend} if backend else {})}
    try:
        done = subprocess.run(command, env=environment, capture_output=True, timeout=LONGEST, errors="replace")
    except subprocess.TimeoutExpired:
        return f"it did not finish within {LONGEST:g} s"
    if done.returncode == 0:
        return None
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    return lines[-1][:100] if lines else f"exit code {done.returncode}"


def shapes(model: mujoco.MjModel) -> list[int]:
    """Geoms of the robot that has the first joint."""
    own = model.body_rootid[model.jnt_bodyid[0]]
    return [i for i in range(model.ngeom) if model.body_rootid[model.geom_bodyid[i]] == own]


def camera_of(model: mujoco.MjModel, data: mujoco.MjData) -> mujoco.MjvCamera:
    """A camera with all moving bodies in view, for the current state."""
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation = 140.0, -12.0
    geoms = shapes(model)
    places, reach = data.geom_xpos[geoms], model.geom_rbound[geoms, None]
    low, high = (places - reach).min(0), (places + reach).max(0)
    camera.lookat[:] = (low + high) / 2
    camera.distance = 1.35 * float(np.linalg.norm(high - low))
    return camera


def add_overlay(model: mujoco.MjModel, data: mujoco.MjData, scene: mujoco.MjvScene, colour: Colour) -> None:
    """Add translucent copies of the moving geoms to a scene in this colour, slightly behind the originals.

    An overlay is therefore only visible where it differs from the solid robot.
    """
    first, camera = scene.ngeom, scene.camera[0]
    everything = (mujoco.MjvOption(), mujoco.MjvPerturb(), mujoco.mjtCatBit.mjCAT_DYNAMIC)
    mujoco.mjv_addGeoms(model, data, *everything, scene)
    for geom in scene.geoms[first : scene.ngeom]:
        geom.rgba[:] = (*colour, 0.45 * (geom.rgba[3] > 0))
        geom.matid, geom.transparent = -1, 1
        geom.pos[:] += BEHIND * np.asarray(camera.forward)


def _draw(place: Path) -> None:
    """Draw the frames that `draw_frames` has described in a folder."""
    model, asked = mujoco.MjModel.from_binary_path(str(place / "model.mjb")), np.load(place / "asked.npz")
    solid, *others = asked["qpos"]
    data, overlay = mujoco.MjData(model), mujoco.MjData(model)
    data.qpos[:] = solid[0]
    mujoco.mj_kinematics(model, data)
    camera = camera_of(model, data)
    begin = np.array(camera.lookat)
    free = bool(asked["follow"]) and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    # on a processor, shadows and multisampling take ten times as long as everything else
    model.vis.quality.offsamples = 0
    frames = np.empty((len(solid), *asked["size"], 3), np.uint8)
    with mujoco.Renderer(model, *map(int, asked["size"])) as renderer:
        for number, state in enumerate(solid):
            data.qpos[:] = state
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            if free:
                camera.lookat[:2] = begin[:2] + state[:2] - solid[0, :2]
            renderer.update_scene(data, camera=camera)
            for colour, states in zip(asked["overlays"], others, strict=True):
                overlay.qpos[:] = states[number]
                mujoco.mj_kinematics(model, overlay)
                add_overlay(model, overlay, renderer.scene, colour)
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
            renderer.render(out=frames[number])
    np.save(place / "frames.npy", frames)


if __name__ == "__main__":
    _draw(Path(sys.argv[1]))
