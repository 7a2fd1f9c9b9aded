"""Recordings for rerun: robots in 3D and plots of all joints on one timeline; needs the extra ``view``."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from op3.report.tracks import Tracks
from op3.report.viewer import RATE, lines_of, overlay_colours


def record(tracks: Tracks, path: Path | None) -> Path | None:
    """Write a recording, or open it in rerun if the path is None.

    Raises:
        ValueError: if rerun is not installed.
    """
    try:
        import rerun as rr
    except ImportError:
        raise ValueError("rerun is not installed: pip install 'op3[view]'") from None
    stream = rr.RecordingStream("op3")
    if path is None:
        stream.spawn()
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream.save(path)
    model, states = tracks.scene.compile(), tracks.states(RATE)
    colours = [None, *overlay_colours(tracks)]
    for label, colour, robot in zip(tracks.logs, colours, states, strict=True):
        _robot(rr, stream, model, f"robots/{label}", colour, robot)
    for joint in next(iter(tracks.logs.values())).joints:
        for axis, lines in lines_of(tracks, joint).items():
            for label, seconds, values in lines:
                times = rr.TimeColumn("time", duration=seconds)
                columns = rr.Scalars.columns(scalars=np.nan_to_num(values))
                stream.send_columns(f"plots/{joint}/{axis.split(' [')[0]}/{label}", indexes=[times], columns=columns)
    stream.flush()
    return path


def _robot(rr: Any, stream: Any, model: mujoco.MjModel, name: str, colour: Any, states: np.ndarray) -> None:
    """Log the motion of bodies over time, and their shapes once."""
    data = mujoco.MjData(model)
    places = np.empty((len(states), model.nbody, 3))
    turns = np.empty((len(states), model.nbody, 4))
    for row, state in enumerate(states):
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        places[row], turns[row] = data.xpos, np.roll(data.xquat, -1, axis=1)  # rerun's quaternions end with w
    own = model.body_rootid[model.jnt_bodyid[0]]
    times = rr.TimeColumn("time", duration=np.arange(len(states)) / RATE)
    for body in np.flatnonzero(model.body_rootid == own):
        where = rr.Transform3D.columns(translation=places[:, body], quaternion=turns[:, body])
        stream.send_columns(f"{name}/{body}", indexes=[times], columns=where)
    for geom in range(model.ngeom):
        body, rgba = model.geom_bodyid[geom], model.geom_rgba[geom]
        if model.body_rootid[body] != own or not rgba[3]:
            continue
        at = f"{name}/{body}/{geom}"
        look = [int(255 * part) for part in (*(colour or rgba[:3]), 0.45 if colour else 1.0)]
        turn = rr.Quaternion(xyzw=np.roll(model.geom_quat[geom], -1))
        stream.log(at, rr.Transform3D(translation=model.geom_pos[geom], quaternion=turn), static=True)
        stream.log(at, _shape(rr, model, geom, look), static=True)


def _shape(rr: Any, model: mujoco.MjModel, geom: int, look: list[int]) -> Any:
    """A geom in rerun's format."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first, faces = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        return rr.Mesh3D(
            vertex_positions=model.mesh_vert[first : first + model.mesh_vertnum[mesh]],
            triangle_indices=model.mesh_face[faces : faces + model.mesh_facenum[mesh]],
            albedo_factor=look,
        )
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return rr.Boxes3D(half_sizes=[size], colors=[look], fill_mode="solid")
    if kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
        round_ends = kind == mujoco.mjtGeom.mjGEOM_CAPSULE
        shape = rr.Capsules3D if round_ends else rr.Cylinders3D
        middle = {"translations": [[0, 0, -size[1]]]} if round_ends else {}
        return shape(lengths=[2 * size[1]], radii=[size[0]], colors=[look], **middle)
    radii = [size[0]] * 3 if kind == mujoco.mjtGeom.mjGEOM_SPHERE else size
    return rr.Ellipsoids3D(half_sizes=[radii], colors=[look], fill_mode="solid")
