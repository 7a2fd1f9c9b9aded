"""The gap of three models in windows of held-out runs: given model, baseline fit, returned model.

Windows of 0.2 s are simulated as in the fit: they start from the measured state and receive the commands of the log.
Longer windows (horizons) start there too, but the controller acts on the simulated state, as in a policy's rollout.
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
"""The three models."""

HORIZONS = (0.25, 0.5, 1.0, 6.0)
"""Lengths of closed-loop windows [s]: those of ASAP (He et al. 2025), BAM (Duclusaud et al. 2025) and PACE (Bjelonic et
al. 2025)."""

ROOM = 0.2
"""Numerical: a run must be longer than its windows by this time [s]."""

PER_LOG = 6
"""Budget: windows of each run."""

CHANNELS = {"position": "rad", "current": "A", "torque": "N m"}
"""Compared quantities and their units."""

LARGEST_ERROR = {"position": 0.5, "current": 5.0}
"""Numerical: range to which errors are clipped [rad, A], because simulations may diverge."""


@dataclass(frozen=True)
class StageGap:
    """RMS error of the three models.

    Attributes:
        unit: unit of all values.
        given: error of the given model.
        baseline: error of the baseline fit.
        returned: error of the returned model.
        floor: difference between repeats of a command from the same state, None without repeats; of torque, the
            resolution of the sensors.
        signal: RMS of the measured signal.
    """

    unit: str
    given: float
    baseline: float
    returned: float
    floor: float | None
    signal: float

    @property
    def percent(self) -> dict[str, float]:
        """Errors relative to the signal [%]."""
        return {stage: 100.0 * getattr(self, stage) / max(self.signal, 1e-12) for stage in STAGES}


@dataclass(frozen=True, eq=False)
class WindowGaps:
    """Errors in windows of held-out runs.

    Attributes:
        length: length of the windows [s].
        runs: number of runs.
        joints: errors by joint and channel.
        whole: errors over all joints, by channel.
        horizons: errors of the angle in closed loop over all joints, by length of the window [s].
    """

    length: float
    runs: int
    joints: Mapping[str, Mapping[str, StageGap]]
    whole: Mapping[str, StageGap]
    horizons: Mapping[float, StageGap]

    @property
    def worse(self) -> list[str]:
        """Joints whose angle error under the baseline fit is more than 10 % larger than under the given model."""
        angles = {joint: channels["position"] for joint, channels in self.joints.items()}
        return [joint for joint, gap in angles.items() if gap.baseline > 1.1 * gap.given]


def window_gaps(
    models: Sequence[RobotModel], base: Baseline, split: LogSplit, logs: Sequence[Rollout]
) -> WindowGaps | None:
    """Errors of three models; None if no log is as long as a window.

    Args:
        models: given model, baseline fit and returned model.
        base: the baseline fit, whose reduction converts errors to torques.
        split: split of the logs, whose repeats give the noise floor.
        logs: held-out logs.
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
            limit, recorded = LARGEST_ERROR[name], engine.known[:, number]
            square = [np.square(np.clip(error[..., number], -limit, limit)) for error in errors]
            squares[name] = np.stack([np.where(recorded, values, np.nan).mean((0, 1)) for values in square])
            values = engine.measured[..., number]
            values = values - values[:, :1] if name == "position" else values
            signal[name] = np.square(values).mean((0, 1))
    torque = _torques(reduction, base, models) if reduction.limbs else {}
    floors = _floors(split, engine.ticks)
    joints: dict[str, dict[str, StageGap]] = {}
    for j, joint in enumerate(engine.joints):
        channels = {
            name: _gap(CHANNELS[name], squares[name][:, j], floors.get(name, {}).get(joint), signal[name][j])
            for name in squares
            if np.isfinite(squares[name][:, j]).all()
        }
        if joint in torque:
            channels["torque"] = _gap("N m", *torque[joint])
        if "position" in channels:
            joints[joint] = channels
    return WindowGaps(
        engine.ticks * engine.period, len(logs), joints, _over_joints(joints), _horizons(models, logs, split)
    )


def _gap(unit: str, squares: np.ndarray, floor: float | None, signal: float) -> StageGap:
    """The RMS error from mean squares ``[model]``."""
    given, baseline, returned = np.sqrt(squares).tolist()
    return StageGap(unit, given, baseline, returned, floor, float(np.sqrt(signal)))


def _over_joints(joints: Mapping[str, Mapping[str, StageGap]]) -> dict[str, StageGap]:
    """RMS over joints, by channel."""

    def rms(gaps: Sequence[StageGap], field: str) -> float | None:
        values = [value for gap in gaps if (value := getattr(gap, field)) is not None]
        return float(np.sqrt(np.mean(np.square(values)))) if values else None

    by_channel = {name: [gaps[name] for gaps in joints.values() if name in gaps] for name in CHANNELS}
    fields = (*STAGES, "floor", "signal")
    return {
        name: StageGap(CHANNELS[name], *(rms(gaps, field) for field in fields))  # type: ignore[arg-type]
        for name, gaps in by_channel.items()
        if gaps
    }


