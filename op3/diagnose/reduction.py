"""Reduction of windows to rows: unmodelled torque, current residual and rate residual of each joint, by piece.

The residual of a window in position, velocity and current is a linear function of errors of its initial state and of
unmodelled torques. It is solved for the torques, with the initial state as nuisance parameters with tight priors, which
gives nearly independent rows. All columns (baseline parameters and candidates) pass through the same reduction.

On a stand limbs are not coupled, so one simulation can include a change in one joint of every limb.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType

import numpy as np
import torch
from scipy import linalg, sparse
from torch import Tensor

from op3.diagnose.candidates import Candidate
from op3.diagnose.coordinates import SPREAD_LIMIT, Coordinate, Coordinates
from op3.diagnose.features import features
from op3.diagnose.judge import Rows
from op3.diagnose.judge_settings import FLOORS, MIN_WINDOWS, PIECES, SETTINGS, Settings
from op3.diagnose.linearisation import Column, Linearisation
from op3.diagnose.responses import (
    INITIAL,
    RATES,
    Reducer,
    filter_matrices,
    rate_variance,
    reducer,
    torque_responses,
    velocity_weights,
)
from op3.replay.windows import WindowResiduals
from op3.servo import RobotModel, parameter
from op3.servo.conditions import split_name

THINNING = 3
"""Budget: search and comparisons of starts use every n-th window, at least a third of `MIN_WINDOWS`."""

MAX_VARIANCE = 100.0
"""Numerical: variance of a torque above which a row is not used [torque units^2]."""

STEP = 0.02
"""Numerical: finite-difference step of a coordinate as a share of its range."""

MOVING_SPEED = 0.05
"""Numerical: a joint moves if the standard deviation of its speed is larger [rad/s]."""

COARSE = 2
"""Numerical: factor on the simulation's step where only differences are used. It does not apply to times such as
delays, because their columns are very similar."""

MAX_ERROR = 300.0
"""Numerical: range to which errors are clipped, because simulations may diverge [sensor floors]."""

CHUNK = 20
"""Budget: parameter sets simulated together; a batch of 72 windows of 20 joints holds 10 MB."""


class Reduction:
    """Reduces windows of logs to the rows of the linear model.

    Args:
        engine: windows of logs.
        settings: tuned constants.
        reference: reduction of other windows of the same logs that supplies the torque unit and the moving joints.

    Attributes:
        joint_indices: columns of the compared joints: all joints of limbs in which any joint moves.
        moving: whether each of the robot's joints moves.
        torque_unit: one hundredth of the torque of the busiest joint [N m].
        loads: RMS torque of the compared joints, ``[joint]`` [N m].
    """

    def __init__(self, engine: WindowResiduals, settings: Settings = SETTINGS, reference: "Reduction | None" = None):
        self.engine, self.settings = engine, settings
        self.windows, self.ticks, self.count = len(engine.windows), engine.ticks, len(engine.joints)
        motion = engine.motion
        moving = engine.by_window(motion.velocity).reshape(-1, self.count).std(0) > MOVING_SPEED
        self.moving = moving if reference is None else reference.moving
        coupled = np.abs(motion.dynamics.mass).max(0) > 1e-12
        count, limb_of = sparse.csgraph.connected_components(coupled, directed=False)
        all_limbs = [np.flatnonzero(limb_of == limb) for limb in range(count)]
        self.limbs = [limb for limb in all_limbs if self.moving[limb].any()]
        self.joint_indices = np.concatenate([np.zeros(0, int), *self.limbs])
        self.limb_of = {int(j): k for k, limb in enumerate(self.limbs) for j in limb}
        self.slot_of = {int(j): i for limb in self.limbs for i, j in enumerate(limb)}
        torque = np.einsum("tij,tj->ti", motion.dynamics.mass, motion.acceleration) + motion.dynamics.bias
        largest = float(np.quantile(np.abs(torque), 0.95, axis=0).max())
        self.torque_unit = 0.01 * largest if reference is None else reference.torque_unit
        self.loads = np.sqrt(np.square(torque).mean(0))[self.joint_indices]
        self.floor = np.where(engine.known, list(FLOORS.values()), np.inf)
        self._limb_engines = [engine.part(limb) for limb in self.limbs] if len(all_limbs) > 1 else [engine]
        of_piece = np.minimum(np.arange(self.ticks + 1) * PIECES // self.ticks, PIECES - 1)
        self._mean = np.stack([(of_piece == p) / (of_piece == p).sum() for p in range(PIECES)])
        self._velocity_weights = velocity_weights(self.ticks).astype(np.float32)
        counts = (PIECES, PIECES, RATES)
        self.kinds = np.array([2 * group + (row > 0) for group, count in enumerate(counts) for row in range(count)])

    def thinned(self, windows: int | None = None) -> "Reduction":
        """Fewer windows of the same logs, by default one in `THINNING`."""
        windows = max(MIN_WINDOWS // THINNING, self.windows // THINNING) if windows is None else windows
        return Reduction(self.engine.thinned(windows), self.settings, self) if windows < self.windows else self

    def errors(
        self,
        model: RobotModel,
        sets: Mapping[str, Tensor],
        count: int,
        stretch: int = 1,
        limb: int | None = None,
        offsets: Mapping[str, Tensor] = MappingProxyType({}),
    ) -> list[np.ndarray]:
        """Whitened errors (simulated minus measured) by limb, ``[set, window, residual]``; zero where not measured.

        Args:
            sets, count: parameter sets by name, ``[set, joint]``, and their number.
            stretch: factor on the simulation's step.
            limb: the only limb that is simulated; None: all.
            offsets: offsets of the initial state, ``[set, joint]``.
        """
        limbs = range(len(self.limbs)) if limb is None else [limb]
        coupled = any(not p.per_joint and not effect.edits for effect in model.effects for p in effect.parameters)

        def whitened(engine: WindowResiduals, joints: list[int], chunk: slice) -> np.ndarray:
            """Errors of some joints, ``[set, window, tick, joint, channel]``."""
            per_joint = {name: value.shape[1] == self.count for name, value in sets.items()}
            values = {name: value[chunk, joints] if per_joint[name] else value[chunk] for name, value in sets.items()}
            initial = {name: value[chunk, joints] for name, value in offsets.items()}
            error = engine.errors(model, values, chunk.stop - chunk.start, stretch=stretch, **initial)
            error /= self.floor[joints].astype(np.float32)
            return np.clip(error, -MAX_ERROR, MAX_ERROR, out=error)

        chunks = []
        for begin in range(0, count, CHUNK):
            chunk = slice(begin, min(begin + CHUNK, count))
            if coupled:  # an effect of the whole robot, such as a supply whose voltage drops with all currents
                error = whitened(self.engine, list(range(self.count)), chunk)
                chunks.append([error[:, :, :, self.limbs[k]] for k in limbs])
            else:
                chunks.append([whitened(self._limb_engines[k], self.limbs[k].tolist(), chunk) for k in limbs])
        return [np.concatenate(errors).reshape(count, self.windows, -1) for errors in zip(*chunks, strict=True)]

    def errors_at(
        self, coordinates: Coordinates, points: np.ndarray, stretch: int = 1, limb: int | None = None
    ) -> list[np.ndarray]:
        """Whitened errors at points ``[point, coordinate]``, as returned by `errors`."""
        return self.errors(coordinates.model, coordinates.values(points), len(points), stretch, limb)

    def rows_at(
        self,
        reducers: Sequence[Reducer],
        coordinates: Coordinates,
        points: np.ndarray,
        stretch: int = 1,
        start: np.ndarray | None = None,
    ) -> np.ndarray:
        """Rows of the errors at points, or of their differences from the errors at a start, ``[point, joint, window,
        row]``. Only one chunk of errors is kept at a time: they take seven times as much memory as rows."""
        origin = None if start is None else self.errors_at(coordinates, start[None], stretch)
        chunks = []
        for begin in range(0, len(points), CHUNK):
            error = self.errors_at(coordinates, points[begin : begin + CHUNK], stretch)
            chunks.append(
                self.reduce(reducers, error if origin is None else [e - o for e, o in zip(error, origin, strict=True)])
            )
        return np.concatenate(chunks)

    def linearise(
        self,
        coordinates: Coordinates,
        point: np.ndarray,
        reducers_of: Linearisation | None = None,
        jacobian_of: Linearisation | None = None,
    ) -> Linearisation:
        """Residual, Jacobian and reduction around a point. Another linearisation may supply the reduction and the
        columns of shared coordinates."""
        columns = (
            {} if jacobian_of is None else dict(zip(jacobian_of.coordinates.entries, jacobian_of.jacobian, strict=True))
        )
        entries = coordinates.entries
        groups = [group for group in self._simulation_groups(entries) if entries[group[0]] not in columns]
        span = np.minimum(coordinates.high - coordinates.low, 2 * SPREAD_LIMIT * coordinates.deviation)
        step = np.where(point + 2 * STEP * span > coordinates.high, -STEP, STEP) * span
        error = self.errors_at(coordinates, point[None])
        changes = np.zeros((len(groups), len(self.joint_indices), self.windows, len(self.kinds)), np.float32)
        if reducers_of is None:
            reducers, variance = self.reducers(coordinates, point, error)
        else:
            reducers, variance = reducers_of.reducers, reducers_of.variance
        residual = -self.reduce(reducers, error)[0]
        is_time = np.array([_is_time(entries[group[0]].parameter) for group in groups], bool)
        steps = np.array([np.isin(np.arange(len(point)), group) for group in groups]).reshape(-1, len(point)) * step
        if is_time.any():  # central differences
            half = steps[is_time] / 2
            low, high = (np.clip(p, coordinates.low, coordinates.high) for p in (point - half, point + half))
            share = (high - low).sum(1) / steps[is_time].sum(1)
            pairs = zip(self.errors_at(coordinates, low), self.errors_at(coordinates, high), strict=True)
            changes[is_time] = self.reduce(reducers, [b - a for a, b in pairs]) / share[:, None, None, None]
        if (~is_time).any():
            changes[~is_time] = self.rows_at(reducers, coordinates, point + steps[~is_time], COARSE, point)
        jacobian = np.zeros((len(point), *residual.shape), np.float32)
        for i, entry in enumerate(entries):
            jacobian[i] = columns.get(entry, 0.0)
        for change, group in zip(changes, groups, strict=True):
            for i in group:
                jacobian[i] = change / step[i]
                jacobian[i][~self._same_limb(entries[i].joints)] = 0.0
        return Linearisation(coordinates, point, reducers, variance, residual, jacobian)

    def reducers(
        self, coordinates: Coordinates, point: np.ndarray, error: Sequence[np.ndarray] | None = None
    ) -> tuple[tuple[Reducer, ...], tuple[np.ndarray, ...]]:
        """The reduction around a point and the variance of its torques ``[window, joint]``, by limb. Whitened errors at
        the point are computed unless given."""
        error = self.errors_at(coordinates, point[None]) if error is None else error
        parameters = coordinates.model.tensors(self.engine.joints) | coordinates.values(point[None])
        filters = filter_matrices(parameters, self.count, self.ticks, self.engine.period)
        nuisances = self._nuisances(coordinates, point, [e[0] for e in error], filters)
        pairs = zip(self.limbs, nuisances, strict=True)
        results = [reducer(nuisance, filters[limb], self.engine.period) for limb, nuisance in pairs]
        return tuple(result[0] for result in results), tuple(result[1] for result in results)

    def forget(self) -> None:
        """Free the compiled simulations of the models."""
        for engine in (self.engine, *self._limb_engines):
            engine.forget()

    def _same_limb(self, joints: tuple[int, ...] | None) -> np.ndarray:
        """Which compared joints share a limb with any of the given joints, ``[joint]``."""
        if joints is None:
            return np.ones(len(self.joint_indices), bool)
        limbs = {self.limb_of.get(j) for j in joints}
        return np.array([self.limb_of[int(j)] in limbs for j in self.joint_indices])

    def _simulation_groups(self, entries: Sequence[Coordinate]) -> list[list[int]]:
        """Coordinates that share one simulation: the same parameter in the same slot of every limb."""
        groups: dict[tuple, list[int]] = {}
        for i, entry in enumerate(entries):
            single = entry.joints is not None and len(entry.joints) == 1
            if single and entry.joints[0] not in self.limb_of:  # type: ignore[index]
                continue
            key = (entry.parameter, entry.kind, self.slot_of[entry.joints[0]]) if single else (i,)  # type: ignore[index]
            groups.setdefault(key, []).append(i)
        return list(groups.values())

    def _nuisances(
        self, coordinates: Coordinates, point: np.ndarray, residual: list[np.ndarray], filters: np.ndarray
    ) -> list[np.ndarray]:
        """Responses to initial states and to unit torques of pieces, by limb ``[window, residual, nuisance]``."""
        size = max(map(len, self.limbs))
        count = 2 * size + 1
        position = torch.zeros(count, self.count, dtype=torch.float64)
        velocity = position.clone()
        for limb in self.limbs:
            for slot, j in enumerate(limb):
                position[1 + slot, j], velocity[1 + size + slot, j] = INITIAL
        values = coordinates.values(np.repeat(point[None], count, 0))
        offsets = {"position_offset": position, "velocity_offset": velocity}
        error = self.errors(coordinates.model, values, count, COARSE, offsets=offsets)
        tensors = coordinates.model.tensors(self.engine.joints) | values
        armature = tensors["armature"][0].numpy() if "armature" in tensors else 0.0
        armature = np.broadcast_to(armature, self.count)
        internal_loop = "current_pd" not in coordinates.model.effect_names
        result = []
        for k, limb in enumerate(self.limbs):
            n = len(limb)
            change = error[k][1:] - error[k][:1]
            initial = np.concatenate([change[:n], change[size : size + n]])
            of_limb = limb, armature, internal_loop, initial, residual[k], filters[limb]
            torque = torque_responses(self.engine, *of_limb, self.torque_unit, self.floor)
            result.append(np.moveaxis(np.concatenate([initial, torque]), 0, -1))
        return result

    def reduce(self, reducers: Sequence[Reducer], errors: Sequence[np.ndarray]) -> np.ndarray:
        """Whitened errors by limb as rows, ``[set, joint, window, row]``: torques, currents, rates, means first."""
        results = []
        for weights, error, limb in zip(reducers, errors, self.limbs, strict=True):
            sets, n = len(error), len(limb)
            torque = np.moveaxis(np.matmul(weights.torque, np.moveaxis(error, 0, -1)), -1, 0)
            torque = torque.reshape(sets, self.windows, n, PIECES)
            position, velocity, current = np.moveaxis(error.reshape(sets, self.windows, self.ticks + 1, n, 3), -1, 0)
            current = np.einsum("pt,swtj->swjp", self._mean, current)
            rate = np.einsum("pt,swtj->swjp", self._velocity_weights, velocity)
            rate -= np.einsum("jpt,swtj->swjp", weights.rate, position, optimize=True)
            rate[(np.abs(position) >= MAX_ERROR).any(2)] = 0.0  # diverged
            rows = [kind @ linalg.helmert(kind.shape[-1], full=True).T for kind in (torque, current, rate)]
            rows = np.concatenate(rows, -1)
            results.append(np.moveaxis(rows, 2, 1))
        return np.concatenate(results, 1).astype(np.float32)

    def columns(
        self, linear: Linearisation, candidates: Sequence[Candidate], progress: Callable[[float], None] | None = None
    ) -> list[Column]:
        """Changes of the rows caused by the secant of each elementary candidate."""
        result: list[Column] = [{} for _ in candidates]
        base = linear.coordinates.values(linear.point[None])
        models: dict[int, dict[tuple, list[int]]] = {}
        for i, candidate in enumerate(candidates):
            slot = self.slot_of[candidate.joints[0]] if candidate.joints else None
            models.setdefault(id(candidate.model), {}).setdefault((candidate.variant, slot), []).append(i)
        done = 0
        for groups in models.values():
            for begin in range(0, len(groups), CHUNK - 1):
                chunk = list(groups.values())[begin : begin + CHUNK - 1]
                changes = self._simulate(linear, [[candidates[i] for i in group] for group in chunk], base)
                for group, change in zip(chunk, changes, strict=True):
                    for i in group:
                        joints = np.flatnonzero(self._same_limb(candidates[i].joints))
                        result[i] = {int(j): change[j] for j in joints}
                done += len(chunk)
                if progress is not None:
                    progress(done / sum(map(len, models.values())))
            self.forget()
        return result

    def _simulate(self, linear: Linearisation, groups: list[list[Candidate]], base) -> np.ndarray:
        """Changes of the rows by groups of candidates of one model, ``[group, joint, window, row]``."""
        model = groups[0][0].model
        parameters, start = model.parameters(), model.tensors(self.engine.joints) | base
        shared = {name for name in start if not parameters[name.split("@")[0]].per_joint}
        start = {n: value if n in shared else value.expand(1, self.count).clone() for n, value in start.items()}
        sets = [start]
        for group in groups:
            values = start
            for candidate in group:
                values = candidate.applied(values)
            sets.append(values)
        stacked = {name: torch.cat([values[name] for values in sets]) for name in sets[0]}
        is_time = any(_is_time(name) for group in groups for name in group[0].secant)
        error = self.errors(model, stacked, len(sets), 1 if is_time else COARSE)
        return self.reduce(linear.reducers, [e[1:] - e[:1] for e in error])

    def rows(self, linear: Linearisation, columns: Sequence[Column] = (), reference: Rows | None = None) -> Rows:
        """Rows of the linear model.

        Args:
            linear: the linearised baseline.
            columns: columns of elementary candidates.
            reference: rows whose variances are used, which makes evidences comparable.
        """
        torque, current, rate = (self.kinds // 2 == group for group in range(3))
        torque_variance = np.concatenate([v.T for v in linear.variance])  # [joint, window]
        valid = (torque_variance < MAX_VARIANCE) & self.moving[self.joint_indices][:, None]
        variance = np.where(valid, torque_variance, np.inf)[..., None] + np.zeros(len(self.kinds))
        variance[..., torque] += self._edge_variance(linear)[..., None]
        recorded = (self.moving & self.engine.known[:, 2])[self.joint_indices]
        variance[..., current] = np.where(recorded, PIECES / self.ticks, np.inf)[:, None, None]
        recorded = (self.moving & self.engine.known[:, :2].all(1))[self.joint_indices]
        floors = np.array([rate_variance(self._velocity_weights, r) for limb in linear.reducers for r in limb.rate])
        variance[..., rate] = np.where(recorded[:, None], floors, np.inf)[:, None]
        variance = variance if reference is None else reference.variance
        coefficients, design = [], []
        for j in range(len(self.joint_indices)):
            of_joint = [*enumerate(linear.jacobian[:, j])]
            of_joint += [(i, column[j]) for i, column in enumerate(columns, len(linear.point)) if j in column]
            of_joint = [(i, column) for i, column in of_joint if column.any()]
            coefficients.append(np.array([i for i, _ in of_joint], int))
            design.append(
                self.clipped(np.array([column for _, column in of_joint]).reshape(-1, *linear.residual.shape[1:]))
            )
        residual = np.where(np.isfinite(variance), linear.residual, 0.0)
        names = tuple(self.engine.joints[j] for j in self.joint_indices)
        return Rows(names, self.kinds, residual, variance, self.features, tuple(coefficients), tuple(design))

    def clipped(self, columns: np.ndarray) -> np.ndarray:
        """A joint's columns ``[column, window, row]``; outliers in windows on the edge of sticking are clipped."""
        result = columns.copy()
        for group in range(3):
            rows = self.kinds // 2 == group
            usual = np.quantile(np.abs(columns[..., rows]), 0.97, axis=(1, 2), keepdims=True)
            result[..., rows] = np.clip(columns[..., rows], -8 * usual - 0.5, 8 * usual + 0.5)
        return result

    def _edge_variance(self, linear: Linearisation) -> np.ndarray:
        """Extra variance of windows in which a joint is about to stick, because they are sensitive to small changes of
        shared parameters, ``[joint, window]``."""
        s, extra = self.settings, 0.0
        for entry, value, column in zip(linear.coordinates.entries, linear.point, linear.jacobian, strict=True):
            if entry.joints is None and entry.kind != "add" and entry.low >= entry.zero:  # relative changes
                relative = s.edge_share * (value - entry.zero)
                change = np.square(relative * column[..., self.kinds < 2].astype(np.float64)).mean(-1)
                extra = extra + np.maximum(change - np.quantile(change, 0.75, axis=1, keepdims=True), 0.0)
        return s.edge**2 * np.minimum(extra, 0.9 * MAX_VARIANCE)

    @cached_property
    def features(self) -> np.ndarray:
        """Features of the unmodelled torque, ``[joint, window, row, feature]``."""
        return features(self.engine, self.joint_indices, self.torque_unit, self.settings)


def _is_time(name: str) -> bool:
    """Whether a parameter is a time."""
    return parameter(split_name(name)[0]).unit == "s"
