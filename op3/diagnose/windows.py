"""Residuals of short windows: measured minus nothing but what a model predicts from the measured state.

Windows of a fifth of a second start from the smoothed measured state and are driven by the commands of the log. Their
residual in position, velocity and current is whitened by what is usual for its channel and time in the window, and
what an error of the initial state would explain is taken out of it (two numbers per joint and window, with a tight
prior), so that what is left speaks about the model. The same holds for what changes from window to window: a joint's
friction, and the moment at which its commands take effect. Near the edge of sticking either moves a window far.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

import numpy as np
import torch
from torch import Tensor

from op3.diagnose.fitting import COARSE
from op3.diagnose.motion import CHANNELS, PREROLL, FixedBase, SmoothLog, fixed_base, smooth_all
from op3.diagnose.split import LogSplit
from op3.diagnose.supply import open_voltages
from op3.robot.units import CURRENT_UNIT
from op3.rollout import LogError
from op3.servo import RobotModel
from op3.servo.effects import CurrentPD, Motor, PacketDrop
from op3.sim import MeasuredMotion, TrajectoryDynamics, Window, WindowSimulation
from op3.sim.window_simulation import MISREADING, ROTOR, ZERO

INITIAL_POSITION = 0.0015
"""Prior standard deviation of the initial angle's error [rad]: one count of a 4096-step encoder."""

INITIAL_VELOCITY = 0.06
"""Prior standard deviation of the initial velocity's error [rad/s]."""

DRIFT = 0.03
"""Standard deviation of a joint's friction from window to window, relative: warmth and grease."""

DRIFTING = ("coulomb_friction", "static_friction_excess")
"""Parameters that drift together."""

JITTER = 0.0003
"""Standard deviation of the time at which a joint's command takes effect [s]; a step of the target shows it."""

TIMING = ("current_time_constant", "command_latency")
"""Parameters that stand for it; the first that the model has."""

FLOOR = {("joint", "position"): 0.0006, ("joint", "velocity"): 0.02, ("joint", "current"): 0.004}
"""Standard deviation of a reading, by channel [rad, rad/s, A]."""

LENGTH = 0.2
"""Length of a window [s]."""

STEP = 0.001
"""Longest step of a simulation that is not stretched [s]; a tick is a whole number of steps."""

SEARCH = 0.192
"""Time within which a window starts where the state is known best [s]: not in the middle of a jerk."""

HUBER = 2.0
"""A joint whose residual in a window is larger than this, in its usual ones, counts less there."""

USUAL = 0.8
"""Quantile of a joint's residuals over windows that is called usual."""

BLOCK = 1.0
"""Residuals closer than this are taken as dependent [s]."""


ZERO_STEP = 0.02
"""Step of the differences by which the dynamics at a false zero of an encoder are known [rad]."""


