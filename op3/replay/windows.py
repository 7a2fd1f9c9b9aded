"""Windows of logs: a model's prediction from the measured state and the commands of the log, minus the measurement.

Windows start from the smoothed measured state and are driven by the commands of the log. The dynamics are computed once
along the measured motion, with the contributions of changed bodies or encoder offsets.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

import numpy as np
from torch import Tensor

from op3.replay.smoothing import CHANNELS, PREROLL, SmoothLog, half_width, smooth_all
from op3.replay.supply import open_voltages
from op3.rollout import LogError, Rollout
from op3.servo import RobotModel
from op3.servo.conditions import split_name
from op3.servo.effects import CurrentPD, Motor
from op3.sim import MeasuredMotion, TrajectoryDynamics, Window, WindowSimulation
from op3.sim.crew import processors
from op3.sim.edits import ROTOR
from op3.sim.held_base import FixedBase, PendulumBase, fixed_base
from op3.sim.window_simulation import MISREADING, ZERO

LENGTHS = {"stand": 0.2, "pendulum": 0.8}
"""Length of a window by mount [s]. A limb soon diverges from the measurement. A bench's arm does not, but
is light: in 0.2 s its sensors resolve its torque to 1.4 to 1.9 % (STS3032, XL330), those of a robot to 0.1 to 0.5 %."""

HELD = tuple(LENGTHS)
"""Mounts that hold the base."""

FEWEST_TICKS = 4
"""Number of readings in a window: one per piece."""

STEP = 0.001
"""Longest unstretched simulation step [s]; a tick is a whole number of steps."""

SEARCH = 0.192
"""Interval within which a window starts at the best known state [s], not in the middle of a jerk."""

ZERO_STEP = 0.02
"""Finite-difference step of the dynamics for a wrong zero of an encoder [rad]."""

Base = FixedBase | PendulumBase


class WindowResiduals:
    """Windows of logs, and the errors of any model on them.

    Args:
        logs: logs of one mount that holds the base, with the same joints.
        windows: number of windows.
        length: length of a window [s]; by default set by the mount.
        closed: whether the computer's controller acts on the simulated readings; otherwise it sends the commands of the
            log.

    Raises:
        LogError: if logs differ in joints or mount, or the base is free.

    Attributes:
        windows: log and tick at which each begins.
        measured: measured channels, ``[window, tick, joint, channel]``.
        known: which readings are compared, ``[joint, channel]``: recorded and not excluded by the checks; the angle
            rate of a bench is not an independent reading.
        motion: of all windows' ticks in sequence, each with its lead.
    """

    def __init__(
        self, logs: Sequence[Rollout], *, windows: int = 72, length: float | None = None, closed: bool = False
    ):
        first = logs[0]
        for log in logs:
            alike = (log.metadata.mount, log.joints) == (first.metadata.mount, first.joints)
            if log.metadata.mount not in HELD or not alike:
                raise LogError(
                    "windows need logs of one set of joints on the stand, or of a bench",
                    "diagnose logs of one mount and one set of joints at a time",
                    source=log.metadata.recording,
                    column="joints",
                )
        self.joints = first.joints
        self.smooth_logs = smoothed = smooth_all(logs)
        self.period = smoothed[0].period
        length, self.closed = length or LENGTHS[str(first.metadata.mount)], closed
        self.ticks = round(length / self.period)
        if self.ticks < FEWEST_TICKS:
            raise LogError(
                f"{self.ticks} readings in {self.ticks * self.period:.2g} s are too few for a window",
                f"record {FEWEST_TICKS} or more in {length:g} s",
                source=first.metadata.recording,
                column="time",
            )
        self.timestep = self.period / np.ceil(self.period / STEP - 1e-6)
        self._begin(_choose(smoothed, windows, self.ticks))

    def _begin(self, windows: list[tuple[int, int]]) -> None:
        self.windows = windows
        self._stack(self.smooth_logs)
        self.measured = np.stack([self._readings(key) for key in CHANNELS], -1)

    def thinned(self, count: int) -> "WindowResiduals":
        """Evenly selected windows."""
        other = copy.copy(self)
        other._begin([self.windows[i] for i in np.linspace(0, len(self.windows) - 1, count).round().astype(int)])
        return other

    @property
    def lengths(self) -> list[float]:
        """Arm lengths of a bench [m]; empty for a robot."""
        told = [log.log.metadata for log in self.smooth_logs]
        return [float(one.length) for one in told if one.mount == "pendulum" and one.length]

    @property
    def mirror(self) -> dict[str, tuple[str, int]]:
        """Partners of joints on the other side, if the robot's file names them, and the sign of their angles."""
        robot = self.smooth_logs[0].log.robot
        return robot.mirror if robot.partners else {}

    def _readings(self, key: tuple[str, str]) -> np.ndarray:
        """A channel in all windows, zero where it was not recorded, ``[window, tick, joint]``."""
        if any(key not in log.readings for log in self.smooth_logs):
            return np.zeros((len(self.windows), self.ticks + 1, len(self.joints)))
        return np.stack([self.smooth_logs[i].readings[key][t : t + self.ticks + 1] for i, t in self.windows])

    def _stack(self, logs: Sequence[SmoothLog]) -> None:
        """One long motion of all windows' ticks, each with its lead."""
        bench = logs[0].log.metadata.mount == "pendulum"
        silent = np.zeros(len(self.joints), bool)
        told = [[log.log.measured(key) if key in log.readings else silent for log in logs] for key in CHANNELS]
        self.known = np.stack([np.all(one, 0) for one in told], -1)
        self.known[:, CHANNELS.index(("joint", "velocity"))] &= not bench
        spans = [(logs[i], slice(t - PREROLL, t + self.ticks + 1)) for i, t in self.windows]
        rows = PREROLL + self.ticks + 1

        def stacked(get) -> np.ndarray:
            return np.concatenate([get(log)[span] for log, span in spans])

        self._position, self._velocity = stacked(lambda log: log.position), stacked(lambda log: log.velocity)
        common = set.intersection(*(set(log.inputs) for log in logs))
        inputs = {name: stacked(lambda log, n=name: log.inputs[n]) for name in sorted(common)}
        supply, self.measured_voltage = 0.0, inputs.get("bus_voltage")
        if "bus_voltage" in common and all(("joint", "current") in log.readings for log in logs):
            supply, opened = open_voltages(logs)
            by_log = {id(log): voltage for log, voltage in zip(logs, opened, strict=True)}
            inputs["bus_voltage"] = stacked(lambda log: by_log[id(log)])
        bases = [_base(log, self.joints) for log, _ in spans]
        begins = _begins(logs)
        self._mounts: list[tuple[SmoothLog, np.ndarray]] = []
        for base in dict.fromkeys(bases):
            mine = [k for k, own in enumerate(bases) if own == base]
            at = np.concatenate([np.arange(k * rows, (k + 1) * rows) for k in mine])
            self._mounts.append((spans[mine[0]][0], at))
        sways = all(log.sway is not None for log in logs)
        self.sway = stacked(lambda log: log.sway) if sways else np.zeros((len(self._position), 2, 3))
        q, v = (stacked(lambda log, k=k: log.control[k] * (np.nan if self.closed else 1.0)) for k in (0, 1))
        self.motion = MeasuredMotion(
            self.period,
            self._position,
            self._velocity,
            stacked(lambda log: log.acceleration),
            q,
            v,
            stacked(lambda log: log.readings.get(("joint", "current"), np.zeros_like(log.position))),
            np.concatenate([begins[id(log)] + log.time[span, None] for log, span in spans]),
            inputs,
            self._dynamics(),
            {},
            supply,
        )
        self._starts = [Window(0, k * rows + PREROLL) for k in range(len(self.windows))]
        self.forget()

    def forget(self) -> None:
        """Free cached data of simulations: the dynamics of edited bodies take a megabyte per joint."""
        self._edits: dict[tuple[str, int | None], TrajectoryDynamics | None] = {}
        self._changes: dict[tuple[str, int | None], TrajectoryDynamics] = {}
        self._simulations: dict[tuple[float, bool], WindowSimulation] = {}
        self._unchanged: dict[Base, TrajectoryDynamics] = {}

    def part(self, columns: Sequence[int] | np.ndarray) -> "WindowResiduals":
        """The windows with only the joints of one limb, because limbs are not coupled with a held base. If the bus
        voltage falls with the currents, other joints draw their measured currents.
        """
        at, whole, other = list(columns), self.motion, copy.copy(self)
        beside = np.abs(whole.current).sum(1) - np.abs(whole.current[:, at]).sum(1)
        inputs = {name: value[:, at] for name, value in whole.inputs.items()}
        if whole.supply_resistance:
            inputs["bus_voltage"] = inputs["bus_voltage"] - whole.supply_resistance * beside[:, None]
        along = whole.dynamics
        square = {name: getattr(along, name)[:, at][:, :, at] for name in ("mass", "gradient", "damping")}
        rows = {name: getattr(along, name)[:, at] for name in ("bias", "radial_force", "carried")}
        dynamics = TrajectoryDynamics(**rows, **square)
        states = ("position", "velocity", "acceleration", "read_position", "read_velocity", "current")
        sliced = {name: getattr(whole, name)[:, at] for name in states}
        other.motion = replace(whole, inputs=inputs, dynamics=dynamics, **sliced)
        other._position, other._velocity = other.motion.position, other.motion.velocity
        other.joints, other.measured = tuple(self.joints[j] for j in at), self.measured[:, :, at]
        other.known = self.known[at]
        other.measured_voltage = None if self.measured_voltage is None else self.measured_voltage[:, at]
        other.forget()
        return other

    @property
    def _held(self) -> list[tuple[Base, np.ndarray]]:
        """The bases that hold the joints, and the rows to which each applies."""
        return [(_base(log, self.joints), at) for log, at in self._mounts]

    def _dynamics(self) -> TrajectoryDynamics:
        q, v = self._position, self._velocity
        parts = [(at, base.dynamics(q[at], v[at], radial_force=True)) for base, at in self._held]
        return self._swaying(_merged(parts, len(q)))

    def _swaying(self, still: TrajectoryDynamics) -> TrajectoryDynamics:
        """Dynamics along the motion on a resting stand, and on a stand that sways as the gyro measured."""
        return replace(still, bias=still.bias + np.einsum("tjk,tk->tj", still.carried, self.sway[:, 0]))

    def _change(self, model: RobotModel, name: str, joint: int | None, amount: float) -> TrajectoryDynamics | None:
        """Dynamics added per unit of a parameter that edits bodies; None if it has no effect here."""
        key = (name, joint)
        if key not in self._edits:
            bodies = [base.changed(model, name, joint, amount) for base, _ in self._held]
            nothing = any(one is None for one in bodies)
            self._edits[key] = None if nothing else self._added(bodies, self._position, amount)
        return self._edits[key]

    def _elsewhere(self, joint: int) -> TrajectoryDynamics:
        """Dynamics added per unit of an encoder's zero error, because the joint differs from its reading."""
        position = self._position.copy()
        position[:, joint] -= ZERO_STEP
        return self._added([base.mj_model for base, _ in self._held], position, ZERO_STEP)

    def _added(self, bodies: Sequence[Any], position: np.ndarray, amount: float) -> TrajectoryDynamics:
        """Contribution of changed bodies, by base, or changed angles to a sound robot's mass and bias, per unit."""
        parts = []
        for (base, at), edited in zip(self._held, bodies, strict=True):
            if base not in self._unchanged:
                self._unchanged[base] = base.along(base.mj_model, self._position[at], self._velocity[at])
            here = base.along(edited, position[at], self._velocity[at])
            parts.append((at, _difference(here, self._unchanged[base], amount)))
        return self._swaying(_merged(parts, len(self._position)))

    def simulation(
        self, model: RobotModel, stretch: int = 1, parameters: Mapping[str, Tensor] | None = None
    ) -> WindowSimulation:
        """A simulation of the windows with a model, in steps that are longer by up to this factor if the model allows.

        It includes the body edits of these parameters or otherwise of the model.
        """
        values = model.tensors(self.joints) | dict(parameters or {})
        for effect in model.effects:
            for edit in effect.edits:
                known = model.parameters()[edit.parameter]
                if edit == ROTOR or edit.target == "base_body":
                    continue  # the rotor is on the diagonal; the weight of a held base has no influence
                amount, neutral = 0.25 * (known.high - known.low), known.neutral or 0.0
                there = (values[edit.parameter] != neutral).any(0).expand(len(self.joints)).numpy()
                for joint in np.flatnonzero(there).tolist() if known.per_joint else (None,):
                    change = self._change(model, edit.parameter, joint, amount)
                    if change is not None:
                        self._changes[edit.parameter, joint] = change
        if set(MISREADING) & set(model.effect_names):
            for joint in range(len(self.joints)):
                if (ZERO, joint) not in self._changes:
                    self._changes[ZERO, joint] = self._elsewhere(joint)
        # the law lets the bus fall where the driver regulates current; others get what was measured
        regulated = all(e.drive == "current" for e in model.effects if isinstance(e, Motor))
        supplied = regulated or not self.motion.supply_resistance
        substeps = round(self.period / self.timestep)
        fitting = [k for k in range(1, stretch + 1) if substeps % k == 0]
        timestep = self.timestep * (1 if model.stiff else fitting[-1])
        key = (timestep, supplied)
        if key not in self._simulations:
            given: dict[str, Any] = {**vars(self.motion), "changes": self._changes}
            if not supplied:
                given["inputs"] = {**given["inputs"], "bus_voltage": self.measured_voltage}
                given["supply_resistance"] = 0.0
            options = {"timestep": timestep, "preroll": PREROLL, "num_threads": processors()}
            motion = MeasuredMotion(**given)
            self._simulations[key] = WindowSimulation(
                self._as_sent(model), [motion], self._starts, self.ticks, self.joints, **options
            )
        return self._simulations[key].under(self._as_sent(model))

    def errors(
        self,
        model: RobotModel,
        parameters: Mapping[str, Tensor] | None = None,
        candidates: int = 1,
        *,
        stretch: int = 1,
        position_offset: Tensor | None = None,
        velocity_offset: Tensor | None = None,
    ) -> np.ndarray:
        """Simulated minus measured, ``[candidate, window, tick, joint, channel]``; large for diverged simulations."""
        model, whole = _within(model, self.joints), None
        for told, mine in self._setups(parameters or {}):
            given = _held_by(parameters or {}, told)
            simulation = self.simulation(model.under(told) if told else model, stretch, given)
            offsets = {"position_offset": position_offset, "velocity_offset": velocity_offset}
            channels = simulation.run(given, candidates, **offsets)
            simulated = np.stack([channels[key].numpy() for key in CHANNELS], -1)
            whole = np.empty_like(simulated) if whole is None else whole
            whole[:, mine] = simulated[:, mine] - self.measured[None, mine]
        assert whole is not None
        return np.nan_to_num(whole, copy=False, nan=1e3, posinf=1e3, neginf=-1e3)

    def _as_sent(self, model: RobotModel) -> RobotModel:
        """The model with commands rounded to the servos' registers, because the log has the computed commands."""
        makes = self.smooth_logs[0].log.servos
        units = [make.counts.current.si for make in makes if make is not None and make.counts.current is not None]
        step = min(units, default=0.0)
        sent = [replace(e, resolution=step) if isinstance(e, CurrentPD) else e for e in model.effects]  # type: ignore[type-var]
        return replace(model, effects=tuple(sent))

    def _setups(self, parameters: Mapping[str, Tensor]) -> list[tuple[dict[str, Any], np.ndarray]]:
        """Metadata on which conditional parameters depend, and the windows that have them."""
        conditions = [condition for name in parameters if (condition := split_name(name)[1]) is not None]
        fields = sorted({condition.field for condition in conditions})
        told = [tuple(getattr(self.smooth_logs[i].log.metadata, f) for f in fields) for i, _ in self.windows]
        mine = {key: np.array([k for k, own in enumerate(told) if own == key]) for key in dict.fromkeys(told)}
        return [(dict(zip(fields, key, strict=True)), at) for key, at in mine.items()]

    def by_window(self, values: np.ndarray, end: bool = False) -> np.ndarray:
        """Values along the motion of all windows, ``[row, ...]``, as ``[window, tick, ...]`` without the leads, and
        optionally with the tick at which a window ends."""
        windows = values.reshape(len(self.windows), PREROLL + self.ticks + 1, *values.shape[1:])
        return windows[:, PREROLL : None if end else -1]


