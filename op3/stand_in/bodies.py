"""The rigid bodies moved by the servos: Pinocchio simulates limbs on a fixed base, MuJoCo robots on the floor.

Both start from a compiled MuJoCo model; Pinocchio's model uses only its masses, frames and axes.
"""

# MuJoCo's and Pinocchio's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from op3.robot.kinematics import rotation_matrix
from op3.stand_in.hidden import Hidden
from op3.stand_in.hidden_servos import HiddenServos
from op3.stand_in.integration import TICK, step_limbs, step_servos

try:
    import pinocchio
except ImportError:
    raise ValueError("stand-ins and emulated robots need the package pin: pip install 'op3[stand-in]'") from None

Array = NDArray[np.float64]


class Limbs:
    """All moving bodies on a fixed base, simulated by Pinocchio.

    Once per tick, Pinocchio (Carpentier et al. 2019) computes the inverse joint-space inertia and the bias torques for
    the predicted state in the middle of the tick; in between, the compiled servos take their finer steps. This is
    accurate to second order in the tick.

    Args:
        model: compiled model with a base fixed to the world.
        servos: servos of the joints.
        joints: names of the joints in the model [joint].
        mount: natural frequency [Hz] and damping ratio of the elastic stand; frequency 0: stiff.
    """

    def __init__(self, model: mujoco.MjModel, servos: HiddenServos, joints: Sequence[str], mount: tuple[float, float]):
        self._servos = servos
        self.model, names = limb_model(model, elastic=mount[0] > 0)
        self.data = self.model.createData()
        self._bases = len(names) - model.nv
        self._freedoms = _Freedoms(model, names, self._bases)
        self._index = np.array([self._freedoms.names.index(name) for name in joints])
        armature = np.concatenate([np.zeros(self._bases), model.dof_armature])
        armature[[names.index(name) for name in joints]] = servos.output_inertia
        self.model.armature = armature
        count = len(self._freedoms.names)
        self.position, self.velocity, self.acceleration = np.zeros((3, count))
        self._gravity = -np.array(model.opt.gravity)
        start = np.concatenate([np.zeros(self._bases), model.qpos0])
        self._start = start[self._freedoms.own]
        base = mujoco.MjData(model)
        mujoco.mj_kinematics(model, base)
        self._level = base.xmat[int(np.argmax(model.body_mass > 0))].reshape(3, 3).copy()
        self._mount = np.zeros((self._bases, 2))
        if self._bases:
            inertia = np.diag(pinocchio.crba(self.model, self.data, start))[:2]
            rate = 2 * np.pi * mount[0]
            self._mount = np.stack([inertia * rate**2, 2 * mount[1] * inertia * rate], 1)

    def reset(self, joint_position: Array, qpos: Array | None, tilt: tuple[float, float]) -> None:
        """Initialise at rest, with the mount in static equilibrium.

        Args:
            joint_position: [joint] in rad.
            qpos: the full MuJoCo position, which also sets passive joints.
            tilt: roll and pitch of the stand in rad.
        """
        turn = rotation_matrix(*tilt)
        self.model.gravity.linear = -turn.T @ self._gravity
        self._base = turn @ self._level
        self.position[:] = self._start
        self.position[self._index] = joint_position
        if qpos is not None:
            self.position[self._bases :] = np.concatenate([np.zeros(self._bases), qpos])[self._freedoms.own][
                self._bases :
            ]
        self.velocity[:] = self.acceleration[:] = 0
        if self._bases:
            held = pinocchio.computeGeneralizedGravity(self.model, self.data, self._freedoms.all(self.position))
            self.position[: self._bases] = -held[: self._bases] / self._mount[:, 0]
        self._servos.states["position"] = self.position[self._index]
        self._servos.states["velocity"] = 0

    def begin_tick(self) -> None:
        """Inertia and bias in the middle of the tick."""
        # velocities of semi-implicit steps lag by half a step, so the tick's middle is earlier by that amount
        step = self._servos.world.timestep
        ahead = self.velocity + 0.5 * TICK * self.acceleration
        half = 0.5 * (TICK - step)
        place = self.position + half * (self.velocity + 0.5 * (step + half) * self.acceleration)
        self._inverse, self._bias = self._freedoms.dynamics(self.model, self.data, place, ahead)

    def run(self, count: int) -> None:
        """Make `count` steps with the inertia of this tick; no step may lie beyond its end."""
        servos = self._servos
        step_limbs(
            *servos.records,
            self._index,
            self._mount,
            self.position,
            self.velocity,
            self.acceleration,
            self._inverse,
            self._bias,
            count,
        )
        if not np.isfinite(self.velocity).all():
            raise FloatingPointError

    def trunk(self) -> tuple[Array, Array, Array]:
        """Quaternion (w, x, y, z), angular velocity [rad/s] and specific force [m/s^2] of the base in the base's frame.

        The base tilts with the stand.
        """
        matrix, rates = self._base, np.zeros(3)
        if self._bases:
            rates[:2] = self.velocity[:2]
            matrix = matrix @ rotation_matrix(*self.position[:2])
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, matrix.ravel())
        return quaternion, rates, matrix.T @ self._gravity