class WindowResiduals:
    """Windows of the logs of a split, and the residuals of any model on them.

    Windows of the fitted runs come first, then those of the runs by which hypotheses are chosen.

    Args:
        split: the logs; all on a stand, with the same joints.
        fit_windows: how many windows of the fitted runs.
        select_windows: how many of the runs that choose.
        ticks: length of a window; by default as many as last `LENGTH`.
        smooth_logs: the fitted logs and those that choose, if they have been smoothed before.

    Raises:
        LogError: if logs differ in joints or rate, or the base is free.

    Attributes:
        packets: what is known of command packets, as `op3.servo.Signals.packet`, of the ticks of every window and
            `PREROLL` before it, ``[window, tick]``: all arrived unless something else is told, see
            `op3.diagnose.packets`.
    """

    def __init__(
        self,
        split: LogSplit,
        *,
        fit_windows: int = 60,
        select_windows: int = 36,
        ticks: int | None = None,
        smooth_logs: Sequence[SmoothLog] | None = None,
    ):
        self.split = split
        first = split.fit[0]
        for log in split.logs:
            if log.metadata.mount != "stand" or log.joints != first.joints:
                raise LogError(
                    "windows need logs of one set of joints on the stand",
                    "diagnose logs of one mount and one set of joints at a time",
                    source=log.metadata.recording,
                    column="joints",
                )
        self.joints = first.joints
        logs = list(smooth_logs or smooth_all([*split.fit, *split.select]))
        if len({round(log.period, 6) for log in logs}) > 1:
            raise LogError("the logs have different rates", "diagnose logs of one rate at a time", column="time")
        self.period = logs[0].period
        self.ticks = ticks = round(LENGTH / self.period) if ticks is None else ticks
        self.timestep = self.period / np.ceil(self.period / STEP - 1e-6)
        fit = _choose(logs[: len(split.fit)], fit_windows, ticks)
        select = _choose(logs[len(split.fit) :], select_windows, ticks)
        self.windows = [*fit, *((log + len(split.fit), tick) for log, tick in select)]
        self.is_fit = np.arange(len(self.windows)) < len(fit)
        self.smooth_logs = logs
        self.blocks = np.array([hash((log, int(tick * self.period / BLOCK))) for log, tick in self.windows])
        self._stack(logs)
        self.measured = np.stack(
            [np.stack([logs[i].readings[key][t : t + ticks + 1] for i, t in self.windows]) for key in self.channels], -1
        )  # [window, tick, joint, channel]
        self.scale: np.ndarray | None = None
        self._nuisance: np.ndarray | None = None
        self._shrink: np.ndarray | None = None
        self._weight = np.ones((len(self.windows), 1))
        self.packets = np.ones((len(self.windows), PREROLL + ticks + 1))
        self.simulated_rows = 0

    def _stack(self, logs: Sequence[SmoothLog]) -> None:
        """One long motion of all windows' ticks, each with its lead."""
        self.channels = tuple(key for key in CHANNELS if all(key in log.readings for log in logs))
        spans = [(logs[i], slice(t - PREROLL, t + self.ticks + 1)) for i, t in self.windows]
        rows = PREROLL + self.ticks + 1

        def stacked(get) -> np.ndarray:
            return np.concatenate([get(log)[span] for log, span in spans])

        self._position, self._velocity = stacked(lambda log: log.position), stacked(lambda log: log.velocity)
        common = set.intersection(*(set(log.inputs) for log in logs))
        inputs = {name: stacked(lambda log, n=name: log.inputs[n]) for name in sorted(common)}
        supply, self.measured_voltage = 0.0, inputs.get("bus_voltage")
        if "bus_voltage" in common and ("joint", "current") in self.channels:
            supply, opened = open_voltages(logs)
            by_log = {id(log): voltage for log, voltage in zip(logs, opened, strict=True)}
            inputs["bus_voltage"] = stacked(lambda log: by_log[id(log)])
        tilts = [log.tilt for log, _ in spans]
        origin = began(logs)
        self._tilted: list[tuple[FixedBase, np.ndarray]] = []
        for tilt in sorted(set(tilts)):
            at = np.concatenate([np.arange(k * rows, (k + 1) * rows) for k, own in enumerate(tilts) if own == tilt])
            self._tilted.append((fixed_base(self.joints, tilt), at))
        q, v = stacked(lambda log: log.control[0]), stacked(lambda log: log.control[1])
        self.motion = MeasuredMotion(
            self.period,
            self._position,
            self._velocity,
            stacked(lambda log: log.acceleration),
            q,
            v,
            stacked(lambda log: log.readings.get(("joint", "current"), np.zeros_like(log.position))),
            np.concatenate([since(origin, log) + log.time[span, None] for log, span in spans]),
            inputs,
            self._dynamics(),
            {},
            supply,
        )
        self._starts = [Window(0, k * rows + PREROLL) for k in range(len(self.windows))]
        self._edits: dict[tuple[str, int | None], TrajectoryDynamics | None] = {}
        self._changes: dict[tuple[str, int | None], TrajectoryDynamics] = {}
        self._simulations: dict[tuple[float, bool, bool, int], WindowSimulation] = {}
        self._unchanged: dict[int, TrajectoryDynamics] = {}

    def _dynamics(self) -> TrajectoryDynamics:
        parts = [
            (at, base.dynamics(self._position[at], self._velocity[at], radial_force=True)) for base, at in self._tilted
        ]
        return _merged(parts, len(self._position))

    def _change(self, model: RobotModel, name: str, joint: int | None, amount: float) -> TrajectoryDynamics | None:
        """Dynamics added per unit of a parameter that edits bodies; None where it changes nothing here."""
        key = (name, joint)
        if key not in self._edits:
            parts = []
            for base, at in self._tilted:
                changed = base.changed(model, name, joint, amount)
                if changed is None:
                    break
                here = base.along(changed, self._position[at], self._velocity[at])
                parts.append((at, _difference(here, self._as_read(base, at), amount)))
            self._edits[key] = _merged(parts, len(self._position)) if len(parts) == len(self._tilted) else None
        return self._edits[key]

    def _elsewhere(self, joint: int) -> TrajectoryDynamics:
        """Dynamics added per unit of a zero error of a joint's encoder: it stands behind its reading."""
        key = (ZERO, joint)
        if key not in self._edits:
            parts = []
            for base, at in self._tilted:
                position = self._position[at].copy()
                position[:, joint] -= ZERO_STEP
                here = base.along(base.mj_model, position, self._velocity[at])
                parts.append((at, _difference(here, self._as_read(base, at), ZERO_STEP)))
            self._edits[key] = _merged(parts, len(self._position))
        found = self._edits[key]
        assert found is not None
        return found

    def _as_read(self, base: FixedBase, at: np.ndarray) -> TrajectoryDynamics:
        """Mass and bias of a sound robot along a motion."""
        if id(base) not in self._unchanged:
            self._unchanged[id(base)] = base.along(base.mj_model, self._position[at], self._velocity[at])
        return self._unchanged[id(base)]

    def simulation(
        self, model: RobotModel, fit_only: bool = False, stretch: int = 1, packets: np.ndarray | None = None
    ) -> WindowSimulation:
        """A simulation of the windows under a model, in steps stretched at most so many times, if it can.

        With packets ``[variant, window, tick]`` the windows are there once for each variant, one after another.
        """
        for effect in model.effects:
            for edit in effect.edits:
                known = model.parameters()[edit.parameter]
                if edit == ROTOR or edit.target == "base_body":
                    continue  # the rotor is on the diagonal; a base that is held carries whatever it weighs
                amount = 0.25 * (known.high - known.low)
                for joint in range(len(self.joints)) if known.per_joint else (None,):
                    change = self._change(model, edit.parameter, joint, amount)
                    if change is not None:
                        self._changes[edit.parameter, joint] = change
        if set(MISREADING) & set(model.effect_names):
            self._changes |= {(ZERO, joint): self._elsewhere(joint) for joint in range(len(self.joints))}
        # the law lets the bus fall where the driver regulates current; others get what was measured
        regulated = all(e.drive == "current" for e in model.effects if isinstance(e, Motor))
        supplied = regulated or not self.motion.supply_resistance
        substeps = round(self.period / self.timestep)
        fitting = [k for k in range(1, stretch + 1) if substeps % k == 0]
        timestep = self.timestep * (1 if model.stiff else fitting[-1])
        if PacketDrop.name in model.effect_names:
            told = [self.packets] if packets is None else list(packets)
            return self._simulation(model, timestep, fit_only, supplied, told)
        key = (timestep, fit_only, supplied, 1 if packets is None else len(packets))
        if key not in self._simulations:
            self._simulations[key] = self._simulation(model, timestep, fit_only, supplied, [None] * key[-1])
        return self._simulations[key].under(_as_sent(model))

    def _simulation(
        self,
        model: RobotModel,
        timestep: float,
        fit_only: bool,
        supplied: bool,
        variants: Sequence[np.ndarray | None],
    ) -> WindowSimulation:
        given: dict[str, Any] = {**vars(self.motion), "changes": self._changes}
        if not supplied:
            given["inputs"] = {**given["inputs"], "bus_voltage": self.measured_voltage}
            given["supply_resistance"] = 0.0
        motions = []
        for variant in variants:
            inputs = given["inputs"]
            if variant is not None:
                inputs = {**inputs, "packet": np.repeat(variant.reshape(-1, 1), len(self.joints), 1)}
            motions.append(MeasuredMotion(**{**given, "inputs": inputs}))
        starts = self._starts[: int(self.is_fit.sum())] if fit_only else self._starts
        return WindowSimulation(
            _as_sent(model),
            motions,
            [replace(start, motion=number) for number in range(len(motions)) for start in starts],
            self.ticks,
            self.joints,
            timestep=timestep,
            preroll=PREROLL,
        )

    def errors(
        self,
        model: RobotModel,
        parameters: Mapping[str, Tensor] | None = None,
        candidates: int = 1,
        *,
        fit_only: bool = False,
        stretch: int = 1,
        **offsets: Tensor,
    ) -> np.ndarray:
        """Simulated minus measured, ``[candidate, window, tick, joint, channel]``."""
        simulation = self.simulation(model, fit_only, stretch)
        self.simulated_rows += candidates * len(simulation.windows)
        return self._compared(
            simulation.run(
                parameters,
                candidates,
                position_offset=offsets.get("position_offset"),
                velocity_offset=offsets.get("velocity_offset"),
            )
        )

    def _compared(self, channels: Mapping[tuple[str, str], Tensor]) -> np.ndarray:
        """What was simulated, less the measurement; what diverged is far from it."""
        simulated = np.stack([channels[key].numpy() for key in self.channels], -1)
        result = (simulated - self.measured[None, : simulated.shape[1]]).astype(simulated.dtype)
        return np.nan_to_num(result, copy=False, nan=1e3, posinf=1e3, neginf=-1e3)

    def residuals_with(
        self, packets: np.ndarray, model: RobotModel, parameters: Mapping[str, Tensor] | None = None
    ) -> np.ndarray:
        """Whitened residuals of one model if other packets had arrived, ``[variant, window, residual]``.

        Args:
            packets: as the attribute, ``[variant, window, tick]``.
            model: with losses of packets among its effects.
            parameters: by name, ``[1, joint]``.
        """
        simulation = self.simulation(model, packets=packets)
        self.simulated_rows += len(simulation.windows)
        shape = (len(packets), len(self.windows))
        channels = {key: value[0].unflatten(0, shape) for key, value in simulation.run(parameters, 1).items()}
        return self.whiten(self._compared(channels)).astype(np.float32)

    def prepare(self, model: RobotModel, nuisances: bool = True) -> None:
        """Take the scale of the residuals, and what nuisances of single windows explain, from this model.

        Args:
            model: whose residuals are usual.
            nuisances: whether what differs from window to window is taken out of them.
        """
        error = self.errors(model)[0]
        self.scale = self._scale(error)
        if not nuisances:
            self._nuisance = np.zeros((len(self.windows), error[0].size, 0), error.dtype)
            self._shrink = np.zeros((len(self.windows), 0), error.dtype)
            self._weight = np.ones((len(self.windows), 1))
            return
        values, offsets, count = self._nuisances(model)
        position, velocity = offsets
        moved = self.errors(model, values, count, stretch=COARSE, position_offset=position, velocity_offset=velocity)
        sensitivity = np.moveaxis(moved[1:] - moved[0], 0, -1)  # [window, tick, joint, channel, nuisance]
        flat = (sensitivity / self.scale[..., None]).reshape(len(self.windows), -1, count - 1)
        basis, strength, _ = np.linalg.svd(flat, full_matrices=False)
        self._nuisance = basis.astype(error.dtype)
        self._shrink = (1.0 - 1.0 / np.sqrt(1.0 + strength**2)).astype(error.dtype)
        self._weight = np.ones((len(self.windows), 1))
        self._weight = self._weights(self.whiten(error[None])[0])

    def _weights(self, residual: np.ndarray) -> np.ndarray:
        """How much each residual counts, ``[window, residual]``: less where a joint misses as in few other windows.

        Whether a joint near rest sticks or slips is often chance, and a window in which the simulation decides
        otherwise misses by more than all others together. What a joint misses in every fifth window is no chance.
        """
        shape = (len(residual), self.ticks + 1, len(self.joints), len(self.channels))
        size = np.sqrt(np.square(residual.reshape(shape)).mean((1, 3)))  # [window, joint]
        usual = np.maximum(1.0, np.quantile(size, USUAL, axis=0))
        weight = np.minimum(1.0, HUBER * usual / np.maximum(size, 1e-9))
        return np.broadcast_to(weight[:, None, :, None], shape).reshape(len(residual), -1)

    def _nuisances(self, model: RobotModel) -> tuple[dict[str, Tensor], tuple[Tensor, Tensor], int]:
        """What differs from window to window by a standard deviation, one joint at a time, behind the model itself.

        Returns:
            Parameters ``[candidate, joint]``, offsets of initial position and velocity, and the number of candidates.
        """
        joints = len(self.joints)
        known = {name: value for name, value in model.tensors(self.joints).items() if name in (*DRIFTING, *TIMING)}
        late = next((name for name in TIMING if name in known), None)
        parts = 3 if late is None else 4
        count = 1 + parts * joints
        size, none = torch.eye(joints, dtype=torch.float64), torch.zeros(count, joints, dtype=torch.float64)

        def part(number: int, amount: float) -> Tensor:
            whole = none.clone()
            whole[1 + number * joints : 1 + (number + 1) * joints] = amount * size
            return whole

        offsets = (part(0, INITIAL_POSITION), part(1, INITIAL_VELOCITY))
        values = {name: known[name] * (1.0 + part(2, DRIFT)) for name in DRIFTING if name in known}
        if late is not None:
            values[late] = known[late] + part(3, JITTER)
        return values, offsets, count

    def _scale(self, error: np.ndarray) -> np.ndarray:
        """Per tick and channel, ``[tick, 1, channel]``: the sensors' floor and the usual size of the residual."""
        floor = np.array([FLOOR[key] for key in self.channels])
        usual = 1.4826 * np.median(np.abs(error), axis=(0, 2))  # [tick, channel]
        return np.sqrt(floor**2 + usual**2)[:, None, :]

    def whiten(self, error: np.ndarray) -> np.ndarray:
        """Whitened residual without what initial states explain, ``[candidate, window, residual]``."""
        assert self.scale is not None
        assert self._nuisance is not None
        assert self._shrink is not None
        flat = (error / self.scale.astype(error.dtype)).reshape(*error.shape[:2], -1)
        basis, shrink = self._nuisance[: flat.shape[1]], self._shrink[: flat.shape[1]]
        # [window, nuisance, candidate]
        along = basis.transpose(0, 2, 1) @ flat.transpose(1, 2, 0)
        kept = flat - (basis @ (shrink[..., None] * along)).transpose(2, 0, 1)
        return kept * self._weight[: flat.shape[1]].astype(error.dtype)

    def unwhitened(self, residual: np.ndarray) -> np.ndarray:
        """Whitened residuals ``[window, residual]`` in their units, ``[window, tick, joint, channel]``."""
        assert self.scale is not None
        plain = residual / self._weight
        return plain.reshape(len(residual), self.ticks + 1, len(self.joints), len(self.channels)) * self.scale

    def by_window(self, values: np.ndarray, end: bool = False) -> np.ndarray:
        """What lies along the motion of all windows, ``[row, ...]``, as ``[window, tick, ...]`` without their leads.

        Args:
            values: of all rows.
            end: whether the tick at which a window ends is one of them.
        """
        windows = values.reshape(len(self.windows), PREROLL + self.ticks + 1, *values.shape[1:])
        return windows[:, PREROLL : None if end else -1]

    def squares_by_joint(self, residual: np.ndarray) -> np.ndarray:
        """Sums of squares of whitened residuals ``[window, residual]``, ``[window, joint]``."""
        shape = (len(residual), self.ticks + 1, len(self.joints), len(self.channels))
        return np.square(residual.reshape(shape).astype(np.float64)).sum((1, 3))

    def residuals(
        self,
        model: RobotModel,
        parameters: Mapping[str, Tensor] | None = None,
        candidates: int = 1,
        fit_only: bool = False,
        stretch: int = 1,
    ) -> np.ndarray:
        """Whitened residuals ``[candidate, window, residual]``; call `prepare` first.

        In stretched steps they cost less, and differ from those of fine ones.
        """
        parts, size = [], 40
        for begin in range(0, candidates, size):
            piece = slice(begin, min(begin + size, candidates))
            values = {name: value[piece] for name, value in (parameters or {}).items()}
            error = self.errors(model, values, piece.stop - begin, fit_only=fit_only, stretch=stretch)
            parts.append(self.whiten(error).astype(np.float32))
        return np.concatenate(parts)