def _errors(engine: WindowResiduals, model: RobotModel) -> np.ndarray:
    """Simulated minus measured, ``[window, tick, joint, channel]``."""
    error = engine.errors(model)[0]
    engine.forget()
    return error


def _torques(
    reduction: Reduction, base: Baseline, models: Sequence[RobotModel]
) -> dict[str, tuple[np.ndarray, float | None, float]]:
    """Mean square residual torques of the models, the sensors' floor and the mean square torque, by joint."""
    reducers, variance = reduction.reducers(base.coordinates, base.point)
    unit, torque_rows, squares = reduction.torque_unit, reduction.kinds < 2, []
    for model in models:
        rows = reduction.reduce(reducers, reduction.errors(model, {}, 1))[0][..., torque_rows]
        reduction.forget()
        squares.append(np.square(np.clip(rows, -100.0, 100.0)).mean((1, 2)) * unit**2)
    by_joint, result = np.concatenate([v.T for v in variance]), {}  # [joint, window]
    for j, column in enumerate(reduction.joint_indices):
        if reduction.moving[column]:
            floor = float(np.sqrt(np.median(by_joint[j])) * unit)
            of_models = np.array([square[j] for square in squares])
            result[reduction.engine.joints[column]] = of_models, floor, reduction.loads[j] ** 2
    return result


def _floors(split: LogSplit, ticks: int) -> dict[str, dict[str, float]]:
    """RMS difference of repeats of a command within windows from the same state, by channel and joint."""
    result: dict[str, dict[str, float]] = {}
    for name in ("position", "current"):
        squares = []
        for group in split.repeats:
            if any(("joint", name) not in split.show[i] for i in group):
                continue
            rows = min(split.show[i].rows for i in group)
            values = np.stack([split.show[i].array(f"joint/{name}")[:rows] for i in group])
            difference = values - values.mean(0)
            starts = np.arange(0, rows - ticks, ticks)
            if not len(starts):
                continue
            windows = np.stack([difference[:, start : start + ticks + 1] for start in starts])
            if name == "position":  # windows start from the measured state
                windows = windows - windows[:, :, :1]
            squares.append(np.square(windows).mean((0, 1, 2)) * len(group) / (len(group) - 1))
        if squares:
            floors = np.sqrt(np.mean(squares, 0)).tolist()
            result[name] = dict(zip(split.show[0].joints, floors, strict=True))
    return result


def _horizons(models: Sequence[RobotModel], logs: Sequence[Rollout], split: LogSplit) -> dict[float, StageGap]:
    """Closed-loop angle errors for every horizon that is not longer than the runs."""
    result = {}
    for length in HORIZONS:
        long = [log for log in logs if log.duration >= length + ROOM]
        if not long:
            continue
        engine = WindowResiduals(
            long, windows=max(1, min(PER_LOG, int(2.0 / length))) * len(long), length=length, closed=True
        )
        errors = np.stack([_errors(engine, model)[..., 0] for model in models])
        limit = LARGEST_ERROR["position"]
        square = np.square(np.clip(errors, -limit, limit))[..., engine.known[:, 0]]
        motion = engine.measured[..., 0] - engine.measured[:, :1, :, 0]
        floors = _floors(split, engine.ticks).get("position", {})
        floor = float(np.sqrt(np.mean(np.square(list(floors.values()))))) if floors else None
        result[length] = _gap("rad", square.mean((1, 2, 3)), floor, float(np.square(motion).mean()))
    return result


def gap_table(gaps: WindowGaps) -> str:
    """Errors of the three models as lines of text, by channel, joint and horizon."""
    head = "".join(f"{name:>10}" for name in (*STAGES, "repeats"))
    lines = [f"{f'RMS error, {gaps.length:.2g} s windows':24}{head}"]

    def line(label: str, gap: StageGap) -> str:
        values = (gap.given, gap.baseline, gap.returned, gap.floor)
        cells = "".join(f"{'-' if value is None else format(1e3 * value, '.2f'):>10}" for value in values)
        return f"{label:24}{cells}  m{gap.unit}"

    lines += [line(name, gap) for name, gap in gaps.whole.items()]
    lines += [line(f"  position {joint}", channels["position"]) for joint, channels in gaps.joints.items()]
    lines += [line(f"position, {length:g} s windows", gap) for length, gap in gaps.horizons.items()]
    return "\n".join(lines)


def plain_gaps(gaps: WindowGaps) -> dict[str, Any]:
    """The content of ``verdict.yaml``: errors in SI units and relative to the signal [%]."""

    def entry(gap: StageGap) -> dict[str, Any]:
        return vars(gap) | {"percent": gap.percent}

    return {
        "length": gaps.length,
        "runs": gaps.runs,
        "joints": {
            joint: {name: entry(gap) for name, gap in channels.items()} for joint, channels in gaps.joints.items()
        },
        "whole": {name: entry(gap) for name, gap in gaps.whole.items()},
        "horizons": {f"{1e3 * length:g} ms": entry(gap) for length, gap in gaps.horizons.items()},
    }
