"""The gap in windows of runs that nothing was chosen by, in three stages: given model, baseline fit, returned model.

Windows of 0.2 s are those that names are decided by: they start from the measured state and get the commands of the
log. Those of the horizons start there too, and the controller acts on what is simulated, as in a policy's rollout.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from op3.diagnose.base import Baseline
from op3.diagnose.reduction import Reduction
from op3.diagnose.split import LogSplit
from op3.replay.windows import LENGTHS, WindowResiduals
from op3.rollout import Rollout
from op3.servo import RobotModel

STAGES = ("given", "baseline", "returned")
"""Models whose gap is shown."""

HORIZONS = (0.25, 0.5, 1.0, 6.0)
"""Lengths of closed-loop windows [s]: those of ASAP (He et al. 2025), BAM (Duclusaud et al. 2025) and PACE (Bjelonic et
al. 2025)."""

ROOM = 0.2
"""By how much a run has to be longer than a window [s]."""

PER_LOG = 6
"""Windows of each run."""

CHANNELS = {"position": "rad", "current": "A", "torque": "N m"}
"""What is compared, and units."""

FARTHEST = {"position": 0.5, "current": 5.0}
"""Where errors of a window end, which has diverged."""


@dataclass(frozen=True)
class StageGap:
    """An error under the three models, root mean square.

    Attributes:
        unit: of all.
        given: under the given model.
        baseline: under the given model refitted, without new effects.
        returned: under the model with the findings.
        floor: how far repeats of a command differ, from the same state; None without repeats.
        signal: root mean square of what is predicted.
    """

    unit: str
    given: float
    baseline: float
    returned: float
    floor: float | None
    signal: float

    @property
    def percent(self) -> dict[str, float]:
        """Errors as shares of the signal [%]."""
        return {stage: 100.0 * getattr(self, stage) / max(self.signal, 1e-12) for stage in STAGES}


@dataclass(frozen=True, eq=False)
class WindowGaps:
    """Errors in windows of held-out runs.

    Attributes:
        length: of the windows [s].
        runs: how many.
        joints: by joint and channel.
        whole: over all joints, by channel.
        horizons: over all joints, angle in closed loop, by length of the window [s].
    """

    length: float
    runs: int
    joints: Mapping[str, Mapping[str, StageGap]]
    whole: Mapping[str, StageGap]
    horizons: Mapping[float, StageGap]

    @property
    def worse(self) -> list[str]:
        """Joints whose angle the baseline fit predicts worse than the given model, by more than a tenth."""
        return [joint for joint, of in self.joints.items() if of["position"].baseline > 1.1 * of["position"].given]


def window_gaps(
    models: Sequence[RobotModel], base: Baseline, split: LogSplit, logs: Sequence[Rollout]
) -> WindowGaps | None:
    """Errors of the given model, the baseline fit and the returned model; None where no log is as long as a window.

    Args:
        models: in that order.
        base: the baseline fit, whose responses turn errors into torques.
        split: of the logs, whose repeats tell the floor.
        logs: that show.
    """
    logs = [log for log in logs if log.duration >= LENGTHS[log.metadata.mount] + ROOM]
    if not logs:
        return None
    engine = WindowResiduals(logs, windows=PER_LOG * len(logs))
    reduction = Reduction(engine)
    errors = [_errors(engine, model) for model in models]
    squares, signal = {}, {}
    for number, name in ((0, "position"), (2, "current")):
        if engine.known[:, number].any():
            kept = [np.square(np.clip(error[..., number], -FARTHEST[name], FARTHEST[name])) for error in errors]
            squares[name] = np.stack([np.where(engine.known[:, number], one, np.nan).mean((0, 1)) for one in kept])
            values = engine.measured[..., number]
            values = values - values[:, :1] if name == "position" else values
            signal[name] = np.square(values).mean((0, 1))
    torque = _torques(reduction, base, models) if reduction.limbs else {}
    floors = _floors(split, engine.ticks)
    joints: dict[str, dict[str, StageGap]] = {}
    for j, joint in enumerate(engine.joints):
        of = {
            name: _stage(CHANNELS[name], squares[name][:, j], floors.get(name, {}).get(joint), signal[name][j])
            for name in squares
            if np.isfinite(squares[name][:, j]).all()
        }
        if joint in torque:
            of["torque"] = _stage("N m", *torque[joint])
        if "position" in of:
            joints[joint] = of
    return WindowGaps(
        engine.ticks * engine.period, len(logs), joints, _over_joints(joints), _horizons(models, logs, split)
    )


def _stage(unit: str, squares: np.ndarray, floor: float | None, signal: float) -> StageGap:
    given, baseline, returned = (float(np.sqrt(one)) for one in squares)
    return StageGap(unit, given, baseline, returned, floor, float(np.sqrt(signal)))


def _over_joints(joints: Mapping[str, Mapping[str, StageGap]]) -> dict[str, StageGap]:
    """Root mean squares over joints, by channel."""

    def over(parts: Sequence[StageGap], name: str) -> float | None:
        known = [value for one in parts if (value := getattr(one, name)) is not None]
        return float(np.sqrt(np.mean(np.square(known)))) if known else None

    by_channel = {name: [of[name] for of in joints.values() if name in of] for name in CHANNELS}
    fields = (*STAGES, "floor", "signal")
    return {
        name: StageGap(CHANNELS[name], *(over(parts, field) for field in fields))  # type: ignore[arg-type]
        for name, parts in by_channel.items()
        if parts
    }


def _errors(engine: WindowResiduals, model: RobotModel) -> np.ndarray:
    """Simulated minus measured, ``[window, tick, joint, channel]``."""
    error = engine.errors(model)[0]
    engine.forget()
    return error


def _torques(
    reduction: Reduction, base: Baseline, models: Sequence[RobotModel]
) -> dict[str, tuple[np.ndarray, float | None, float]]:
    """Mean squares of the torques that joints lack under the models, the sensors' floor and the load's mean square."""
    reducers, variance = reduction.reducers(base.coordinates, base.point)
    squares, mean = [], reduction.kinds < 2
    for model in models:
        rows = reduction.reduce(reducers, reduction.of_model(model))[0][..., mean]
        squares.append(np.square(np.clip(rows, -100.0, 100.0)).mean((1, 2)) * reduction.unit**2)
    known = np.concatenate([one.T for one in variance])  # [joint, window]
    result = {}
    for j, at in enumerate(reduction.judged):
        if reduction.moving[at]:
            floor = float(np.sqrt(np.median(known[j])) * reduction.unit)
            result[reduction.engine.joints[at]] = (
                np.array([one[j] for one in squares]),
                floor,
                reduction.loads[j] ** 2,
            )
    return result


def _floors(split: LogSplit, ticks: int) -> dict[str, dict[str, float]]:
    """How far repeats of a command differ within a window of so many ticks from one state, by channel and joint."""
    result: dict[str, dict[str, float]] = {}
    for name in ("position", "current"):
        squares = []
        for group in split.repeats:
            if any(("joint", name) not in split.show[i] for i in group):
                continue
            rows = min(split.show[i].rows for i in group)
            values = np.stack([split.show[i].array(f"joint/{name}")[:rows] for i in group])
            apart = values - values.mean(0)
            starts = np.arange(0, rows - ticks, ticks)
            if not len(starts):
                continue
            pieces = np.stack([apart[:, start : start + ticks + 1] for start in starts])
            if name == "position":  # all begin where they were measured
                pieces = pieces - pieces[:, :, :1]
            squares.append(np.square(pieces).mean((0, 1, 2)) * len(group) / (len(group) - 1))
        if squares:
            both = zip(split.show[0].joints, np.mean(squares, 0), strict=True)
            result[name] = {joint: float(np.sqrt(square)) for joint, square in both}
    return result


def _horizons(models: Sequence[RobotModel], logs: Sequence[Rollout], split: LogSplit) -> dict[float, StageGap]:
    """Errors of angles in closed loop over longer windows, as long as the runs last."""
    result = {}
    for length in HORIZONS:
        long = [log for log in logs if log.duration >= length + ROOM]
        if not long:
            continue
        engine = WindowResiduals(
            long, windows=max(1, min(PER_LOG, int(2.0 / length))) * len(long), length=length, closed=True
        )
        errors = np.stack([_errors(engine, model)[..., 0] for model in models])
        square = np.square(np.clip(errors, -FARTHEST["position"], FARTHEST["position"]))[..., engine.known[:, 0]]
        moved = engine.measured[..., 0] - engine.measured[:, :1, :, 0]
        floors = _floors(split, engine.ticks).get("position", {})
        floor = float(np.sqrt(np.mean(np.square(list(floors.values()))))) if floors else None
        result[length] = _stage("rad", square.mean((1, 2, 3)), floor, float(np.square(moved).mean()))
    return result


def gap_table(gaps: WindowGaps) -> str:
    """Errors in three stages as lines of text: by channel, joint and horizon."""
    head = "".join(f"{name:>10}" for name in (*STAGES, "repeats"))
    lines = [f"{f'RMS error, {gaps.length:.2g} s windows':24}{head}"]

    def line(label: str, one: StageGap) -> str:
        values = (one.given, one.baseline, one.returned, one.floor)
        cells = "".join(f"{'-' if value is None else format(1e3 * value, '.2f'):>10}" for value in values)
        return f"{label:24}{cells}  m{one.unit}"

    lines += [line(name, one) for name, one in gaps.whole.items()]
    lines += [line(f"  position {joint}", of["position"]) for joint, of in gaps.joints.items()]
    lines += [line(f"position, {length:g} s windows", one) for length, one in gaps.horizons.items()]
    return "\n".join(lines)


def plain_gaps(gaps: WindowGaps) -> dict[str, Any]:
    """The content of ``verdict.yaml``: errors in SI units, and as shares of what is predicted [%]."""

    def entry(one: StageGap) -> dict[str, Any]:
        return vars(one) | {"percent": one.percent}

    return {
        "length": gaps.length,
        "runs": gaps.runs,
        "joints": {joint: {name: entry(one) for name, one in of.items()} for joint, of in gaps.joints.items()},
        "whole": {name: entry(one) for name, one in gaps.whole.items()},
        "horizons": {f"{1e3 * length:g} ms": entry(one) for length, one in gaps.horizons.items()},
    }