class _Freedoms:
    """Which joints move independently; the others follow these or are held, according to the model's equalities.

    Args:
        model: compiled.
        names: names of all degrees of freedom, the mount's first.
        bases: number of degrees of freedom of the mount.

    Attributes:
        own: indices of the independent joints.
        names: names of the independent joints.
        spread: matrix from independent velocities to all velocities, ``[freedom, own]``.
    """

    def __init__(self, model: mujoco.MjModel, names: Sequence[str], bases: int):
        spread, self._offset = np.eye(len(names)), np.zeros(len(names))
        followers = np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT)
        for number in followers:
            joint, driver = (bases + int(ids[number]) for ids in (model.eq_obj1id, model.eq_obj2id))
            self._offset[joint], ratio = model.eq_data[number, :2]
            spread[joint] = ratio * spread[driver] if driver >= bases else 0.0
        self.own = np.setdiff1d(np.arange(len(names)), bases + model.eq_obj1id[followers])
        self.names = [names[number] for number in self.own]
        self.spread = spread[:, self.own]
        rest = (
            (np.zeros(bases), model.dof_damping),
            (np.zeros(bases), _stiffness(model)),
            (np.zeros(bases), model.qpos0),
        )
        self._damping, self._spring, self._rest = (np.concatenate(parts) for parts in rest)
        self._all_own = len(self.own) == len(names)

    def all(self, position: Array) -> Array:
        """Positions of all joints from the independent ones [freedom]."""
        return self.spread @ position + self._offset

    def dynamics(
        self, model: pinocchio.Model, data: pinocchio.Data, position: Array, velocity: Array
    ) -> tuple[Array, Array]:
        """Inverse inertia of the independent joints, ``[own, own]``, and bias torques including passive joints."""
        place, speed = self.all(position), self.spread @ velocity
        bias = pinocchio.nonLinearEffects(model, data, place, speed)
        bias = bias + self._damping * speed + self._spring * (place - self._rest)
        if self._all_own:
            return pinocchio.computeMinverse(model, data, place), bias
        inertia = np.triu(pinocchio.crba(model, data, place))
        inertia = inertia + np.triu(inertia, 1).T
        return np.linalg.inv(self.spread.T @ inertia @ self.spread), self.spread.T @ bias


def _stiffness(model: mujoco.MjModel) -> Array:
    """Linear stiffness of every joint [joint]."""
    return model.jnt_stiffness.reshape(model.njnt, -1)[:, 0]


def limb_model(model: mujoco.MjModel, elastic: bool = False) -> tuple[pinocchio.Model, list[str]]:
    """Pinocchio's model of the bodies of a MuJoCo model.

    Args:
        model: model whose joints are hinges and slides.
        elastic: whether two additional first joints let the base roll and pitch.

    Returns:
        The model, and the names of its degrees of freedom.

    Raises:
        ValueError: if a joint is a ball.
    """
    made = pinocchio.Model()
    names: list[str] = []
    # the joint that carries each body, and the body's frame in it
    carriers = [(0, pinocchio.SE3.Identity())]
    for body in range(1, model.nbody):
        carrier, frame = carriers[model.body_parentid[body]]
        frame = frame * pinocchio.SE3(_matrix(model.body_quat[body]), np.array(model.body_pos[body]))
        if elastic and not names and model.body_mass[body] > 0:
            for axis in np.eye(3)[:2]:
                carrier = made.addJoint(
                    carrier, pinocchio.JointModelRevoluteUnaligned(axis), frame, f"mount_{len(names)}"
                )
                names.append(f"mount_{len(names)}")
                frame = pinocchio.SE3.Identity()
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            name = model.joint(joint).name
            kinds = {
                mujoco.mjtJoint.mjJNT_HINGE: pinocchio.JointModelRevoluteUnaligned,
                mujoco.mjtJoint.mjJNT_SLIDE: pinocchio.JointModelPrismaticUnaligned,
            }
            if (kind := kinds.get(int(model.jnt_type[joint]))) is None:
                raise ValueError(
                    f"on a fixed base the stand-in moves hinges and slides; joint {name!r} is neither: take a floor"
                )
            at = pinocchio.SE3(np.eye(3), np.array(model.jnt_pos[joint]))
            carrier = made.addJoint(carrier, kind(np.array(model.jnt_axis[joint])), frame * at, name)
            names.append(name)
            frame = at.inverse()
        carriers.append((carrier, frame))
        if model.body_mass[body] > 0:
            turn = _matrix(model.body_iquat[body])
            inertia = turn @ np.diag(model.body_inertia[body]) @ turn.T
            mass = pinocchio.Inertia(float(model.body_mass[body]), np.array(model.body_ipos[body]), inertia)
            made.appendBodyToJoint(carrier, mass, frame)
    return made, names


