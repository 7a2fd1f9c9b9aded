"""Whether a motion is safe to play: soft limits, speeds, self-collision."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from functools import lru_cache

import mujoco
import numpy as np

from op3.robot.assets import asset_path
from op3.robot.joints import JOINTS, SOFT_LIMITS, indices
from op3.robot.motions import Motion
from op3.robot.poses import pose

SPEED_LIMIT = 4.0
"""Fastest commanded joint speed [rad/s]: below the XM430-W350's 43 rev/min without load at 11.1 V (4.5 rad/s)."""

CLEARANCE = 0.005
"""Least distance between two parts of the robot that are not neighbours [m]."""


def motion_faults(motion: Motion, mount: str | None = None) -> list[str]:
    """What is unsafe about a motion, one sentence each; empty where nothing is.

    Args:
        motion: of the whole robot; joints that it does not name are in the pose "stand".
        mount: where it is to be played, "floor" or "stand"; None: anywhere it is made for.
    """
    if mount is not None and mount not in motion.mounts:
        places = " or ".join(f"mount={place}" for place in motion.mounts)
        return [f"motion {motion.name!r} is not for the {mount}; choose {places}"]
    position = np.tile(pose("stand"), (len(motion.time), 1))
    position[:, indices(motion.joints)] = motion.position
    return [*_limit_faults(motion, position), *_speed_faults(motion, position), *_collisions(motion, position)]


def check_motion(motion: Motion, mount: str | None = None) -> None:
    """Refuse an unsafe motion.

    Raises:
        ValueError: with the first fault of `motion_faults`.
    """
    faults = motion_faults(motion, mount)
    if faults:
        raise ValueError(faults[0])


def _limit_faults(motion: Motion, position: np.ndarray) -> list[str]:
    low, high = np.array([SOFT_LIMITS[name] for name in JOINTS]).T
    faults = []
    for joint in np.flatnonzero(((position < low) | (position > high)).any(0)):
        row = int(np.argmax((position[:, joint] < low[joint]) | (position[:, joint] > high[joint])))
        faults.append(
            f"motion {motion.name!r} asks {JOINTS[joint]} for {position[row, joint]:.3f} rad at {motion.time[row]:.3f}"
            f" s; it may go from {low[joint]:.3f} to {high[joint]:.3f} rad"
        )
    return faults


def _speed_faults(motion: Motion, position: np.ndarray) -> list[str]:
    if len(position) < 2:
        return []
    speed = np.abs(np.diff(position, axis=0)) / np.diff(motion.time)[:, None]
    row, joint = np.unravel_index(np.argmax(speed), speed.shape)
    if speed[row, joint] <= SPEED_LIMIT:
        return []
    return [
        f"motion {motion.name!r} moves {JOINTS[joint]} at {speed[row, joint]:.2f} rad/s at {motion.time[row]:.3f} s;"
        f" the limit is {SPEED_LIMIT} rad/s"
    ]


def _collisions(motion: Motion, position: np.ndarray) -> list[str]:
    model = _colliding_model()
    data = mujoco.MjData(model)
    for row in range(len(position)):
        data.qpos[:] = position[row]
        mujoco.mj_fwdPosition(model, data)
        near = [contact for contact in data.contact if contact.dist < CLEARANCE]
        if near:
            parts = [model.geom(geom).name for geom in (near[0].geom1, near[0].geom2)]
            return [
                f"motion {motion.name!r} brings {parts[0]} within {near[0].dist * 1000:.1f} mm of {parts[1]} at"
                f" {motion.time[row]:.3f} s; at least {CLEARANCE * 1000:.0f} mm must be left"
            ]
    return []


@lru_cache(maxsize=1)
def _colliding_model() -> mujoco.MjModel:
    """The bare robot whose parts, but for neighbours, feel each other from `CLEARANCE` on."""
    # before compiling: MuJoCo sums up what each body may touch at that moment
    spec = mujoco.MjSpec.from_file(str(asset_path("op3/op3.xml")))
    for geom in spec.geoms:
        if geom.conaffinity:
            geom.contype = 1
            geom.margin = CLEARANCE
    return spec.compile()
