"""Many simulations of one robot, each with its own parameters, stepped together."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from op3.servo import RobotModel, Servos
from op3.sim.edits import edited_fields
from op3.sim.exchange import hand_over, read
from op3.sim.inputs import expand_parameters, fresh_start, set_commands, steps_in
from op3.sim.ports import ServoPorts
from op3.sim.trunk_sensors import BaseBody, readings, undo_sensing


class BatchSimulation:
    """``num_sims`` copies of a scene, with the servo law between steps of ``mujoco.Batch``.

    Commands are held from one tick to the next; ``advance`` moves one control period. Parameters may differ between
    simulations and between joints. A simulation that diverges is reported in ``failed`` and does not affect the others.

    Damping ``D`` of the servo law is integrated implicitly: ``(M + h D) a = f - D v`` for a step ``h``. It is passed on
    as armature ``h D`` of that step, not as ``dof_damping``, because MuJoCo solves constraints with ``M`` alone: it
    would compute friction for a reversal of motion that the damping then prevents.

    Args:
        mj_model: compiled scene with servos attached to `joints`.
        joints: full joint names, in the order of every ``[sim, joint]`` tensor.
        control_period: time between ticks [s], a multiple of the model's time step.
        base_body: full name of the robot's base body; None for a scene without one.
        joint_names: names by which the model's per-joint values address the joints; by default the last part
            of each full name.
        num_threads: threads that step the physics; 0 for all processors.

    Raises:
        ValueError: if the control period is not a multiple of the time step, or a name is unknown.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        joints: Sequence[str],
        model: RobotModel,
        num_sims: int,
        *,
        control_period: float = 0.008,
        base_body: str | None = None,
        joint_names: Sequence[str] | None = None,
        num_threads: int = 0,
    ):
        self.timestep = float(mj_model.opt.timestep)
        self.substeps = steps_in(control_period, self.timestep)
        self.model = model
        self.num_sims = num_sims
        self.joint_names = tuple(joint_names or (name.rsplit("/", 1)[-1] for name in joints))
        self.ports = ServoPorts.find(mj_model, joints)
        self.batch = Batch(mj_model, num_sims, num_threads)
        self._base = None if base_body is None else BaseBody.find(mj_model, mj_model.body(base_body).id)
        self.law = Servos(model.effects, self.joint_names, num_sims, self.timestep, control_period)
        self.signals, self._forces = self.law.signals, self.law.reads("radial_force")
        fresh_start(self.signals, model)
        self.failed = torch.zeros(num_sims, dtype=torch.bool)
        self.on_step: Callable[[], None] | None = None
        """Called after every physics step, for example to detect peaks."""
        self._bind()
        self.set_parameters({})

    def _bind(self) -> None:
        batch, self._at = self.batch, self.ports.table
        self._state = tuple(batch.bind(name) for name in ("qpos", "qvel", "sensordata", "qfrc_applied"))
        self._handed = batch.bind("ctrl"), batch.expand("dof_armature"), batch.expand("dof_frictionloss")
        self._qpos, self._qvel, self._sensors = map(torch_view, self._state[:3])
        _, self._armature, self._friction = map(torch_view, self._handed)
        self._xquat = torch_view(batch.bind("xquat"))

    @property
    def motor_current(self) -> np.ndarray:
        """Currents of the motors in the last step [A], ``[sim, joint]``."""
        return self.law.records["current"]

    @property
    def sensordata(self) -> Tensor:
        """All sensors of the scene at the last step, ``[sim, nsensordata]``, over the simulator's memory."""
        return self._sensors

    def set_parameters(self, values: Mapping[str, Tensor | float]) -> None:
        """Set parameters per simulation; all others get the model's values.

        Args:
            values: values by parameter name, ``[sim]`` or ``[sim, joint]`` or a number.

        Raises:
            ValueError: if the model has no such parameter, or a shape does not fit.
        """
        expanded = expand_parameters(self.model, self.joint_names, values, self.num_sims)
        if hasattr(self, "_rotor"):
            self._armature[:, self.ports.dof] = self._rotor  # without the damping of the last step
        self.parameters = expanded
        self.law.set(expanded)
        base = -1 if self._base is None else self._base.body
        edits = edited_fields(self.batch.model, self.model.effects, expanded, self.ports, base, self.num_sims)
        for field, array in edits.items():
            self.batch.expand(field)[...] = array
        if edits:
            self.batch.set_const()
        self._rotor = self._armature[:, self.ports.dof].clone(memory_format=torch.contiguous_format)

    def reset(
        self,
        qpos: np.ndarray | Tensor,
        commands: Mapping[str, Tensor] | None = None,
        qvel: Any = 0.0,
        *,
        measured: bool = False,
        rows: np.ndarray | None = None,
    ) -> None:
        """Restart simulations.

        Args:
            qpos: full MuJoCo position, ``[nq]`` or ``[sim, nq]``.
            commands: first commands, as for `command`; by default the joints' positions.
            qvel: full MuJoCo velocity, ``[nv]`` or ``[sim, nv]``.
            measured: whether the joints' positions are sensor readings, shifted by an encoder offset; each simulation
                then starts where its sensors give these readings.
            rows: indices of the simulations that restart, between ticks; the others continue. Then `qpos`,
                `qvel` and `commands` have one row for each of these. None: all.

        Raises:
            ValueError: if `rows` are given together with readings, from which only all simulations can start.
        """
        if rows is not None and measured:
            raise ValueError("readings set the state of all simulations at once: give readings or rows, not both")
        if rows is not None and not len(rows):
            return
        ids = None if rows is None else np.asarray(rows, dtype=np.int64)
        which = slice(None) if ids is None else ids
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._qpos[which] = torch.as_tensor(qpos, dtype=torch.float64)
        if measured:
            self._qpos[:, self.ports.qpos] = undo_sensing(self.law, self._qpos[:, self.ports.qpos])
        self._qvel[which] = torch.as_tensor(qvel, dtype=torch.float64)
        for array, value in ((self._friction, 0.0), (self._armature, self._rotor[which])):
            block = array[which]
            block[:, self.ports.dof] = value
            array[which] = block
        self.batch.forward(ids)
        self.batch.warning[which] = 0
        self.failed[which] = False
        self._read()
        fresh_start(self.signals, self.model, which)
        set_commands(self.signals, commands or {}, which)
        self.law.reset(ids)

    def command(self, **commands: Tensor) -> None:
        """Set commands for the next ticks; all others are held.

        Args:
            commands: any of ``position_target`` [rad], ``p_gain`` [A/rad], ``d_gain`` [A s/rad],
                ``firmware_gain``, ``torque_enable`` (0 or 1), ``bus_voltage`` [V] and ``temperature`` [C], each
                broadcastable to ``[sim, joint]``.

        Raises:
            ValueError: if a command is unknown.
        """
        set_commands(self.signals, commands)

    def push(self, torque: np.ndarray) -> None:
        """Apply a torque to the links, which loads their servos, until the next call or reset.

        Args:
            torque: [N m], ``[sim, joint]``.
        """
        self._state[3][:, self.ports.dof] = torque

    def advance(self) -> None:
        """Simulate one control period: a tick of the law, then the simulation steps."""
        self._read()
        self.law.tick()
        for _ in range(self.substeps):
            self.law.step()
            self._hand_over()
            self.batch.step()
            self._read()
            if self.on_step is not None:
                self.on_step()
        # MuJoCo resets a diverging state and zeroes NaN controls without an exception; only its warning counters reveal
        # it
        if self.batch.warning.any():
            self.failed |= torch.from_numpy(self.batch.warning.any((1, 2)))

    def measure(self) -> dict[tuple[str, str], Tensor]:
        """Present readings of the servos' and the trunk's sensors: channels of the log, ``[sim, joint | 3]``."""
        self._read()
        return readings(self.law, self._base and self._base.trunk(self._qpos, self._qvel, self._xquat))

    def _read(self) -> None:
        read(self.law.records, self._at, self._forces, *self._state)

    def _hand_over(self) -> None:
        failed = self.failed.numpy()
        hand_over(self.law.records, self._at, self.timestep, self._rotor.numpy(), *self._handed, failed)


def torch_view(array: np.ndarray) -> Tensor:
    """A tensor over the same memory; outputs of the batch are read-only for numpy and stay unwritten here."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*not writable.*")
        return torch.from_numpy(array)
