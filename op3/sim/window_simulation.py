"""Short simulations around a measured motion: many hypotheses and many windows, without MuJoCo in the loop.

A robot on a stand that is simulated from its measured state for a fifth of a second stays close to the measurement. The
mass matrix and the bias are therefore computed once along the measured motion, and each window solves, per step ``h``
and with the one servo law,

``(M + armature + h D) (w' - w) = h (tau - bias - friction)``,  friction in [-bound, bound], opposing w',

with the bias corrected to first order for the deviation of the window from the measurement. Friction in several coupled
joints is a convex problem (minimise the kinetic distance plus ``h bound |w'|``); it is solved by sweeps over the
joints; each update is exact for its joint and keeps a held joint at exactly zero speed. Sweeps start from the last
acceleration, so a few are enough.
"""

from __future__ import annotations

import copy
import functools
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from op3.servo import RobotModel, Servos
from op3.servo.effects import EncoderNonlinearity, EncoderOffset
from op3.sim.inputs import REFERENCE_TEMPERATURE, expand_parameters, steps_in
from op3.sim.trajectories import TrajectoryDynamics
from op3.sim.window_steps import INPUTS, MOTION, SLOTS, STATE, coupled, simulate

ZERO = EncoderOffset.parameters[0].name
"""The dynamics are differentiated by this parameter if a joint's true angle differs from its reading."""

