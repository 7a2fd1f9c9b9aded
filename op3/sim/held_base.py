"""Robots and benches whose base is held: dynamics along a measured motion, and contributions of edited bodies."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np

from op3.robot import load_robot
from op3.robot.register_units import GRAVITY
from op3.scenes import build_scene
from op3.servo import RobotModel
from op3.sim.edits import LINK, ROTOR, edited_fields, model_field
from op3.sim.ports import ServoPorts, attach_servos
from op3.sim.trajectories import TrajectoryDynamics, trajectory_dynamics


class FixedBase:
    """The limbs of a robot on a stand that are in the logs, compiled with their servos.

    Args:
        robot: a name in `assets/robots`, or the path of its file.
        tilt: roll and pitch of the stand [rad].
    """

    def __init__(self, joints: Sequence[str], robot: str, tilt: tuple[float, float] = (0.0, 0.0)):
        known = load_robot(robot)
        known.indices(joints)
        scene = build_scene("stand", tilt_roll=tilt[0], tilt_pitch=tilt[1], joints=joints, robot=known)
        elements: dict[str, Any] = {str(element.name): element for element in scene.joints}
        moved = [elements[joint] for joint in joints]
        attach_servos(moved)
        self.names = [str(element.full_identifier) for element in moved]
        self.joints = tuple(joints)
        self.mj_model = scene.compile(visual=False)
        self.ports = ServoPorts.find(self.mj_model, self.names)
        assert scene.robot is not None
        self.base = self.mj_model.body(scene.robot.trunk.full_identifier).id
        standing = dict(zip(known.joints, known.home, strict=True))
        self.qpos = np.zeros(self.mj_model.nq)
        for i in range(self.mj_model.njnt):
            self.qpos[i] = standing[self.mj_model.joint(i).name.rsplit("/", 1)[-1]]

    def dynamics(self, position: np.ndarray, velocity: np.ndarray, radial_force: bool = False) -> TrajectoryDynamics:
        """Dynamics along a motion, ``[tick, joint]``."""
        return trajectory_dynamics(
            self.mj_model, self.names, position, velocity, self.qpos, base=self.base, radial_force=radial_force
        )

    def along(self, mj_model: mujoco.MjModel, position: np.ndarray, velocity: np.ndarray) -> TrajectoryDynamics:
        """Mass and bias of an edited model along a motion."""
        return trajectory_dynamics(
            mj_model, self.names, position, velocity, self.qpos, base=self.base, derivatives=False
        )

    def changed(self, model: RobotModel, parameter: str, joint: int | None, amount: float) -> mujoco.MjModel | None:
        """A sound robot with one parameter of a joint increased by `amount`; None if this does not affect the limbs."""
        known = model.parameters()
        sound = model.with_values({name: one.neutral for name, one in known.items() if one.neutral is not None})
        values = {
            name: value.expand(1, len(self.joints) if known[name].per_joint else 1).clone()
            for name, value in sound.tensors(self.joints).items()
        }
        effects = [e for e in model.effects if any(edit != ROTOR for edit in e.edits)]
        arrays = edited_fields(self.mj_model, effects, values, self.ports, self.base, 1)
        values[parameter][:, 0 if joint is None else joint] += amount
        moved = edited_fields(self.mj_model, effects, values, self.ports, self.base, 1)
        different = [field for field in moved if not np.array_equal(moved[field], arrays[field])]
        if not different:
            return None
        changed = copy.copy(self.mj_model)
        for field, array in moved.items():
            if field != "dof_armature":
                model_field(changed, field)[...] = array[0]
        mujoco.mj_setConst(changed, mujoco.MjData(changed))
        return changed


@lru_cache(maxsize=64)
def fixed_base(joints: tuple[str, ...], robot: str, tilt: tuple[float, float] = (0.0, 0.0)) -> FixedBase:
    """The limbs, compiled once for logs with the same joints and tilt."""
    return FixedBase(joints, robot, tilt)


@dataclass(frozen=True)
class PendulumBase:
    """One servo with a weight on an arm: ``m (l^2 + k^2) a + m g l sin q``.

    Attributes:
        mass: mass of the weight [kg].
        length: length of the arm [m].
        gyration_squared: squared radius of gyration of the weight about itself [m^2].
    """

    mass: float
    length: float
    gyration_squared: float = 0.0

    @property
    def mj_model(self) -> "PendulumBase":
        """The sound bench, for `along`."""
        return self

    def dynamics(self, position: np.ndarray, velocity: np.ndarray, radial_force: bool = False) -> TrajectoryDynamics:
        """Dynamics along a motion, ``[tick, joint]``."""
        return self.along(self, position, velocity, radial_force)

    def along(
        self, bench: "PendulumBase", position: np.ndarray, velocity: np.ndarray, radial_force: bool = False
    ) -> TrajectoryDynamics:
        """Dynamics along a motion, of this bench or an edited one."""
        moment = bench.mass * GRAVITY * bench.length
        inertia = bench.mass * (bench.length**2 + bench.gyration_squared)
        whole = np.ones((len(position), 1, 1))
        pull = bench.mass * (GRAVITY * np.cos(position) + bench.length * velocity**2)
        force = np.hypot(pull, bench.mass * GRAVITY * np.sin(position)) if radial_force else np.zeros_like(position)
        bias, gradient = moment * np.sin(position), moment * np.cos(position)[..., None]
        return TrajectoryDynamics(inertia * whole, bias, gradient, 0.0 * whole, force, np.zeros((*force.shape, 3)))

    def changed(self, model: RobotModel, parameter: str, joint: int | None, amount: float) -> "PendulumBase | None":
        """The bench with one parameter increased by `amount`; None if this does not affect it."""
        del model, joint
        if parameter != LINK.parameter:
            return None
        return PendulumBase(self.mass, self.length, self.gyration_squared + amount)