def change_body(model: mujoco.MjModel, body: int, effect: Hidden) -> None:
    """Apply an effect to a link."""
    size = effect.size
    if effect.name == "link_com":
        model.body_ipos[body, 0] += size
    elif effect.name == "link_inertia":
        model.body_inertia[body] += size * model.body_mass[body]
    elif effect.name == "link_mass":
        mass = model.body_mass[body]
        if effect.form == "plate":  # 60 mm by 40 mm, beside the link's centre of mass
            apart = np.array([0.02, 0.0, -0.035])
            share = size / (mass + size)
            model.body_ipos[body] += share * apart
            model.body_inertia[body] += size * (0.06**2 + 0.04**2) / 12 + (1 - share) * size * (apart @ apart) * 0.7
        model.body_mass[body] = mass + size


def _matrix(quaternion: Array) -> Array:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


_DIVERGENCE = [
    int(kind)
    for kind in (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
]


class Floor:
    """A robot in contact, simulated by MuJoCo with semi-implicit Euler steps and elliptic friction cones.

    One evaluation of the dynamics per step suits servos that carry a state of their own and advance once per step; at
    0.25 ms it needs no implicit damping (the stiffest term, damping over inertia, is 0.1 per step), and it costs a
    quarter of RK4.

    Args:
        model: compiled; its options are changed.
        servos: servos of the joints.
        joints: names of the joints in the model [joint].
        imu: first places of quaternion, gyro and accelerometer among the sensors; None without an IMU.
    """

    def __init__(self, model: mujoco.MjModel, servos: HiddenServos, joints: Sequence[str], imu: Sequence[int] | None):
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        model.opt.timestep = servos.world.timestep
        ids = [model.joint(name).id for name in joints]
        model.dof_armature[model.jnt_dofadr[ids]] = servos.output_inertia
        mujoco.mj_setConst(model, mujoco.MjData(model))
        self.model, self.data = model, mujoco.MjData(model)
        places, freedoms = _run(model.jnt_qposadr[ids]), _run(model.jnt_dofadr[ids])
        self._position, self._velocity = self.data.qpos[places], self.data.qvel[freedoms]
        self._torque = self.data.qfrc_applied[freedoms]
        self._servos, self._imu = servos, imu

    def reset(self, joint_position: Array, qpos: Array | None, tilt: tuple[float, float]) -> None:
        """Initialise at rest in the full MuJoCo position."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self.data)
        self._servos.states["position"] = self._position

    def begin_tick(self) -> None:
        """Nothing."""

    def run(self, count: int) -> None:
        """Make `count` steps."""
        servos = self._servos
        for _ in range(count):
            step_servos(*servos.records, self._position, self._velocity, self._torque)
            mujoco.mj_step(self.model, self.data)
        servos.states["position"] = self._position
        if not np.isfinite(self.data.qacc).all() or self.data.warning.number[_DIVERGENCE].any():
            raise FloatingPointError

    def trunk(self) -> tuple[Array, Array, Array]:
        """Readings of an IMU without errors; see `Limbs`."""
        assert self._imu is not None
        attitude, gyro, force = self._imu
        said = self.data.sensordata
        return said[attitude : attitude + 4], said[gyro : gyro + 3], said[force : force + 3]


def _run(addresses: Array) -> slice:
    """Consecutive addresses as a slice, so that indexing gives a view."""
    first = np.asarray(addresses).ravel()
    if (np.diff(first) != 1).any():
        raise ValueError("the joints of the scene must be consecutive in the model")
    return slice(int(first[0]), int(first[-1]) + 1)
