"""Many simulations of one robot, each with parameters of its own, stepped together."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from op3.servo import RobotModel, ServoLaw, Signals, Trunk
from op3.servo.compiled_step import CompiledStep
from op3.sim.base import Base, roll_pitch_yaw
from op3.sim.edits import edited_fields
from op3.sim.inputs import COMMANDS, default_commands, expand_parameters, set_commands, set_start
from op3.sim.ports import ServoPorts
from op3.sim.translated import RESULTS, Translated


class BatchSimulation:
    """``num_sims`` copies of a scene, with the servo law between steps of ``mujoco.Batch``.

    Commands are held from one tick to the next; ``advance`` moves one control period. Parameters may differ
    between simulations and between joints. A simulation that diverges is reported in ``failed`` and does not
    disturb the others.

    Damping ``D`` of the servo law is integrated implicitly: ``(M + h D) a = f - D v`` for a step ``h``. It is
    handed over as armature ``h D`` of that step, not as ``dof_damping``, because MuJoCo solves constraints with
    ``M`` alone: friction would act against a reversal that the damping then prevents.

    Args:
        mj_model: compiled scene with servos attached to `joints`.
        joints: full joint names, in the order of every ``[sim, joint]`` tensor.
        model: effects and parameter values.
        num_sims: number of simulations.
        control_period: time between ticks [s], a multiple of the model's time step.
        base_body: full name of the robot's base body; None for a scene without one.
        joint_names: names by which the model's per-joint values address the joints; by default the last part
            of each full name.
        num_threads: threads that step the physics; 0 for all processors.
        translated: whether the law runs in numpy and machine code where it can, which agrees with torch to rounding and
            takes a fraction of the time. `signals` are then views that the next step overwrites.
        fields: MuJoCo model fields that differ between simulations, ``[sim, ...]``, before the model's edits.

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
        translated: bool = True,
        fields: Mapping[str, np.ndarray] | None = None,
    ):
        self.timestep = float(mj_model.opt.timestep)
        self.substeps = round(control_period / self.timestep)
        if self.substeps < 1 or abs(self.substeps * self.timestep - control_period) > 1e-9:
            raise ValueError(f"control_period {control_period} s must be a multiple of the time step {self.timestep} s")
        self.model = model
        self.num_sims = num_sims
        self.joint_names = tuple(joint_names or (name.rsplit("/", 1)[-1] for name in joints))
        self.ports = ServoPorts.find(mj_model, joints)
        self.batch = Batch(mj_model, num_sims, num_threads)
        self._base = None if base_body is None else Base.find(mj_model, mj_model.body(base_body).id)
        self._fields = {name: np.array(value, dtype=np.float64) for name, value in (fields or {}).items()}
        self.law = ServoLaw(model.effects, self.timestep, control_period, self.joint_names)
        self.signals = Signals.zeros(num_sims, len(joints))
        self._reads_force = self.law.reads("radial_force")
        self._translate = translated
        self._translated: Translated | None = None
        default_commands(self.signals, model)
        self.failed = torch.zeros(num_sims, dtype=torch.bool)
        self.on_step: Callable[[], None] | None = None
        """Called after every step of the physics; who looks for peaks looks here."""
        self._bind()
        self.set_parameters({})

    def _bind(self) -> None:
        batch = self.batch
        self._qpos, self._qvel = _torch_view(batch.bind("qpos")), _torch_view(batch.bind("qvel"))
        self._ctrl = _torch_view(batch.bind("ctrl"))
        self._sensors = _torch_view(batch.bind("sensordata"))
        self._friction = _torch_view(batch.expand("dof_frictionloss"))
        self._armature = _torch_view(batch.expand("dof_armature"))
        if self._base is not None:
            self._base_quaternion = _torch_view(batch.bind("xquat"))[:, self._base.body]

    @property
    def translated(self) -> bool:
        """Whether numpy has taken over the law."""
        return self._translated is not None

    @property
    def motor_current(self) -> np.ndarray:
        """In the motors at the last step [A], ``[sim, joint]``."""
        if self._translated is not None:
            return self._translated.step.outputs["current"]
        return self.signals.current.numpy()

    @property
    def sensordata(self) -> Tensor:
        """All sensors of the scene at the last step, ``[sim, nsensordata]``, over the simulator's memory."""
        return self._sensors

    def set_parameters(self, values: Mapping[str, Tensor | float]) -> None:
        """Give parameters per simulation; those not named take the model's values.

        Args:
            values: by parameter name, ``[sim]`` or ``[sim, joint]`` or a number.

        Raises:
            ValueError: if the model has no such parameter, or a shape does not fit.
        """
        expanded = expand_parameters(self.model, self.joint_names, values, self.num_sims)
        self._translated = None  # it holds the parameters of before
        if hasattr(self, "_rotor"):
            self._armature[:, self.ports.dof] = self._rotor  # without the damping of the last step
        self.parameters = expanded
        self.law.set_parameters(expanded)
        base = -1 if self._base is None else self._base.body
        edits = edited_fields(
            self.batch.model,
            self.model.effects,
            expanded,
            self.ports,
            base,
            self._fields,
            self.num_sims,
        )
        for field, array in edits.items():
            self.batch.expand(field)[...] = array
        if edits:
            self.batch.set_const()
        self._rotor = self._armature[:, self.ports.dof].clone()

    def reset(
        self,
        qpos: np.ndarray | Tensor,
        commands: Mapping[str, Tensor] | None = None,
        qvel: Any = 0.0,
        *,
        measured: bool = False,
        load_torque: Any = None,
        current: Any = None,
        time: Any = 0.0,
        rows: np.ndarray | None = None,
    ) -> None:
        """Start simulations anew.

        Args:
            qpos: full MuJoCo position, ``[nq]`` or ``[sim, nq]``.
            commands: first commands, as for `command`; by default the joints' own positions.
            qvel: full MuJoCo velocity, ``[nv]`` or ``[sim, nv]``.
            measured: whether the joints' positions are readings of the sensors, which an encoder offset shifts;
                each simulation then starts where its own sensors read them.
            load_torque: tau_a on the servos at the start [N m], broadcastable to ``[sim, joint]``; tells on which
                flank a backlash begins. By default that of the robot let go in this pose.
            current: in the motors at the start [A]; by default none.
            time: since the start of the recording [s], for effects that change with it.
            rows: indices of the simulations that start anew, between ticks; the others are not disturbed. Then `qpos`,
                `qvel` and `commands` have one row for each of these, and the remaining arguments stay at their
                defaults. None: all.

        Raises:
            ValueError: if `rows` is given together with what only all simulations can start from.
        """
        if rows is not None:
            if measured or load_torque is not None or current is not None or time:
                raise ValueError("measured, load_torque, current and time can start all simulations only: omit rows")
            self._reset_rows(np.asarray(rows, dtype=np.int64), qpos, commands or {}, qvel)
            return
        self._translated = None  # it holds the shapes of before
        self.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._qpos[...] = torch.as_tensor(qpos, dtype=torch.float64)
        if measured:
            self._undo_sensing()
        self._qvel[...] = torch.as_tensor(qvel, dtype=torch.float64)
        self._friction[:, self.ports.dof] = 0.0
        self._armature[:, self.ports.dof] = self._rotor
        self.batch.forward()
        self.batch.warning[...] = 0
        self.failed = torch.zeros(self.num_sims, dtype=torch.bool)
        self._read()
        default_commands(self.signals, self.model)
        self.command(**(commands or {}))
        set_start(self.signals, load_torque, current, time)
        self.law.reset(self.signals)

    def _reset_rows(self, rows: np.ndarray, qpos: Any, commands: Mapping[str, Tensor], qvel: Any) -> None:
        if not len(rows):
            return
        self.batch.reset(rows, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._qpos[rows] = torch.as_tensor(qpos, dtype=torch.float64)
        self._qvel[rows] = torch.as_tensor(qvel, dtype=torch.float64)
        for array, value in ((self._friction, 0.0), (self._armature, self._rotor[rows])):
            block = array[rows]
            block[:, self.ports.dof] = value
            array[rows] = block
        self.batch.forward(rows)
        self.batch.warning[rows] = 0
        self.failed[rows] = False
        self._read()
        # the law starts all simulations anew, on the side; those of the rows are taken over
        fresh = replace(self.signals, state={}, factors={})
        default_commands(fresh, self.model)
        whole = {name: getattr(fresh, name).clone() for name in commands}
        for name, value in commands.items():
            whole[name][rows] = torch.as_tensor(value, dtype=torch.float64)
        set_commands(fresh, whole)
        set_start(fresh)
        self.law.reset(fresh)
        for name in (*COMMANDS, "current", "time"):
            setattr(self.signals, name, _take_over(getattr(self.signals, name), getattr(fresh, name), rows))
        for memory, anew in ((self.signals.state, fresh.state), (self.signals.factors, fresh.factors)):
            for name, value in anew.items():
                memory[name] = _take_over(memory.get(name, value), value, rows)

    def _undo_sensing(self) -> None:
        """Move the joints until their sensors read what the joints' positions were."""
        reading = self._qpos[:, self.ports.qpos].clone()
        for _ in range(3):  # exact after one round for an offset; more for a reading that bends with the angle
            self.signals.position = self._qpos[:, self.ports.qpos]
            self.signals.velocity = torch.zeros_like(reading)
            self.law.sense(self.signals)
            self._qpos[:, self.ports.qpos] += reading - self.signals.measured_position

    def command(self, **commands: Tensor) -> None:
        """Set commands for the ticks to come; those not named are held.

        Args:
            commands: any of ``position_target`` [rad], ``p_gain`` [A/rad], ``d_gain`` [A s/rad],
                ``firmware_gain``, ``torque_enable`` (0 or 1), ``bus_voltage`` [V] and ``temperature`` [C], each
                broadcastable to ``[sim, joint]``.

        Raises:
            ValueError: if a command is unknown.
        """
        # physics has no gradients; a policy's actions may
        detached = {name: torch.as_tensor(value, dtype=torch.float64).detach() for name, value in commands.items()}
        set_commands(self.signals, detached)

    def push(self, torque: np.ndarray) -> None:
        """Torque on the joints beside what their servos give, held until the next call or reset.

        Args:
            torque: [N m], ``[sim, joint]``.
        """
        self.batch.bind("qfrc_applied")[:, self.ports.dof] = torque

    def advance(self) -> None:
        """One control period: a tick of the law, then its simulation steps."""
        signals, law, ports = self.signals, self.law, self.ports
        self._read()
        law.tick(signals)
        if self._translate and self._translated is None:
            self._translated = self._translation()
            self._translate = self._translated is not None
        if self._translated is None:
            for _ in range(self.substeps):
                self._read()
                law.step(signals)
                self._ctrl[:, ports.ctrl] = signals.applied_torque
                self._armature[:, ports.dof] = self._rotor + self.timestep * signals.damping
                self._friction[:, ports.dof] = signals.friction_bound
                self.batch.step()
                if self.on_step is not None:
                    self.on_step()
        else:
            self._advance_translated(self._translated)
        self._note_failures()

    def _advance_translated(self, translated: Translated) -> None:
        """The steps of a control period in numpy, over the simulator's own arrays."""
        signals = self.signals
        signals.phase = self._phase_zero
        translated.hear(signals)
        for _ in range(self.substeps):
            self._step_in_numpy(translated.step)
        translated.tell(signals)

    def _step_in_numpy(self, law: CompiledStep) -> None:
        """A step of the law and of the physics, over the arrays of `_live_arrays`."""
        np.negative(self._transmitted, out=self._load)
        if self._reads_force:
            sensors, across = self._sensors.numpy(), self.ports.force
            np.hypot(sensors[:, across], sensors[:, across + 1], out=self._radial_force)
        law()
        control, armature, friction = self._handed
        control[...] = law.outputs["applied_torque"]
        np.multiply(law.outputs["damping"], self.timestep, out=armature)
        armature += self._rotor_inertia
        friction[...] = law.outputs["friction_bound"]
        self.batch.step()
        if self.on_step is not None:
            self.on_step()

    def _live_arrays(self) -> dict[str, np.ndarray] | None:
        """Inputs of the law that `_step_in_numpy` fills, or that are the simulator's own; None where they cannot be."""
        ports = self.ports
        if not all(isinstance(each, slice) for each in (ports.qpos, ports.dof, ports.ctrl, ports.transmitted)):
            return None
        self._transmitted = self._sensors.numpy()[:, ports.transmitted]
        self._load = np.zeros_like(self._transmitted, order="C")
        live = {
            "position": self._qpos.numpy()[:, ports.qpos],
            "velocity": self._qvel.numpy()[:, ports.dof],
            "load_torque": self._load,
        }
        if self._reads_force:
            self._radial_force = live["radial_force"] = np.zeros_like(self._load)
        self._rotor_inertia = self._rotor.numpy()
        self._handed = (
            self._ctrl.numpy()[:, ports.ctrl],
            self._armature.numpy()[:, ports.dof],
            self._friction.numpy()[:, ports.dof],
        )
        return live

    def _translation(self) -> Translated | None:
        """The law's step in numpy, reading the simulator's own arrays; None where that cannot be."""
        live = self._live_arrays()
        if live is None:
            return None
        self._phase_zero = torch.zeros(1, dtype=torch.int64)

        def step(signals: Signals) -> None:
            # also right after a tick, which left the sensors as this does
            self.law.sense(signals)
            self.law.act(signals)

        started = replace(self.signals, phase=self._phase_zero)
        return Translated.of(step, started, RESULTS, live)

    def measure(self) -> dict[tuple[str, str], Tensor]:
        """What the servos' and the trunk's sensors say now: channels of the log, ``[sim, joint | 3]``."""
        self._read()
        self.law.sense(self.signals)
        self.law.report(self.signals)
        signals = self.signals
        channels = {
            ("joint", "position"): signals.measured_position.clone(),
            ("joint", "velocity"): signals.measured_velocity.clone(),
            ("joint", "current"): signals.measured_current.clone(),
        }
        if self._base is not None:
            free, rates = self._base.qpos, torch.zeros(self.num_sims, 3, dtype=torch.float64)
            quaternion = self._base_quaternion if free is None else self._qpos[:, free + 3 : free + 7]
            if self._base.dof is not None:
                rates = self._qvel[:, self._base.dof + 3 : self._base.dof + 6].clone()
            seen = self.law.sense_trunk(Trunk(quaternion, rates))
            channels[("imu", "orientation")] = roll_pitch_yaw(seen.quaternion)
            channels[("imu", "angular_velocity")] = seen.angular_velocity
        return channels

    def _read(self) -> None:
        self.signals.position = self._qpos[:, self.ports.qpos]
        self.signals.velocity = self._qvel[:, self.ports.dof]
        self.signals.load_torque = -self._sensors[:, self.ports.transmitted]
        if self._reads_force:
            force = self.ports.force
            self.signals.radial_force = torch.hypot(self._sensors[:, force], self._sensors[:, force + 1])

    def _note_failures(self) -> None:
        # MuJoCo resets a diverging state and zeroes NaN controls without an exception; only its warning
        # counters, and non-finite values on our side, tell.
        signals = self.signals
        handed_over = signals.applied_torque + signals.damping + signals.friction_bound
        finite = np.isfinite(handed_over.detach().numpy()).all(1)
        if self.batch.warning.any() or not finite.all():
            self.failed |= torch.from_numpy(self.batch.warning.any((1, 2)) | ~finite)


def _take_over(old: Tensor, new: Tensor, rows: np.ndarray) -> Tensor:
    """Values ``[..., sim, joint]`` with those of some simulations replaced; numbers that all share stay."""
    if old.ndim < 2:
        return old
    kept = old.clone()
    kept[..., rows, :] = new[..., rows, :]
    return kept


def _torch_view(array: np.ndarray) -> Tensor:
    """A tensor over the same memory; outputs of the batch are read-only for numpy and stay unwritten here."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*not writable.*")
        return torch.from_numpy(array)
