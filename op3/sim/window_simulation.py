"""Short simulations around a measured motion: many hypotheses, many windows, no MuJoCo in the loop.

A robot on a stand that is simulated from its own measured state for a fifth of a second stays close to what was
measured. So the mass matrix and the bias are computed once along the measured motion, and each window solves, per step
``h`` and with the one servo law,

``(M + armature + h D) (w' - w) = h (tau - bias - friction)``,  friction in [-bound, bound], opposing w',

the bias corrected to first order by how far the window has left the measurement. Friction in several coupled joints is
a convex problem (minimise the kinetic distance plus ``h bound |w'|``); it is solved by sweeps over the joints, each
of which is exact for its joint and leaves a held joint at exactly zero speed. Sweeps start from the last acceleration,
so a few are enough.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from op3.servo import RobotModel, ServoLaw, Signals
from op3.servo.effects import Backlash, Compliance, EncoderNonlinearity, EncoderOffset, Motor
from op3.servo.effects.transmission import Transmission
from op3.servo.law import SUPPLY
from op3.sim.inputs import default_commands, expand_parameters, set_start
from op3.sim.joint_step import between, joint_step, pull_back
from op3.sim.trajectory_dynamics import TrajectoryDynamics
from op3.sim.translated import RESULTS, Translated

REST = 0.03
"""Speed below which a measured joint is taken to rest [rad/s]; half of it is the noise of its estimate."""

ROTOR = Motor.edits[0]
"""The one change to the MuJoCo model that is made here: the rotor's inertia on the diagonal."""

ZERO = EncoderOffset.size
"""The parameter by whose unit the change is told where a joint stands elsewhere than its reading says."""

MISREADING = (EncoderOffset.name, EncoderNonlinearity.name)
"""Effects by which joints do."""

LARGEST_KEPT, MOST_KEPT = 2000, 64
"""Rows of a run whose translated law is kept for the next with other parameters, and how many are: to translate it
takes as long as to run a hundred rows."""

SIGNAL_NAMES = tuple(field.name for field in fields(Signals))


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """A measured motion of a fixed-base robot on a uniform grid of ticks.

    Attributes:
        period: time between ticks [s].
        position: estimate of the true joint angles, without noise [rad], ``[tick, joint]``.
        velocity: estimate of the joint velocities [rad/s].
        acceleration: estimate of the joint accelerations [rad/s2].
        read_position: what the controller read [rad].
        read_velocity: what the controller read [rad/s].
        current: in the motors, as far as known [A].
        time: since the start of the recording [s], ``[tick, 1]``.
        inputs: what drives the servos, by the name of a signal of `op3.servo.Signals`; held from tick to tick.
        dynamics: mass matrix and bias along the motion.
        changes: dynamics added per unit of a parameter beyond its neutral value, by parameter name and joint (None for
            a parameter of the whole robot): of what edits bodies, each in an otherwise sound robot, so that products
            of two edits are left out; and of an encoder's zero, by which a joint stands elsewhere than was read.
        supply_resistance: inner resistance by which the bus voltage of the inputs, then that without any current,
            falls with the simulated currents [ohm]; 0: the inputs hold what the servos get.
    """

    period: float
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    read_position: np.ndarray
    read_velocity: np.ndarray
    current: np.ndarray
    time: np.ndarray
    inputs: Mapping[str, np.ndarray]
    dynamics: TrajectoryDynamics
    changes: Mapping[tuple[str, int | None], TrajectoryDynamics]
    supply_resistance: float = 0.0


@dataclass(frozen=True)
class Window:
    """Where a window starts.

    Attributes:
        motion: which motion.
        tick: its first tick.
    """

    motion: int
    tick: int


