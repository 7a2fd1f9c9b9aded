"""The servo law as an actuator of dm_control composer: an entity attached to a robot."""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from dm_control import composer, mjcf
from dm_control.composer.observation import observable
from torch import Tensor

from op3.servo import RobotModel, Servos
from op3.sim.edits import edited_fields, model_field
from op3.sim.exchange import hand_over, read
from op3.sim.inputs import expand_parameters, fresh_start, set_commands, steps_in
from op3.sim.ports import ServoPorts, attach_servos
from op3.sim.trunk_sensors import BaseBody, readings


class GearedServo(composer.Entity):
    """Geared servos on hinges of any robot; composer calls the hooks.

        servos = GearedServo(robot.joints, model, base_body=robot.trunk)
        robot.attach(servos)
        servos.command(position_target=targets, p_gain=gains, d_gain=0.1)  # from the task's before_step

    The PD reads the sensors every `control_period`; the law runs before every step of the physics. Use
    ``legacy_step=False`` in ``composer.Environment``: otherwise the order of steps differs from ``mj_step`` and from
    the batched simulation.

    Args:
        joints: dm_control MJCF elements of hinge joints; each gets a motor and a torque sensor.
        model: effects and parameter values of the servos.
        base_body: MJCF element of the robot's base body, if there is one.
        control_period: time between ticks of the PD [s], a multiple of the physics' time step.
    """

    def _build(
        self,
        joints: Sequence[Any],
        model: RobotModel,
        base_body: Any = None,
        control_period: float = 0.008,
    ):
        attach_servos(joints)
        self._mjcf_root = mjcf.RootElement(model="servos")
        self._joints, self._base_element, self._control_period = list(joints), base_body, control_period
        self.model = model
        self.joint_names = tuple(joint.name for joint in joints)
        self._commands: dict[str, Any] = {}
        self._base: BaseBody | None = None
        self._rotor: np.ndarray = np.zeros((1, len(joints)))
        self._failed = np.zeros(1, bool)

    def _build_observables(self) -> composer.Observables:
        return ServoObservables(self)

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """Empty: motors and sensors are in the robot's tree."""
        return self._mjcf_root

    def command(self, **commands: Any) -> None:
        """Set commands for the next ticks, held until changed.

        Args:
            **commands: ``position_target`` [rad], ``p_gain`` [A/rad], ``d_gain`` [A s/rad] and the others of
                `op3.servo.Signals`, each ``[joint]``. Commands set before an episode count as held for long.
        """
        self._commands |= commands

    def after_compile(self, physics: Any, random_state: Any) -> None:
        """Find the servos in the compiled model and apply the effects' model edits."""
        del random_state
        names = [joint.full_identifier for joint in self._joints]
        model = physics.model.ptr
        self.ports = ServoPorts.find(model, names)
        base = -1 if self._base_element is None else int(physics.bind(self._base_element).element_id)
        self._base = None if base < 0 else BaseBody.find(model, base)
        values = expand_parameters(self.model, self.joint_names, {}, 1)
        timestep = float(model.opt.timestep)
        self._every = steps_in(self._control_period, timestep)
        self.law = Servos(self.model.effects, self.joint_names, 1, timestep, self._control_period)
        self.law.set(values)
        self.signals, self._at = self.law.signals, self.ports.table
        edits = edited_fields(model, self.model.effects, values, self.ports, base, 1)
        for field, array in edits.items():
            model_field(model, field)[...] = array[0]
        if edits:
            mujoco.mj_setConst(model, physics.data.ptr)
        self._rotor = model.dof_armature[None, self.ports.dof].copy()

    def initialize_episode(self, physics: Any, random_state: Any) -> None:
        """Start at rest with the commands set so far."""
        del random_state
        physics.model.ptr.dof_frictionloss[self.ports.dof] = 0.0
        physics.model.ptr.dof_armature[self.ports.dof] = self._rotor[0]
        mujoco.mj_forward(physics.model.ptr, physics.data.ptr)
        self._read(physics)
        fresh_start(self.signals, self.model)
        set_commands(self.signals, self._commands)
        self.law.reset()
        self._substep = 0

    def before_substep(self, physics: Any, random_state: Any) -> None:
        """Tick the PD where it is due; set torque, damping and friction of the coming physics step."""
        del random_state
        self._read(physics)
        if self._substep % self._every == 0:
            set_commands(self.signals, self._commands)
            self.law.tick()
        self._substep += 1
        self.law.step()
        model, ctrl = physics.model.ptr, physics.data.ptr.ctrl
        handed = ctrl[None], model.dof_armature[None], model.dof_frictionloss[None]
        hand_over(self.law.records, self._at, self.law.clock.timestep, self._rotor, *handed, self._failed)

    @property
    def motor_current(self) -> np.ndarray:
        """Currents of the motors in the last step [A], ``[joint]``."""
        return self.signals.current[0].numpy()

    def measure(self, physics: Any) -> Mapping[tuple[str, str], Tensor]:
        """Present readings of the servos' and the trunk's sensors: channels of the log, ``[joint]`` and ``[3]``."""
        self._read(physics)
        state = physics.data.ptr
        arrays = (torch.from_numpy(array)[None] for array in (state.qpos, state.qvel, state.xquat))
        channels = readings(self.law, self._base and self._base.trunk(*arrays))
        return {name: value[0] for name, value in channels.items()}

    def _read(self, physics: Any) -> None:
        data = physics.data.ptr
        state = (data.qpos[None], data.qvel[None], data.sensordata[None], data.qfrc_applied[None])
        read(self.law.records, self._at, self.law.reads("radial_force"), *state)


class ServoObservables(composer.Observables):
    """Readings of the servos, ``[joint]``."""

    @composer.observable
    def position(self) -> observable.Generic:
        """Joint angles [rad]."""
        return observable.Generic(lambda physics: self._entity.measure(physics)["joint", "position"].numpy())

    @composer.observable
    def velocity(self) -> observable.Generic:
        """Joint velocities [rad/s]."""
        return observable.Generic(lambda physics: self._entity.measure(physics)["joint", "velocity"].numpy())

    @composer.observable
    def current(self) -> observable.Generic:
        """Motor currents [A]."""
        return observable.Generic(lambda physics: self._entity.measure(physics)["joint", "current"].numpy())