def _held_by(parameters: Mapping[str, Tensor], told: Mapping[str, Any]) -> dict[str, Tensor]:
    """Parameters for a set-up, where values whose condition holds replace shared values."""
    split = {name: split_name(name) for name in parameters}
    shared = {name: value for name, value in parameters.items() if split[name][1] is None}
    holding = {name: base for name, (base, condition) in split.items() if condition and condition.holds(told)}
    return shared | {base: parameters[name] for name, base in holding.items()}


def _within(model: RobotModel, joints: Sequence[str]) -> RobotModel:
    """The model without values of other joints."""

    def of(values: Mapping[str, Any]) -> dict[str, Any]:
        return {joint: value for joint, value in values.items() if joint in joints}

    kept = {n: replace(one, joints=of(one.joints), intervals=of(one.intervals)) for n, one in model.estimates.items()}
    return replace(model, estimates=kept)


def _choose(logs: Sequence[SmoothLog], count: int, ticks: int) -> list[tuple[int, int]]:
    """Evenly spaced starts (log, tick) of windows at smooth states, without overlap if there is room."""
    half = half_width(logs[0].period) if logs else 0
    lead, tail = max(PREROLL, half), ticks + half + 1
    room = np.array([max(0, len(log.time) - lead - tail) for log in logs])
    if room.sum() == 0:
        raise LogError("the logs are shorter than a window", "record a few seconds per run", column="time")
    total = int(room.sum())
    stride = max(total / count, ticks / 2)
    starts, edges = [], np.cumsum([0, *room])
    aside = int(0.5 * max(0.0, min(stride - ticks, SEARCH / logs[0].period)))
    for at in np.arange(stride / 2, total, stride):
        log = int(np.searchsorted(edges, at, side="right") - 1)
        tick = lead + int(at - edges[log])
        first, last = max(lead, tick - aside), min(lead + int(room[log]), tick + aside + 1)
        starts.append((log, first + int(logs[log].rough[first:last].argmin())))
    return starts


