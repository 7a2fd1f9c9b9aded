"""The servo law as an actuator of dm_control composer tasks."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from op3.servo import RobotModel, Servos
from op3.sim.base import Base, readings
from op3.sim.edits import edited_fields, model_field
from op3.sim.exchange import hand_over, read
from op3.sim.inputs import expand_parameters, fresh_start, set_commands
from op3.sim.ports import ServoPorts, attach_servos


class GearedServo:
    """Geared servos on any hinges of a composer scene, with the hook names of composer.

    Call the hooks of the same name from a task. Use ``legacy_step=False`` in ``composer.Environment``: only
    then is the order of steps that of ``mj_step``, and the trajectory that of the batched simulation.

    Args:
        joints: dm_control MJCF elements of hinge joints; each gets a motor and a torque sensor.
        base_body: MJCF element of the robot's base body, where there is one.
        control_period: time between the task's steps [s].
    """

    def __init__(self, joints: Sequence[Any], model: RobotModel, base_body: Any = None, control_period: float = 0.008):
        attach_servos(joints)
        self._joints = list(joints)
        self._base_element = base_body
        self._control_period = control_period
        self.model = model
        self.joint_names = tuple(joint.name for joint in joints)
        self._base: Base | None = None
        self._rotor: np.ndarray = np.zeros((1, len(joints)))
        self._failed = np.zeros(1, bool)

    def after_compile(self, physics: Any) -> None:
        """Find the servos in the compiled model and carry out the effects' model edits."""
        names = [joint.full_identifier for joint in self._joints]
        self.ports = ServoPorts.find(physics.model.ptr, names)
        base = -1 if self._base_element is None else int(physics.bind(self._base_element).element_id)
        self._base = None if base < 0 else Base.find(physics.model.ptr, base)
        values = expand_parameters(self.model, self.joint_names, {}, 1)
        timestep = float(physics.model.ptr.opt.timestep)
        self.law = Servos(self.model.effects, self.joint_names, 1, timestep, self._control_period)
        self.law.set(values)
        self.signals, self._at = self.law.signals, self.ports.table
        edits = edited_fields(physics.model.ptr, self.model.effects, values, self.ports, base, 1)
        for field, array in edits.items():
            model_field(physics.model.ptr, field)[...] = array[0]
        if edits:
            mujoco.mj_setConst(physics.model.ptr, physics.data.ptr)
        self._rotor = physics.model.ptr.dof_armature[None, self.ports.dof].copy()

    def initialize_episode(self, physics: Any, **commands: Any) -> None:
        """Start with these commands (see `before_step`) as if they had been held for long."""
        physics.model.ptr.dof_frictionloss[self.ports.dof] = 0.0
        physics.model.ptr.dof_armature[self.ports.dof] = self._rotor[0]
        mujoco.mj_forward(physics.model.ptr, physics.data.ptr)
        self._read(physics)
        fresh_start(self.signals, self.model)
        set_commands(self.signals, commands)
        self.law.reset()

    def before_step(self, physics: Any, **commands: Any) -> None:
        """A control period begins: take commands and let the PD look at the sensors.

        Args:
            **commands: ``position_target`` [rad], ``p_gain`` [A/rad], ``d_gain`` [A s/rad] and the others of
                `op3.servo.Signals`, each ``[joint]``; those not named are held.
        """
        set_commands(self.signals, commands)
        self._read(physics)
        self.law.tick()

    def before_substep(self, physics: Any) -> None:
        """Set torque, damping and friction of the coming physics step."""
        self._read(physics)
        self.law.step()
        model, ctrl = physics.model.ptr, physics.data.ptr.ctrl
        handed = ctrl[None], model.dof_armature[None], model.dof_frictionloss[None]
        hand_over(self.law.records, self._at, self.law.clock.timestep, self._rotor, *handed, self._failed)

    @property
    def motor_current(self) -> np.ndarray:
        """In the motors at the last step [A], ``[joint]``."""
        return self.signals.current[0].numpy()

    def measure(self, physics: Any) -> dict[tuple[str, str], Tensor]:
        """What the servos' and the trunk's sensors say now: channels of the log, ``[joint]`` and ``[3]``."""
        self._read(physics)
        state = physics.data.ptr
        arrays = (torch.from_numpy(array)[None] for array in (state.qpos, state.qvel, state.xquat))
        channels = readings(self.law, self._base and self._base.trunk(*arrays))
        return {name: value[0] for name, value in channels.items()}

    def _read(self, physics: Any) -> None:
        data = physics.data.ptr
        state = (data.qpos[None], data.qvel[None], data.sensordata[None], data.qfrc_applied[None])
        read(self.law.records, self._at, self.law.reads("radial_force"), *state)
