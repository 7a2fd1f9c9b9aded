"""Windows reduced to what is judged: the torque and the current that each joint lacks, in pieces of a window, and how
far the velocity that its servo reports is from the rate of its angle.

A window's residual in position, velocity and current is a linear image of errors of its initial state and of the torque
that its joints lack. Solved for the latter, with the former as nuisances with tight priors, what the sensors' noise and
the mechanics mix becomes rows that are nearly independent. Every column (a number of the base, a candidate) passes
through the same reduction, batch by batch, and is thrown away behind it.

On a stand limbs do not couple, so that one simulation carries a local change in one joint of every limb.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from types import MappingProxyType

import numpy as np
import torch
from scipy import linalg, sparse
from torch import Tensor

from op3.diagnose.candidates import Candidate
from op3.diagnose.coordinates import SPREAD_LIMIT, Coordinate, Coordinates
from op3.diagnose.features import features
from op3.diagnose.judge import Rows
from op3.diagnose.judge_settings import FLOORS, PIECES, SETTINGS, Settings
from op3.diagnose.rates import RATES, filtered, read, rounding
from op3.diagnose.responses import INITIAL, Reducer, reducer, torque_responses
from op3.replay.windows import WindowResiduals
from op3.servo import RobotModel, parameter
from op3.servo.conditions import split_name

UNKNOWN = 100.0
"""Variance of a torque beyond which a window tells nothing of it [units^2]."""

STEP = 0.02
"""Step of the base's finite differences, as a share of a number's range."""

MOVES = 0.05
"""A joint moves if its speed has this standard deviation [rad/s]."""

COARSE = 2
"""How many times longer than usual the steps are of which only differences count: a column. Not of a time, such as a
delay: where one may stand for another the small difference of their columns is what tells."""

FARTHEST = 300.0
"""Where errors end [sensors' floors]: what has diverged."""

CHUNK = 40
"""Parameter sets simulated at a time: a batch of 72 windows of 20 joints holds 20 MB."""


@dataclass(frozen=True, eq=False)
class Linear:
    """The windows around a point of the base, by limb.

    Attributes:
        coordinates: the base's numbers.
        point: where they are.
        reducers: of every limb.
        variance: of these torques [units^2], ``[window, joint]``.
        lacking: what the base leaves, ``[joint, window, row]``.
        base: by number, ``[joint, window, row]``.
    """

    coordinates: Coordinates
    point: np.ndarray
    reducers: tuple[Reducer, ...]
    variance: tuple[np.ndarray, ...]
    lacking: np.ndarray
    base: np.ndarray


class Reduction:
    """Reduces windows of an engine.

    Args:
        engine: windows of logs.
        settings: tuned constants.
        like: windows of the same logs, whose unit and moving joints hold here too.

    Attributes:
        judged: columns of the joints that are judged: all of limbs of which one joint moves.
        moving: whether each of the robot's joints moves.
        unit: one hundredth of the torque of the busiest joint [N m].
        loads: torque of the judged joints, root mean square, ``[joint]`` [N m].
    """

    def __init__(self, engine: WindowResiduals, settings: Settings = SETTINGS, like: "Reduction | None" = None):
        self.engine, self.settings = engine, settings
        self.windows, self.ticks, self.count = len(engine.windows), engine.ticks, len(engine.joints)
        motion = engine.motion
        moving = engine.by_window(motion.velocity).reshape(-1, self.count).std(0) > MOVES
        self.moving = moving if like is None else like.moving
        linked = np.abs(motion.dynamics.mass).max(0) > 1e-12
        limbs, of = sparse.csgraph.connected_components(linked, directed=False)
        every = [np.flatnonzero(of == limb) for limb in range(limbs)]
        self.limbs = [limb for limb in every if self.moving[limb].any()]
        self.judged = np.concatenate([np.zeros(0, int), *self.limbs])
        self.limb_of = {int(j): k for k, limb in enumerate(self.limbs) for j in limb}
        self.slot_of = {int(j): i for limb in self.limbs for i, j in enumerate(limb)}
        needed = np.einsum("tij,tj->ti", motion.dynamics.mass, motion.acceleration) + motion.dynamics.bias
        self.unit = 0.01 * float(np.quantile(np.abs(needed), 0.95, axis=0).max()) if like is None else like.unit
        self.loads = np.sqrt(np.square(needed).mean(0))[self.judged]
        self.floor = np.where(engine.known, list(FLOORS.values()), np.inf)
        self._parts = [engine.part(limb) for limb in self.limbs] if len(every) > 1 else [engine]
        of_piece = np.minimum(np.arange(self.ticks + 1) * PIECES // self.ticks, PIECES - 1)
        self._mean = np.stack([(of_piece == p) / (of_piece == p).sum() for p in range(PIECES)])
        self._read = read(self.ticks).astype(np.float32)
        counts = (PIECES, PIECES, RATES)
        self.kinds = np.array([2 * group + (row > 0) for group, count in enumerate(counts) for row in range(count)])

    def thinned(self, windows: int) -> "Reduction":
        """Fewer windows of the same logs."""
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
        """Whitened errors of parameter sets, by limb, or of one of them, ``[set, window, residual]``; channels not
        measured are zero."""
        chosen = range(len(self.limbs)) if limb is None else [limb]
        together = any(not p.per_joint and not effect.edits for effect in model.effects for p in effect.parameters)

        def whitened(engine: WindowResiduals, at: list[int], piece: slice) -> np.ndarray:
            """By the sensors' floors, of some joints, ``[set, window, tick, joint, channel]``."""
            given = {n: value[piece, at] if value.shape[1] == self.count else value[piece] for n, value in sets.items()}
            apart = {name: value[piece, at] for name, value in offsets.items()}
            error = engine.errors(model, given, piece.stop - piece.start, stretch=stretch, **apart)
            error /= self.floor[at].astype(np.float32)
            return np.clip(error, -FARTHEST, FARTHEST, out=error)

        found = []
        for begin in range(0, count, CHUNK):
            piece = slice(begin, min(begin + CHUNK, count))
            if together:  # an effect of the whole robot, such as a supply that sags with all currents
                whole = whitened(self.engine, list(range(self.count)), piece)
                found.append([whole[:, :, :, self.limbs[k]] for k in chosen])
            else:
                found.append([whitened(self._parts[k], self.limbs[k].tolist(), piece) for k in chosen])
        return [np.concatenate(parts).reshape(count, self.windows, -1) for parts in zip(*found, strict=True)]

    def at(
        self, coordinates: Coordinates, points: np.ndarray, stretch: int = 1, limb: int | None = None
    ) -> list[np.ndarray]:
        """The same at points ``[point, coordinate]``."""
        return self.errors(coordinates.model, coordinates.values(points), len(points), stretch, limb)

    def linearise(
        self,
        coordinates: Coordinates,
        point: np.ndarray,
        reduced: Linear | None = None,
        moved_as: Linear | None = None,
    ) -> Linear:
        """What the base leaves, its numbers' columns, and the reduction, around a point.

        Kept are the reduction of `reduced`, and of `moved_as` the columns of the numbers that both have.
        """
        known = {} if moved_as is None else dict(zip(moved_as.coordinates.entries, moved_as.base, strict=True))
        entries = coordinates.entries
        groups = [group for group in self._together(entries) if entries[group[0]] not in known]
        span = np.minimum(coordinates.high - coordinates.low, 2 * SPREAD_LIMIT * coordinates.deviation)
        step = np.where(point + 2 * STEP * span > coordinates.high, -STEP, STEP) * span
        here = self.at(coordinates, point[None])
        changes = np.zeros((len(groups), len(self.judged), self.windows, len(self.kinds)), np.float32)
        if reduced is None:
            reducers, variance = self.reducers(coordinates, point, here)
        else:
            reducers, variance = reduced.reducers, reduced.variance
        lacking = -self.reduce(reducers, here)[0]
        times = np.array([_is_time(entries[group[0]].parameter) for group in groups], bool)
        moving = np.array([np.isin(np.arange(len(point)), group) for group in groups]).reshape(-1, len(point)) * step
        if times.any():
            low, high = (
                np.clip(point + sign * moving[times] / 2, coordinates.low, coordinates.high) for sign in (-1, 1)
            )
            went = (high - low).sum(1) / moving[times].sum(1)
            both = zip(self.at(coordinates, low), self.at(coordinates, high), strict=True)
            changes[times] = self.reduce(reducers, [b - a for a, b in both]) / went[:, None, None, None]
        if (~times).any():
            error = self.at(coordinates, np.concatenate([point[None], point + moving[~times]]), COARSE)
            changes[~times] = self.reduce(reducers, [one[1:] - one[:1] for one in error])
        base = np.zeros((len(point), *lacking.shape), np.float32)
        for i, entry in enumerate(entries):
            base[i] = known.get(entry, 0.0)
        for number, group in enumerate(groups):
            for i in group:
                base[i] = changes[number] / step[i]
                base[i][~self._felt(entries[i].joints)] = 0.0
        return Linear(coordinates, point, reducers, variance, lacking, base)

    def reducers(
        self, coordinates: Coordinates, point: np.ndarray, here: Sequence[np.ndarray] | None = None
    ) -> tuple[tuple[Reducer, ...], tuple[np.ndarray, ...]]:
        """What makes rows of residuals around a point, and the variance of their torques, by limb.

        Args:
            here: whitened errors at the point, where they are known.
        """
        here = self.at(coordinates, point[None]) if here is None else here
        filters = self._filters(coordinates, point)
        nuisances = self._nuisances(coordinates, point, [one[0] for one in here], filters)
        both = zip(self.limbs, nuisances, strict=True)
        made = [reducer(n, filters[limb], self.engine.period) for limb, n in both]
        return tuple(m[0] for m in made), tuple(m[1] for m in made)

    def of_model(self, model: RobotModel) -> list[np.ndarray]:
        """Whitened errors of a model as it is, by limb ``[1, window, residual]``."""
        errors = self.errors(model, {}, 1)
        self.forget()
        return errors

    def forget(self) -> None:
        """Drop what is kept of a model for further simulations."""
        for part in (self.engine, *self._parts):
            part.forget()

    def _felt(self, joints: tuple[int, ...] | None) -> np.ndarray:
        """Which judged joints feel a change in some: those of their limbs, ``[joint]``."""
        if joints is None:
            return np.ones(len(self.judged), bool)
        limbs = {self.limb_of.get(j) for j in joints}
        return np.array([self.limb_of[int(j)] in limbs for j in self.judged])

    def _together(self, entries: Sequence[Coordinate]) -> list[list[int]]:
        """Numbers that one simulation moves at once: those of the same slot of every limb."""
        local: dict[tuple, list[int]] = {}
        for i, entry in enumerate(entries):
            alone = entry.joints is not None and len(entry.joints) == 1
            if alone and entry.joints[0] not in self.limb_of:  # type: ignore[index]
                continue
            key = (entry.parameter, entry.kind, self.slot_of[entry.joints[0]]) if alone else (i,)  # type: ignore[index]
            local.setdefault(key, []).append(i)
        return list(local.values())

    def _filters(self, coordinates: Coordinates, point: np.ndarray) -> np.ndarray:
        """What every servo's filter makes of velocities, ``[joint, tick, tick]``."""
        known = coordinates.model.tensors(self.engine.joints) | coordinates.values(point[None])
        lags, shapes = (
            np.broadcast_to(known[name][0].numpy() if name in known else 0.0, self.count).tolist()
            for name in ("velocity_time_constant", "velocity_filter_shape")
        )
        once = cache(lambda lag, shape: filtered(lag, shape, self.ticks, self.engine.period))
        return np.stack([once(lag, shape) for lag, shape in zip(lags, shapes, strict=True)])

    def _nuisances(
        self, coordinates: Coordinates, point: np.ndarray, left: list[np.ndarray], filters: np.ndarray
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
        known = coordinates.model.tensors(self.engine.joints) | values
        armature = known["armature"][0].numpy() if "armature" in known else np.zeros(1)
        armature, loop = np.broadcast_to(armature, self.count), "current_pd" not in coordinates.model.effect_names
        result = []
        for k, limb in enumerate(self.limbs):
            n = len(limb)
            change = error[k][1:] - error[k][:1]
            initial = np.concatenate([change[:n], change[size : size + n]])
            own = filters[limb]
            torque = torque_responses(self.engine, limb, armature, loop, initial, left[k], own, self.unit, self.floor)
            result.append(np.moveaxis(np.concatenate([initial, torque]), 0, -1))
        return result

    def reduce(self, reducers: Sequence[Reducer], errors: Sequence[np.ndarray]) -> np.ndarray:
        """Whitened errors by limb as rows, ``[set, joint, window, row]``: torques, currents, rates, means first."""
        parts = []
        for one, error, limb in zip(reducers, errors, self.limbs, strict=True):
            sets, n = len(error), len(limb)
            torque = np.moveaxis(np.matmul(one.torque, np.moveaxis(error, 0, -1)), -1, 0)
            torque = torque.reshape(sets, self.windows, n, PIECES)
            position, velocity, current = np.moveaxis(error.reshape(sets, self.windows, self.ticks + 1, n, 3), -1, 0)
            current = np.einsum("pt,swtj->swjp", self._mean, current)
            rate = np.einsum("pt,swtj->swjp", self._read, velocity)
            rate -= np.einsum("jpt,swtj->swjp", one.moved, position, optimize=True)
            rate[(np.abs(position) >= FARTHEST).any(2)] = 0.0  # who is that far off tells no rate
            rows = [kind @ linalg.helmert(kind.shape[-1], full=True).T for kind in (torque, current, rate)]
            rows = np.concatenate(rows, -1)
            parts.append(np.moveaxis(rows, 2, 1))
        return np.concatenate(parts, 1).astype(np.float32)

    def columns(self, linear: Linear, found: Sequence[Candidate], progress=None) -> np.ndarray:
        """What the secant of each candidate in one joint, or in all, does, ``[candidate, joint, window, row]``."""
        result = np.zeros((len(found), *linear.lacking.shape), np.float32)
        base = linear.coordinates.values(linear.point[None])
        models: dict[int, dict[tuple, list[int]]] = {}
        for i, one in enumerate(found):
            slot = self.slot_of[one.joints[0]] if one.joints else None
            models.setdefault(id(one.model), {}).setdefault((one.shape, slot), []).append(i)
        done = 0
        for groups in models.values():
            for begin in range(0, len(groups), CHUNK - 1):
                members = list(groups.values())[begin : begin + CHUNK - 1]
                self._simulate(linear, found, members, base, result)
                done += len(members)
                if progress is not None:
                    progress(done / sum(map(len, models.values())))
            self.forget()
        return result

    def _simulate(
        self, linear: Linear, found: Sequence[Candidate], members: list[list[int]], base, result: np.ndarray
    ) -> None:
        """Columns of candidates of one model, those of a group in one simulation."""
        model = found[members[0][0]].model
        start = model.tensors(self.engine.joints) | base
        known = model.parameters()
        start = {
            name: value.expand(1, self.count).clone() if known[name.split("@")[0]].per_joint else value
            for name, value in start.items()
        }
        sets = [start]
        for group in members:
            moved = start
            for i in group:
                moved = found[i].moved(moved)
            sets.append(moved)
        values = {name: torch.cat([one[name] for one in sets]) for name in sets[0]}
        times = any(_is_time(name) for group in members for name in found[group[0]].secant)
        error = self.errors(model, values, len(sets), 1 if times else COARSE)
        changes = self.reduce(linear.reducers, [one[1:] - one[:1] for one in error])
        for number, group in enumerate(members):
            for i in group:
                result[i] = changes[number]
                result[i][~self._felt(found[i].joints)] = 0.0

    def rows(self, linear: Linear, columns: Sequence[np.ndarray], like: Rows | None = None) -> Rows:
        """Everything the judge needs, of the base and columns ``[joint, window, row]`` of candidates in one joint or in
        all; variances are kept of those that it is to be `like`, so that evidences compare."""
        torque, current, rate = (self.kinds // 2 == group for group in range(3))
        spread = np.concatenate([one.T for one in linear.variance])  # [joint, window]
        known = (spread < UNKNOWN) & self.moving[self.judged][:, None]
        variance = np.where(known, spread, np.inf)[..., None] + np.zeros(len(self.kinds))
        variance[..., torque] += self._on_edge(linear)[..., None]
        recorded = (self.moving & self.engine.known[:, 2])[self.judged]
        variance[..., current] = np.where(recorded, PIECES / self.ticks, np.inf)[:, None, None]
        both = (self.moving & self.engine.known[:, :2].all(1))[self.judged]
        rounded = np.array([rounding(self._read, moved) for one in linear.reducers for moved in one.moved])
        variance[..., rate] = np.where(both[:, None], rounded, np.inf)[:, None]
        variance = variance if like is None else like.variance
        kept, values = [], []
        for j in range(len(self.judged)):
            mine = np.stack([*linear.base[:, j], *(column[j] for column in columns)])
            kept.append(np.flatnonzero(np.abs(mine).max((1, 2)) > 0))
            values.append(self.tamed(mine[kept[-1]]))
        measured = np.where(np.isfinite(variance), linear.lacking, 0.0)
        names = tuple(self.engine.joints[j] for j in self.judged)
        return Rows(names, self.kinds, measured, variance, self.features, tuple(kept), tuple(values))

    def tamed(self, columns: np.ndarray) -> np.ndarray:
        """A joint's columns ``[column, window, row]`` without what is wild of windows on the edge of sticking."""
        result = columns.copy()
        for group in range(3):
            kinds = self.kinds // 2 == group
            usual = np.quantile(np.abs(columns[..., kinds]), 0.97, axis=(1, 2), keepdims=True)
            result[..., kinds] = np.clip(columns[..., kinds], -8 * usual - 0.5, 8 * usual + 0.5)
        return result

    def _on_edge(self, linear: Linear) -> np.ndarray:
        """Variance of windows on the edge of sticking, which little moves far, ``[joint, window]``."""
        s, extra = self.settings, 0.0
        for entry, value, column in zip(linear.coordinates.entries, linear.point, linear.base, strict=True):
            if entry.joints is None and entry.kind == "value" and entry.low >= 0:  # a share of an angle says nothing
                moved = np.square(s.edge_share * value * column[..., self.kinds < 2].astype(np.float64)).mean(-1)
                extra = extra + np.maximum(moved - np.quantile(moved, 0.75, axis=1, keepdims=True), 0.0)
        return s.edge**2 * np.minimum(extra, 0.9 * UNKNOWN)

    @cached_property
    def features(self) -> np.ndarray:
        """Of what joints do and nobody explains, ``[joint, window, row, feature]``."""
        return features(self.engine, self.judged, self.unit, self.settings)


def _is_time(name: str) -> bool:
    """Whether a parameter is a time."""
    return parameter(split_name(name)[0]).unit == "s"