class WindowSimulation:
    """Simulates windows of measured motions for many parameter sets at once.

    Controllers on the computer receive the measured readings, not the simulated ones: their commands are those that
    were sent. Before each window, for `preroll` ticks, the joints are led along the measured motion, so that
    whatever has memory (latency, filters, contacts) starts from the data.

    Args:
        model: effects and values.
        motions: all with the same period and joints.
        windows: where the windows start; `preroll` ticks must lie before, `ticks` behind.
        ticks: length of every window.
        joints: joint names, by which the model's per-joint values address the columns.
        timestep: of the simulation [s]; must divide the period.
        preroll: ticks for which the joints are led.
        translated: whether the law runs in numpy where it can.
        dtype: of the simulation. Single precision is wrong by a thousandth of an encoder's count after a window.

    Raises:
        ValueError: if a window does not fit into its motion, or periods or supplies differ.
    """

    def __init__(
        self,
        model: RobotModel,
        motions: Sequence[MeasuredMotion],
        windows: Sequence[Window],
        ticks: int,
        joints: Sequence[str],
        *,
        timestep: float = 0.001,
        preroll: int = 4,
        translated: bool = True,
        dtype: torch.dtype = torch.float32,
    ):
        if not windows:
            raise ValueError("there is no window to simulate: the logs are too short")
        period = motions[0].period
        self.substeps = round(period / timestep)
        if self.substeps < 1 or abs(self.substeps * timestep - period) > 1e-9:
            raise ValueError(f"the time step {timestep} s must divide the period {period} s")
        if any(abs(motion.period - period) > 1e-9 for motion in motions):
            raise ValueError("motions of different periods cannot be simulated together")
        if len({motion.supply_resistance for motion in motions}) > 1:
            raise ValueError("motions of different supplies cannot be simulated together")
        for window in windows:
            last = len(motions[window.motion].position) - 1
            if window.tick < preroll or window.tick + ticks > last:
                raise ValueError(f"a window of {ticks} ticks at tick {window.tick} does not fit into {last + 1} ticks")
        self.model = model
        self.joints = tuple(joints)
        self.ticks, self.preroll, self.period, self.timestep, self.dtype = ticks, preroll, period, timestep, dtype
        self.translated = translated
        self.windows = list(windows)
        self._motions = list(motions)
        rows = np.array([window.motion for window in windows])
        first = np.array([window.tick for window in windows]) - preroll
        self._at = first[None] + np.arange(preroll + ticks + 1)[:, None]  # [tick, window]
        self._rows = rows
        self.law = ServoLaw(model.effects, timestep, period, self.joints)
        dynamics = [motion.dynamics for motion in motions]
        mass = self._gather([d.mass for d in dynamics])
        self.along = Along(
            _by_entry(mass),
            self._gather([d.bias for d in dynamics]),
            _by_entry(self._gather([d.gradient for d in dynamics])),
        )
        self._damping = self._gather([d.damping for d in dynamics])
        self._force = self._gather([d.radial_force for d in dynamics])
        self._position = self._gather([m.position for m in motions])
        self._velocity = self._gather([m.velocity for m in motions])
        self._acceleration = self._gather([m.acceleration for m in motions])
        self._read_position = self._gather([m.read_position for m in motions])
        self._read_velocity = self._gather([m.read_velocity for m in motions])
        self._current = self._gather([m.current for m in motions])[0]
        self._time = np.broadcast_to(self._gather([m.time for m in motions])[0], self._current.shape)
        common = set.intersection(*(set(motion.inputs) for motion in motions)) & set(SIGNAL_NAMES)
        self._inputs = {name: self._gather([m.inputs[name] for m in motions]) for name in sorted(common)}
        self.limbs = np.array([(limb.start, limb.stop) for limb in coupled(mass)])
        self._changes: dict[tuple[str, int | None], Along] = {}
        self.translations: dict[Any, tuple[Translated, tuple[np.ndarray, ...]]] = {}

    def under(self, model: RobotModel) -> "WindowSimulation":
        """The same windows under another model; what was gathered is shared."""
        other = copy.copy(self)
        other.model = model
        other.law = ServoLaw(model.effects, self.timestep, self.period, self.joints)
        return other

    def _gather(self, arrays: Sequence[np.ndarray]) -> np.ndarray:
        """Rows of the windows, ``[tick, joint, ..., window]``."""
        flat = np.concatenate(arrays)
        start = np.cumsum([0, *(len(array) for array in arrays)])[:-1]
        picked = flat[start[self._rows][None] + self._at]  # [tick, window, joint, ...]
        return np.ascontiguousarray(np.moveaxis(picked, 1, -1), dtype=torch.empty(0, dtype=self.dtype).numpy().dtype)

    @torch.inference_mode()
    def run(
        self,
        parameters: Mapping[str, Tensor] | None = None,
        candidates: int = 1,
        *,
        position_offset: Tensor | None = None,
        velocity_offset: Tensor | None = None,
        chunk: int = 6000,
    ) -> dict[tuple[str, str], Tensor]:
        """Simulate all windows for every candidate.

        Args:
            parameters: by name, ``[candidate]`` or ``[candidate, joint]``; those not named are the model's.
            candidates: number of parameter sets.
            position_offset: added to the initial joint angles [rad], ``[candidate, joint]``.
            velocity_offset: added to the initial joint velocities [rad/s], ``[candidate, joint]``.
            chunk: rows (candidates times windows) simulated at a time.

        Returns:
            Position [rad], velocity [rad/s] and current [A] as the sensors read them, by channel,
            ``[candidate, window, tick, joint]``; the first tick is the window's start.
        """
        values = expand_parameters(self.model, self.joints, parameters or {}, candidates)
        values = {name: value.to(self.dtype) for name, value in values.items()}
        none = torch.zeros(candidates, len(self.joints))
        offsets = (
            (none if position_offset is None else position_offset).to(self.dtype),
            (none if velocity_offset is None else velocity_offset).to(self.dtype),
        )
        size = max(1, chunk // len(self.windows))
        parts = []
        for begin in range(0, candidates, size):
            piece = slice(begin, min(begin + size, candidates))
            parts.append(
                self._run(
                    {name: value[piece] for name, value in values.items()},
                    piece.stop - begin,
                    offsets[0][piece],
                    offsets[1][piece],
                )
            )
        return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}

    def _run(self, values, candidates, position_offset, velocity_offset) -> dict[tuple[str, str], Tensor]:
        run = _Run(self, values, candidates)
        for tick in range(self.preroll):
            run.lead(tick)
        run.start(self.preroll, position_offset, velocity_offset)
        samples = [run.measure()]
        for tick in range(self.preroll, self.preroll + self.ticks):
            run.advance(tick)
            samples.append(run.measure())
        return {
            # [tick, joint, candidate, window] to [candidate, window, tick, joint]
            key: torch.stack([sample[key] for sample in samples]).permute(2, 3, 0, 1)
            for key in samples[0]
        }

    def changes(self, values: Mapping[str, Tensor]) -> list["Change"]:
        """Edits of bodies that differ from the dynamics along the motions under these parameters."""
        result = []
        known = self.model.parameters()
        for name, joint in sorted(self._motions[0].changes, key=str):
            if name not in values or name == ZERO:
                continue
            column = 0 if joint is None else min(joint, values[name].shape[1] - 1)
            weight = values[name][:, column, None] - (known[name].neutral or 0.0)
            if not (weight == 0).all():
                result.append(self.change(name, joint, weight))
        return result

    def change(self, name: str, joint: int | None, weight: Tensor) -> "Change":
        """Dynamics added, at a weight ``[candidate, 1 | window]``."""
        key = (name, joint)
        if key not in self._changes:
            parts = [motion.changes[key] for motion in self._motions]
            self._changes[key] = Along(
                _by_entry(self._gather([p.mass for p in parts])),
                self._gather([p.bias for p in parts]),
                _by_entry(self._gather([p.gradient for p in parts])),
            )
        return Change(weight.expand(-1, len(self.windows)).numpy(), self._changes[key])

    def misread(self, shift: Tensor) -> tuple[list["Change"], np.ndarray]:
        """Dynamics added because joints stand elsewhere than they were read, and how far that is accounted for.

        Args:
            shift: true angle less reading, ``[joint, candidate, window]``.
        """
        accounted, result = torch.zeros_like(shift), []
        for joint in range(len(shift)):
            if (ZERO, joint) in self._motions[0].changes and bool(shift[joint].any()):
                result.append(self.change(ZERO, joint, -shift[joint]))
                accounted[joint] = shift[joint]
        return result, accounted.numpy()