MISREADING = (EncoderOffset.name, EncoderNonlinearity.name)
"""Effects that cause such a difference."""


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """A measured motion of a fixed-base robot on a uniform grid of ticks.

    Attributes:
        period: time between ticks [s].
        position: estimate of the true joint angles, without noise [rad], ``[tick, joint]``.
        velocity: estimate of the joint velocities [rad/s].
        acceleration: estimate of the joint accelerations [rad/s2].
        read_position: position read by the controller [rad]; NaN if the servo closes the loop on its own sensor.
        read_velocity: velocity read by the controller [rad/s].
        current: motor currents, as far as known [A].
        time: time since the start of the recording [s], ``[tick, 1]``.
        inputs: inputs of the servos, by the name of a signal; held from tick to tick.
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
    """Start of a window.

    Attributes:
        motion: index of the motion.
        tick: first tick of the window.
    """

    motion: int
    tick: int


class WindowSimulation:
    """Simulates windows of measured motions for many parameter sets at once.

    Controllers on the computer receive the measured readings, not the simulated ones, so that they give the commands
    that were sent. Before each window, for `preroll` ticks, the joints are guided along the measured motion, so that
    states with memory (latency, filters, contacts) start from the data.

    Args:
        motions: motions with the same period and joints.
        windows: starts of the windows, with `preroll` ticks before and `ticks` ticks after them.
        joints: joint names, by which the model's per-joint values address the columns.
        timestep: simulation step [s], a divisor of the period.
        preroll: ticks for which the joints are guided.
        dtype: dtype of the results; the simulation is in double precision.

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
        num_threads: int = 1,
        dtype: torch.dtype = torch.float32,
    ):
        if not windows:
            raise ValueError("the logs are too short for a window; record longer logs")
        period = motions[0].period
        self.substeps = steps_in(period, timestep)
        if any(abs(motion.period - period) > 1e-9 for motion in motions):
            raise ValueError("motions of different periods cannot be simulated together")
        if len({motion.supply_resistance for motion in motions}) > 1:
            raise ValueError("motions of different supplies cannot be simulated together")
        for window in windows:
            last = len(motions[window.motion].position) - 1
            if window.tick < preroll or window.tick + ticks > last:
                raise ValueError(f"a window of {ticks} ticks at tick {window.tick} does not fit into {last + 1} ticks")
        self.model = model
        self.joints, self.windows = tuple(joints), list(windows)
        self.ticks, self.preroll, self.period, self.timestep = ticks, preroll, period, timestep
        self.num_threads, self.dtype = num_threads, dtype
        self._supply_resistance = motions[0].supply_resistance
        self._has_voltage = all("bus_voltage" in motion.inputs for motion in motions)
        self._motion = np.concatenate([_packed(motion) for motion in motions])
        first = np.array([window.tick for window in windows]) - preroll
        rows = np.array([window.motion for window in windows])
        self._starts = first + _begins([len(motion.position) for motion in motions])[rows]
        # motions that differ in their inputs alone share what is known of their dynamics
        self._apart = list({id(motion.dynamics): motion for motion in motions}.values())
        places = {id(motion.dynamics): place for place, motion in enumerate(self._apart)}
        begins = _begins([len(motion.position) for motion in self._apart])
        self._dynamics_starts = first + begins[[places[id(motions[row].dynamics)] for row in rows]]
        self._along = _together([motion.dynamics for motion in self._apart])
        self._damping = np.concatenate([motion.dynamics.damping for motion in self._apart])
        self.limbs = coupled(np.concatenate([motion.dynamics.mass for motion in self._apart]))
        self._edits: dict[tuple, np.ndarray] = {}

    def under(self, model: RobotModel) -> WindowSimulation:
        """The same windows with another model and shared data."""
        other = copy.copy(self)
        other.model = model
        return other

    def run(
        self,
        parameters: Mapping[str, Tensor] | None = None,
        candidates: int = 1,
        *,
        position_offset: Tensor | None = None,
        velocity_offset: Tensor | None = None,
    ) -> dict[tuple[str, str], Tensor]:
        """Simulate all windows for every candidate.

        Args:
            parameters: values by name, ``[candidate]`` or ``[candidate, joint]``; all others are the model's.
            position_offset: offset of the initial joint angles [rad], ``[candidate, joint]``.
            velocity_offset: offset of the initial joint velocities [rad/s], ``[candidate, joint]``.

        Returns:
            Position [rad], velocity [rad/s] and current [A] as the sensors read them, by channel,
            ``[candidate, window, tick, joint]``; the first tick is the window's start.
        """
        values = expand_parameters(self.model, self.joints, parameters or {}, candidates)
        law = Servos(self.model.effects, self.joints, candidates, self.timestep, self.period)
        law.set(values)
        edits, weights, misread = self._changes(values, candidates)
        offsets = np.zeros((candidates, 2, len(self.joints)))
        for place, offset in enumerate((position_offset, velocity_offset)):
            if offset is not None:
                offsets[:, place] = offset.numpy()
        if not self._has_voltage:
            self._motion["bus_voltage"] = self.model.bus_voltage
        shape = (candidates * len(self.windows), self.ticks + 1, len(self.joints), 3)
        out = np.empty(shape)

        def share(begin: int, end: int) -> None:
            joints, entries = len(self.joints), self._along.shape[1]
            room = np.zeros(joints, law.kernel.signals)
            simulate(
                begin, end, room, room.view(np.float64), law.past[0].copy(), law.parameters, law.on, self._motion,
                self._along, self._damping, self._starts, self._dynamics_starts, edits, weights, misread, offsets,
                self.limbs, np.empty(entries), np.empty(entries), np.empty(len(edits)), np.empty((2, joints, joints)),
                np.zeros((SLOTS, joints)), self.preroll, self.substeps, self.timestep,
                self._supply_resistance, out,
            )  # fmt: skip

        ends = np.linspace(0, shape[0], min(self.num_threads, shape[0]) + 1).astype(int).tolist()
        if len(ends) == 2:
            share(*ends)
        else:
            list(_pool(len(ends) - 1).map(share, ends[:-1], ends[1:]))
        channels = torch.from_numpy(out).to(self.dtype).view(candidates, len(self.windows), *shape[1:]).unbind(-1)
        names = ("position", "velocity", "current")
        return {("joint", name): channel for name, channel in zip(names, channels, strict=True)}

    def _changes(self, values: Mapping[str, Tensor], candidates: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Edits of bodies that differ from the dynamics along the motions, and where joints may be misread.

        Returns:
            Dynamics per unit ``[edit, row, entry]``, weights ``[candidate, edit]``, and the edit for the encoder offset
            of each joint, ``[joint]``, or -1.
        """
        known, acting = self.model.parameters(), []
        for name, joint in sorted(self._apart[0].changes, key=str):
            if name in values and name != ZERO:
                column = 0 if joint is None else min(joint, values[name].shape[1] - 1)
                weight = values[name][:, column].numpy() - (known[name].neutral or 0.0)
                if weight.any():
                    acting.append(((name, joint), weight))
        misread = np.full(len(self.joints), -1)
        if set(MISREADING) & set(self.model.effect_names):
            for joint in range(len(self.joints)):
                if (ZERO, joint) in self._apart[0].changes:
                    misread[joint] = len(acting)
                    acting.append(((ZERO, joint), np.zeros(candidates)))
        edits = self._stacked(tuple(key for key, _ in acting))
        weights = np.array([weight for _, weight in acting]).reshape(len(acting), candidates).T
        return edits, np.ascontiguousarray(weights), misread

    def _stacked(self, keys: tuple) -> np.ndarray:
        """Dynamics added per unit of some parameters, each as `_along`; the last are kept, which may be large."""
        if keys not in self._edits:
            self._edits.clear()
            stacked = self._edits[keys] = np.empty((len(keys), *self._along.shape))
            for edit, key in enumerate(keys):
                stacked[edit] = _together([motion.changes[key] for motion in self._apart])
        return self._edits[keys]


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Persistent threads: starting them would take a tenth of a run."""
    return ThreadPoolExecutor(threads)


os.register_at_fork(after_in_child=_pool.cache_clear)  # a fork has none of them


def _packed(motion: MeasuredMotion) -> np.ndarray:
    """A motion as the simulation reads it, ``[tick, joint]``."""
    made = np.zeros(motion.position.shape, MOTION)
    for name in STATE:
        made[name] = motion.dynamics.radial_force if name == "radial_force" else getattr(motion, name)
    made["position_target"], made["torque_enable"] = motion.position, 1.0
    made["temperature"] = REFERENCE_TEMPERATURE
    for name in INPUTS:
        if name in motion.inputs:
            made[name] = motion.inputs[name]
    return made


def _begins(lengths: Sequence[int]) -> np.ndarray:
    """Index at which each part begins in their concatenation."""
    return np.cumsum([0, *lengths])[:-1]


def _together(parts: Sequence[TrajectoryDynamics]) -> np.ndarray:
    """Mass, bias and gradient side by side, ``[row, entry]``."""

    def flat(one: TrajectoryDynamics) -> list[np.ndarray]:
        rows = len(one.bias)
        return [one.mass.reshape(rows, -1), one.bias, one.gradient.reshape(rows, -1)]

    return np.concatenate([np.concatenate(flat(part), 1) for part in parts])
