"""Dynamics of a robot with a fixed base along a trajectory: mass matrix, bias, and derivatives of the bias.

Computed by MuJoCo once per tick of a measured motion; `op3.sim.WindowSimulation` then simulates around that motion
without MuJoCo in the loop.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from op3.sim.ports import ServoPorts

GRADIENT_STEP = 1e-4
"""Half width of the central differences of the bias [rad]."""


@dataclass(frozen=True, eq=False)
class TrajectoryDynamics:
    """Rigid-body dynamics at the ticks of a trajectory, ``M a + h = torque``, without armature and friction.

    Attributes:
        mass: mass matrix of the joints [kg m^2], ``[tick, joint, joint]``.
        bias: gravity, velocity products and passive torques h [N m], ``[tick, joint]``.
        gradient: derivative of the bias with respect to the joint angles [N m/rad], ``[tick, joint, joint]``.
        damping: derivative of the bias with respect to the joint velocities [N m s/rad], ``[tick, joint, joint]``.
        radial_force: force across the output shafts at zero acceleration [N], ``[tick, joint]``.
        carried: torque per angular acceleration of the body that carries the limbs, in that body's frame [kg m^2],
            ``[tick, joint, 3]``.
    """

    mass: np.ndarray
    bias: np.ndarray
    gradient: np.ndarray
    damping: np.ndarray
    radial_force: np.ndarray
    carried: np.ndarray


def trajectory_dynamics(
    model: mujoco.MjModel,
    joints: Sequence[str],
    position: np.ndarray,
    velocity: np.ndarray,
    qpos: np.ndarray,
    *,
    base: int = 0,
    radial_force: bool = False,
    derivatives: bool = True,
) -> TrajectoryDynamics:
    """Dynamics of some joints of a fixed-base scene while the others are held.

    Args:
        model: compiled scene with servos attached and a fixed base.
        joints: full names of the joints that move, in the order of the columns.
        position: joint angles [rad], ``[tick, joint]``.
        velocity: joint velocities [rad/s], ``[tick, joint]``.
        qpos: full position in which the other joints are held, ``[nq]``.
        base: number of the body that carries the limbs.
        radial_force: whether to compute the radial force, which needs a further pass.
        derivatives: whether to compute gradient and damping; zero otherwise.

    Raises:
        ValueError: if the base of the scene is free.
    """
    if model.nq != model.njnt:
        raise ValueError("the scene has a joint that is not a hinge: dynamics along a trajectory need a fixed base")
    ports = ServoPorts.find(model, joints)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    ticks, count = position.shape
    dof, address = ports.dof, ports.qpos
    full_mass, bias = np.zeros((model.nv, model.nv)), np.zeros(model.nv)
    rows = dof[:, None]
    armature = np.diag(model.dof_armature[dof])
    result = TrajectoryDynamics(
        mass=np.zeros((ticks, count, count)),
        bias=np.zeros((ticks, count)),
        gradient=np.zeros((ticks, count, count)),
        damping=np.zeros((ticks, count, count)),
        radial_force=np.zeros((ticks, count)),
        carried=np.zeros((ticks, count, 3)),
    )
    axes, inertia, arm, turned = (np.zeros((ticks, *shape)) for shape in ((count, 6), (count, 10), (3,), (9,)))
    bodies, root = model.dof_bodyid[dof], model.body_rootid[base]

    def torque() -> np.ndarray:
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_passive(model, data)
        mujoco.mj_rne(model, data, 0, bias)
        return bias[dof] - data.qfrc_passive[dof]

    for tick in range(ticks):
        data.qpos[address] = position[tick]
        data.qvel[dof] = velocity[tick]
        result.bias[tick] = torque()
        mujoco.mj_crb(model, data)
        mujoco.mj_fullM(model, data, full_mass)
        result.mass[tick] = full_mass[rows, dof] - armature
        axes[tick], inertia[tick], turned[tick] = data.cdof[dof], data.crb[bodies], data.xmat[base]
        arm[tick] = data.subtree_com[root] - data.xpos[base]
        if radial_force:
            mujoco.mj_forward(model, data)
            data.qacc[:] = 0.0
            mujoco.mj_rnePostConstraint(model, data)
            mujoco.mj_sensorAcc(model, data)
            result.radial_force[tick] = np.hypot(data.sensordata[ports.force], data.sensordata[ports.force + 1])
        if not derivatives:
            continue
        for j in range(count):
            data.qpos[address[j]] = position[tick, j] + GRADIENT_STEP
            ahead = torque()
            data.qpos[address[j]] = position[tick, j] - GRADIENT_STEP
            result.gradient[tick, :, j] = (ahead - torque()) / (2 * GRADIENT_STEP)
            data.qpos[address[j]] = position[tick, j]
        # velocity products are quadratic in velocity: differences of any width are exact
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for j in range(count):
            data.qvel[dof[j]] = velocity[tick, j] + 1.0
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 0, bias)
            ahead = bias[dof].copy()
            data.qvel[dof[j]] = velocity[tick, j] - 1.0
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 0, bias)
            result.damping[tick, :, j] = (ahead - bias[dof]) / 2.0
            data.qvel[dof[j]] = velocity[tick, j]
    result.carried[:] = _carried(axes, inertia, arm) @ turned.reshape(ticks, 3, 3)
    return result


def _carried(axes: np.ndarray, inertia: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """Torque of joints per angular acceleration of their base in the world's axes, ``[tick, joint, 3]``.

    The bodies after a joint form one body of composite inertia (Featherstone 2008, chapter 6), accelerated with the
    base.

    Args:
        axes: axes of the joints, as spatial vectors about one point, ``[tick, joint, 6]``.
        inertia: composite inertia about the same point in MuJoCo's format, ``[tick, joint, 10]``.
        arm: vector from the base's frame to that point [m], ``[tick, 3]``.
    """
    xx, yy, zz, xy, xz, yz, x, y, z, mass = np.moveaxis(inertia, -1, 0)
    whole = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).reshape(*mass.shape, 3, 3)
    first = np.stack([x, y, z], -1)[..., None, :]
    unit = np.eye(3)  # the accelerations, in turn along the last axis but one
    moving = np.cross(unit, arm[:, None, None])
    torque = whole + np.cross(first, moving)
    force = mass[..., None, None] * moving - np.cross(first, unit)
    return np.einsum("tjka,tja->tjk", np.concatenate([torque, force], -1), axes)
