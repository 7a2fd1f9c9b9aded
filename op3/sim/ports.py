"""Ports of servos in a MuJoCo model: actuators and sensors added to hinges, and their addresses."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

# Friction as a constraint creeps and can push along the motion with MuJoCo's defaults; a stiff, nearly hard
# constraint does neither at 1 ms (tests/sim/test_servo_physics.py measures both).
SOLREF_FRICTION = (0.002, 1.0)
SOLIMP_FRICTION = (0.99, 0.99, 0.001)


def attach_servos(joints: Sequence[Any]) -> None:
    """Give every hinge a motor, and sensors of the moment and the force it transmits to its child link.

    Adds to each joint a motor actuator ``<joint>_servo`` (its control is the torque [N m]), and to the child
    body a site whose z axis is the joint axis with a torque sensor ``<joint>_transmitted`` and a force sensor
    ``<joint>_force``; sets the solver parameters of the joint's friction. Attach before compiling, once.

    Raises:
        ValueError: if a joint is not a hinge.
    """
    sites = []
    for joint in joints:
        kind = joint.type or "hinge"
        if kind != "hinge":
            raise ValueError(f"a servo attaches to a hinge, but joint {joint.name!r} is of type {kind!r}")
        axis = (0.0, 0.0, 1.0) if joint.axis is None else joint.axis
        joint.solreffriction = SOLREF_FRICTION
        joint.solimpfriction = SOLIMP_FRICTION
        # set explicitly, because a default class of the scene could override it
        joint.root.actuator.add(
            "motor", name=f"{joint.name}_servo", joint=joint, gear=[1.0], ctrllimited=False, forcelimited=False
        )
        position = (0.0, 0.0, 0.0) if joint.pos is None else joint.pos
        site = joint.parent.add("site", name=f"{joint.name}_output", pos=position, zaxis=axis, group=4)
        sites.append(site)
        joint.root.sensor.add("torque", name=f"{joint.name}_transmitted", site=site)
    # after all torque sensors, which must stay one block
    for joint, site in zip(joints, sites, strict=True):
        joint.root.sensor.add("force", name=f"{joint.name}_force", site=site)


@dataclass(frozen=True)
class ServoPorts:
    """Addresses of servos in a compiled model, in the order of the joints.

    Attributes:
        joints: full names of the joints.
        qpos: positions in ``qpos``.
        dof: positions in ``qvel`` and in the dof fields of the model.
        ctrl: positions in ``ctrl``.
        transmitted: positions in ``sensordata`` of the moment about the joint axis that the servo's output transmits to
            the child link: motor torque plus the joint's own friction minus armature times acceleration.
        force: positions in ``sensordata`` of the first component across the axis of the force on the child link; the
            second follows it.
        body: ids of the bodies that the joints move.
    """

    joints: tuple[str, ...]
    qpos: np.ndarray
    dof: np.ndarray
    ctrl: np.ndarray
    transmitted: np.ndarray
    force: np.ndarray
    body: np.ndarray

    @property
    def table(self) -> np.ndarray:
        """Addresses by joint: qpos, dof, ctrl, transmitted and force, ``[5, joint]``."""
        return np.array([self.qpos, self.dof, self.ctrl, self.transmitted, self.force], np.int64)

    @classmethod
    def find(cls, model: mujoco.MjModel, joints: Sequence[str]) -> "ServoPorts":
        """Look up joints with servos attached, by their full names.

        Raises:
            ValueError: if a joint or its servo is missing, or a joint is not a hinge about its sensor's axis.
        """
        ids = [_id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in joints]
        for joint, name in zip(ids, joints, strict=True):
            _check_hinge(model, joint, name)
        actuators = [_id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, f"{name}_servo") for name in joints]
        sensors = [_id(model, mujoco.mjtObj.mjOBJ_SENSOR, f"{name}_transmitted") for name in joints]
        forces = [_id(model, mujoco.mjtObj.mjOBJ_SENSOR, f"{name}_force") for name in joints]
        return cls(
            joints=tuple(joints),
            qpos=model.jnt_qposadr[ids],
            dof=model.jnt_dofadr[ids],
            ctrl=np.array(actuators),
            transmitted=model.sensor_adr[sensors] + 2,
            force=model.sensor_adr[forces],
            body=model.jnt_bodyid[ids],
        )


def _id(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    found = mujoco.mj_name2id(model, kind, name)
    if found < 0:
        what = kind.name.removeprefix("mjOBJ_").lower()
        raise ValueError(f"the model has no {what} {name!r}; attach servos before compiling")
    return found


def _check_hinge(model: mujoco.MjModel, joint: int, name: str) -> None:
    """Check the compiled joint, because a default class may change the properties of its element."""
    if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
        raise ValueError(f"a servo attaches to a hinge, but the compiled joint {name!r} is not one")
    site = model.site(f"{name}_output")
    along = np.zeros(3)
    mujoco.mju_rotVecQuat(along, np.array([0.0, 0.0, 1.0]), site.quat)
    if along @ model.jnt_axis[joint] < 1 - 1e-6:
        raise ValueError(
            f"joint {name!r} turns about {model.jnt_axis[joint]}, but its servo's sensor looks along {along}; write the"
            " joint's axis on the joint itself instead of in a default class"
        )