def _as_sent(model: RobotModel) -> RobotModel:
    """The model with commands rounded as the register of the servos takes them: the log tells what was computed."""
    effects = [
        replace(e, resolution=CURRENT_UNIT) if isinstance(e, CurrentPD) else e  # type: ignore[type-var]
        for e in model.effects
    ]
    return replace(model, effects=tuple(effects))


def _choose(logs: Sequence[SmoothLog], count: int, ticks: int) -> list[tuple[int, int]]:
    """Evenly spread starts (log, tick) of windows that do not overlap while there is room, at smooth places."""
    half = logs[0].half_width if logs else 0
    lead, tail = max(PREROLL, half), ticks + half + 1
    room = np.array([max(0, len(log.time) - lead - tail) for log in logs])
    if room.sum() == 0:
        raise LogError("the logs are shorter than a window", "record a few seconds per run", column="time")
    total = int(room.sum())
    stride = max(total / count, ticks / 2)
    starts = []
    edges = np.cumsum([0, *room])
    aside = int(0.5 * max(0.0, min(stride - ticks, SEARCH / logs[0].period)))
    for at in np.arange(stride / 2, total, stride):
        log = int(np.searchsorted(edges, at, side="right") - 1)
        tick = lead + int(at - edges[log])
        first, last = max(lead, tick - aside), min(lead + int(room[log]), tick + aside + 1)
        starts.append((log, first + int(logs[log].rough[first:last].argmin())))
    return starts