class Along(NamedTuple):
    """Dynamics along the windows: mass, bias and gradient, ``[tick, entry, window]``, entries row by row."""

    mass: np.ndarray
    bias: np.ndarray
    gradient: np.ndarray


class Change(NamedTuple):
    """Dynamics added: a weight ``[candidate, window]`` times those per unit of a parameter."""

    weight: np.ndarray
    unit: Along


def _by_entry(matrix: np.ndarray) -> np.ndarray:
    """``[tick, joint, joint, window]`` as ``[tick, entry, window]``."""
    return matrix.reshape(len(matrix), -1, matrix.shape[-1])


def coupled(mass: np.ndarray) -> list[slice]:
    """Runs of neighbouring joints that no mass couples to the others; `mass` is ``[tick, joint, joint, window]``."""
    linked = np.abs(mass).max((0, 3)) > 1e-12
    limbs, first = [], 0
    for joint in range(1, len(linked) + 1):
        if joint == len(linked) or not linked[:joint, joint:].any():
            limbs.append(slice(first, joint))
            first = joint
    return limbs


class _Run:
    """One chunk of candidates; arrays are ``[joint, candidate, window]``, the law sees them as ``[sim, joint]``.

    Position, velocity and load are arrays that the law's translation reads where they are.
    """

    def __init__(self, owner: WindowSimulation, values: Mapping[str, Tensor], candidates: int):
        self.o = owner
        self.count, self.candidates, self.num = len(owner.joints), candidates, len(owner.windows)
        self.law = owner.law
        self.law.set_parameters({name: self._per_row(value) for name, value in values.items()})
        armature = values.get(ROTOR.parameter, torch.zeros(candidates, 1, dtype=owner.dtype))
        self.armature = armature.expand(candidates, self.count).T[:, :, None].contiguous().numpy()
        # what a gear has behind its play or its spring is a load to its teeth as the link is
        soft = ROTOR.parameter in values and (Backlash.size in values or Compliance.size in values)
        behind = Transmission.behind(values) if soft else torch.zeros(1, 1)
        self.behind = behind.to(owner.dtype).expand(candidates, self.count).T[:, :, None].numpy()
        changes = owner.changes(values)
        self.signals = Signals.zeros(candidates * self.num, self.count, dtype=owner.dtype)
        self.q, self.v = self._block(owner._position[0]).copy(), self._block(owner._velocity[0]).copy()
        self.u, self.load = np.zeros_like(self.v), np.zeros_like(self.v)
        self._expose()
        default_commands(self.signals, owner.model)
        self._inputs(0)
        shift = self._undo_sensing()
        misread, self.accounted = owner.misread(shift)
        self.shift = shift.numpy()
        self._edit([*changes, *misread])
        self._translate, self._translated = owner.translated, None
        self._lead_state(0, 0)
        set_start(self.signals, None, self._spread(owner._current), self._spread(owner._time))
        self.law.reset(self.signals)
        supply = owner._motions[0].supply_resistance
        if supply > 0.0:
            self.signals.state[SUPPLY] = torch.full((candidates * self.num, 1), supply, dtype=owner.dtype)
        self._phase_zero = torch.zeros(1, dtype=torch.int64)

    def _per_row(self, value: Tensor) -> Tensor:
        """``[candidate, joint]`` to ``[sim, joint]``, stored joint first."""
        return value.T[:, :, None].expand(value.shape[1], self.candidates, self.num).reshape(value.shape[1], -1).T

    def _block(self, value: np.ndarray) -> np.ndarray:
        """``[joint | 1, window]`` to ``[joint, candidate, window]``."""
        return np.broadcast_to(value[:, None, :], (self.count, self.candidates, self.num))

    def _spread(self, value: np.ndarray) -> Tensor:
        """``[joint | 1, window]`` as the law sees it, ``[sim, joint]``."""
        return self._rows(self._block(value).copy())

    def _rows(self, block: np.ndarray) -> Tensor:
        """The same memory as the law sees it, ``[sim, joint]``."""
        return torch.from_numpy(block.reshape(self.count, -1).T)

    def _expose(self) -> None:
        self.signals.position, self.signals.velocity = self._rows(self.q), self._rows(self.v)

    def _inputs(self, tick: int) -> None:
        for name, value in self.o._inputs.items():
            setattr(self.signals, name, self._spread(value[tick]))

    def _undo_sensing(self) -> Tensor:
        """How much the true angle differs from its reading, ``[joint, candidate, window]``."""
        reading = self.signals.position
        for _ in range(3):
            self.law.sense(self.signals)
            self.signals.position = self.signals.position + reading - self.signals.measured_position
        return (self.signals.position - reading).T.reshape(self.q.shape)

    def _edit(self, changes: Sequence[Change]) -> None:
        """Take edits of bodies into account."""
        self._changes = changes
        self._weights = np.zeros((len(changes), self.candidates, self.num), self.q.dtype)
        for weight, change in zip(self._weights, changes, strict=True):
            weight[:] = change.weight
        # by tick and kind of dynamics, where in memory an edit begins
        self._begin = [np.array([one.unit[k].ctypes.data for one in changes], np.int64) for k in range(3)]
        self._apart = [array[0].nbytes for array in self.o.along]
        rows = self.candidates if changes else 1
        self._mixed = [np.empty((array.shape[1], rows, self.num), array.dtype) for array in self.o.along]

    def _dynamics(self, kind: int, tick: int, share: float) -> np.ndarray:
        """Mass (0), bias (1) or gradient (2) between two ticks, ``[joint, (joint,) 1 | candidate, window]``."""
        along, out = self.o.along[kind], self._mixed[kind]
        between(along[tick], along[tick + 1], share, self._weights, self._begin[kind] + tick * self._apart[kind], out)
        return out if kind == 1 else out.reshape(self.count, self.count, *out.shape[1:])

    def _tick(self, tick: int) -> None:
        """A control period begins: the controller gets the readings of the log."""
        self._inputs(tick)
        self.law.tick(
            self.signals,
            readings=(self._spread(self.o._read_position[tick]), self._spread(self.o._read_velocity[tick])),
        )

    def _lead_state(self, tick: int, phase: int) -> None:
        """State and load of the measured motion."""
        o, share = self.o, phase / self.o.substeps
        q, v, a = (
            (here[tick] + share * (here[tick + 1] - here[tick]))[:, None]
            for here in (o._position, o._velocity, o._acceleration)
        )
        self._release()
        self.q[...] = q + self.shift
        self.v[...] = v
        mass, bias = self._dynamics(0, tick, share), self._dynamics(1, tick, share)
        self.load[...] = -((mass * a).sum(1) + bias + self.behind * a)
        self.signals.radial_force = self._spread(o._force[tick])

    def _release(self) -> None:
        """Arrays that are about to be filled; until a translation reads them, memory may still refer to the last."""
        if self._translated is None:
            self.q, self.v, self.load = self.q.copy(), self.v.copy(), self.load.copy()
            self._expose()
            self.signals.load_torque = self._rows(self.load)

    def lead(self, tick: int) -> None:
        """One control period along the measured motion: only the law's memory moves."""
        self._lead_state(tick, 0)
        self._tick(tick)
        for phase in range(self.o.substeps):
            self._lead_state(tick, phase)
            self._law_step(phase)

    def _law_step(self, phase: int) -> None:
        """A step of the law, in numpy where that can be."""
        signals = self.signals
        if phase > 0:
            self.law.sense(signals)
        if phase == 0:
            signals.phase = self._phase_zero
        if self._translate and self._translated is None:
            self._translated = self._translation()
            self._translate = self._translated is not None
        if self._translated is not None:
            self._translated.advance(signals)
            return
        signals.phase = phase
        self.law.act(signals)

    def _translation(self) -> Translated | None:
        """The law's step in numpy: that of an earlier run of as many candidates with these parameters, or a new one."""
        translations, parameters = self.o.translations, self.law.prepared()
        key = (repr(self.law.effects), self.q.shape)
        known = translations.pop(key, None)
        if known is not None and known[0].renew(parameters):
            translations[key] = known  # the last one used goes last
            for mine, kept in zip((self.q, self.v, self.load), known[1], strict=True):
                kept[...] = mine
            self.q, self.v, self.load = known[1]
            self._expose()
            self.signals.load_torque = self._rows(self.load)
            return known[0]
        own = {"position": self.q, "velocity": self.v, "load_torque": self.load}
        live = {name: array.reshape(self.count, -1).T for name, array in own.items()}
        if self.q[0].size > LARGEST_KEPT:
            return Translated.of(self.law.act, self.signals, RESULTS, live)
        made = Translated.of(self.law.act, self.signals, RESULTS, live, parameters)
        if made is not None:
            translations[key] = made, tuple(own.values())
            while len(translations) > MOST_KEPT:
                del translations[next(iter(translations))]
        return made

    def start(self, tick: int, position_offset: Tensor, velocity_offset: Tensor) -> None:
        """Let go at this tick, with offsets ``[candidate, joint]``; what rests is in balance."""
        self._lead_state(tick, 0)
        self._balance(tick)
        self._release()
        self.q += position_offset.T[:, :, None].numpy()
        self.v += velocity_offset.T[:, :, None].numpy()
        self.u[...] = (self.o._acceleration[tick] * self.o.timestep)[:, None]

    def _balance(self, tick: int) -> None:
        """Let the law's elastic elements carry what the measured motion asks for."""
        o = self.o
        rests = np.abs(o._velocity[tick]) < REST
        mass, bias = self._dynamics(0, tick, 0.0), self._dynamics(1, tick, 0.0)
        acceleration = np.where(rests, 0.0, o._acceleration[tick]).astype(self.q.dtype)[:, None]
        needed = (mass * acceleration).sum(1) + bias + self.behind * acceleration
        applied = self.signals.applied_torque.numpy().T.reshape(self.q.shape)
        self.law.balance(self.signals, self._rows(applied - needed), self._spread(rests))

    def advance(self, tick: int) -> None:
        """One control period of simulation."""
        self._tick(tick)
        self.signals.radial_force = self._spread(self.o._force[tick])
        pull = self._pull(tick)
        for phase in range(self.o.substeps):
            self._step(tick, phase, pull)

    def _pull(self, tick: int) -> np.ndarray:
        """How the bias changes, to first order, where the window has left the measurement; kept for a tick."""
        o, out = self.o, np.empty_like(self.q)
        pull_back(
            self._dynamics(2, tick, 0.0),
            o._damping[tick],
            self.q,
            self.v,
            o._position[tick],
            o._velocity[tick],
            self.accounted,
            o.limbs,
            out,
        )
        return out

    def _step(self, tick: int, phase: int, pull: np.ndarray) -> None:
        o, signals = self.o, self.signals
        self._law_step(phase)
        self._release()
        share = (phase + 0.5) / o.substeps  # in the middle of the step
        torques = (signals.damping, signals.applied_torque, signals.friction_bound)
        joint_step(
            self._dynamics(0, tick, share),
            self._dynamics(1, tick, share),
            pull,
            self.armature,
            *(np.ascontiguousarray(torque.numpy().T).reshape(self.q.shape) for torque in torques),
            self.q,
            self.v,
            self.u,
            self.load,
            o.timestep,
            o.limbs,
        )

    def measure(self) -> dict[tuple[str, str], Tensor]:
        """What the sensors say, ``[joint, candidate, window]``."""
        self.law.sense(self.signals)
        self.law.report(self.signals)
        shape = self.q.shape
        return {
            ("joint", "position"): self.signals.measured_position.T.reshape(shape).clone(),
            ("joint", "velocity"): self.signals.measured_velocity.T.reshape(shape).clone(),
            ("joint", "current"): self.signals.measured_current.T.reshape(shape).clone(),
        }