def _begins(logs: Sequence[SmoothLog]) -> dict[int, float]:
    """Start time of each log relative to the first [s], by `id`; zero for all if a log has no date."""
    dates = [log.log.metadata.date for log in logs]
    stamps = [0.0 if None in dates else datetime.fromisoformat(str(date)).timestamp() for date in dates]
    return {id(log): stamp - min(stamps) for log, stamp in zip(logs, stamps, strict=True)}


def _base(log: SmoothLog, joints: tuple[str, ...]) -> Base:
    """The base that holds the joints of a log."""
    told = log.log.metadata
    if told.mount == "pendulum":
        return PendulumBase(float(told.mass or 0.0), float(told.length or 0.0))
    return fixed_base(joints, log.log.robot.reference, log.tilt)


def _merged(parts: Sequence[tuple[np.ndarray, TrajectoryDynamics]], rows: int) -> TrajectoryDynamics:
    fields = {}
    for name in ("mass", "bias", "gradient", "damping", "radial_force", "carried"):
        whole = np.zeros((rows, *getattr(parts[0][1], name).shape[1:]))
        for at, part in parts:
            whole[at] = getattr(part, name)
        fields[name] = whole
    return TrajectoryDynamics(**fields)


def _difference(one: TrajectoryDynamics, other: TrajectoryDynamics, amount: float) -> TrajectoryDynamics:
    """Contribution of an edit per unit of its parameter, without changes of derivatives."""
    added = {k: (getattr(one, k) - getattr(other, k)) / amount for k in ("mass", "bias", "radial_force", "carried")}
    none = {k: np.broadcast_to(0.0, getattr(one, k).shape) for k in ("gradient", "damping")}
    return TrajectoryDynamics(**added, **none)