def began(logs: Sequence[SmoothLog]) -> float | None:
    """When the first of the logs began [s since 1970]; None where the metadata of one do not tell."""
    dates = [log.log.metadata.date for log in logs]
    return None if any(date is None for date in dates) else min(map(_timestamp, dates))


def since(origin: float | None, log: SmoothLog) -> float:
    """How long after an origin a log began [s]; 0 where either is not known."""
    date = log.log.metadata.date
    return 0.0 if origin is None or date is None else _timestamp(date) - origin


def _timestamp(date: Any) -> float:
    return datetime.fromisoformat(str(date)).timestamp()


def _merged(parts: Sequence[tuple[np.ndarray, TrajectoryDynamics]], rows: int) -> TrajectoryDynamics:
    fields = {}
    for name in ("mass", "bias", "gradient", "damping", "radial_force"):
        whole = np.zeros((rows, *getattr(parts[0][1], name).shape[1:]))
        for at, part in parts:
            whole[at] = getattr(part, name)
        fields[name] = whole
    return TrajectoryDynamics(**fields)


def _difference(one: TrajectoryDynamics, other: TrajectoryDynamics, amount: float) -> TrajectoryDynamics:
    return TrajectoryDynamics(**{k: (getattr(one, k) - getattr(other, k)) / amount for k in vars(one)})
