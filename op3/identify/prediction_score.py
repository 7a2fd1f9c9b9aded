"""How well a model predicts logs, with intervals: errors per channel, joint and trajectory of open-loop replays."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from op3.common.sample_intervals import bootstrap_interval
from op3.identify.loss import TrajectoryLoss
from op3.replay import Prediction, Replay
from op3.replay.setups import BENCH_CONTROL_PERIOD
from op3.rollout import Rollout
from op3.servo import Estimate, RobotModel

FEWEST_LOGS = 5
"""Fewer logs than this are each cut into blocks, and the bootstrap draws blocks instead of logs."""

BLOCKS = 10
"""Blocks of equal length per log."""


@dataclass(frozen=True, eq=False)
class LogScore:
    """What a model is worth on one log.

    Attributes:
        error_mrad: mean absolute joint position error [mrad]; None where the simulation diverged.
        paper_eq7: paper eq. (7) with unit weights; None where it diverged.
        seen: whether the model was fitted to this log.
    """

    log: Rollout
    error_mrad: float | None
    paper_eq7: float | None
    seen: bool


@dataclass(frozen=True, eq=False)
class PredictionScore:
    """How far open-loop predictions are from logs. Every error is an estimate with its 90 % interval.

    Attributes:
        logs: by log.
        error_mrad: mean absolute joint position error, averaged over logs [mrad].
        paper_eq7: paper eq. (7) with unit weights, averaged over logs.
        channels: root mean square error by channel, in the channel's unit.
        joints: the same by channel and joint or axis.
        trajectories: position error by motion [mrad].
        clusters: what was drawn by the bootstrap: ``logs`` or ``blocks``.
        predictions: one per log.
    """

    logs: Sequence[LogScore]
    error_mrad: Estimate | None
    paper_eq7: Estimate | None
    channels: Mapping[str, Estimate]
    joints: Mapping[str, Mapping[str, Estimate]]
    trajectories: Mapping[str, Estimate]
    clusters: str
    predictions: Sequence[Prediction]
    simulated_seconds: float


def predict_logs(
    model: RobotModel,
    logs: Sequence[Rollout],
    *,
    joints: Sequence[str] = (),
    bench_timestep: float = BENCH_CONTROL_PERIOD,
    seed: int = 0,
) -> PredictionScore:
    """Replay logs with a model, open loop, and measure what is left.

    Where there are at least `FEWEST_LOGS` logs, whole logs are drawn with replacement: rows of one log are not
    independent. Where there are fewer, each is cut into `BLOCKS` that are drawn; an interval then says nothing
    about other motions.

    Args:
        model: values that hold under a condition go before shared ones; a log whose condition the model does not know
            gets the shared value.
        joints: joints whose traces count; all of a log where empty.
        bench_timestep: simulation step of bench logs [s].

    Raises:
        LogError: if a log lacks a joint, or a command that the model's servos need.
    """
    replay = Replay(logs, bench_timestep=bench_timestep)
    return score_predictions(model, replay.run(model), joints=joints, seed=seed, simulated_seconds=replay.seconds)


def score_predictions(
    model: RobotModel,
    predictions: Sequence[Prediction],
    *,
    joints: Sequence[str] = (),
    seed: int = 0,
    simulated_seconds: float = 0.0,
) -> PredictionScore:
    """Measure what predictions of one candidate leave; see `predict_logs`."""
    loss = TrajectoryLoss(tuple(joints))
    blocks = 1 if len(predictions) >= FEWEST_LOGS else BLOCKS
    parts = [_cut(loss, prediction, blocks) for prediction in predictions]
    good = [part for part in parts if part is not None]
    scores = []
    for prediction, part in zip(predictions, parts, strict=True):
        mrad = None if part is None else float((part.weights @ part.error_mrad) / part.weights.sum())
        eq7 = None if part is None else float((part.weights @ part.paper_eq7) / part.weights.sum())
        scores.append(LogScore(prediction.log, mrad, eq7, was_fitted(model, prediction.log)))
    summary = _Summary(good, seed)
    return PredictionScore(
        logs=scores,
        error_mrad=summary.mean([part.error_mrad for part in good]) if good else None,
        paper_eq7=summary.mean([part.paper_eq7 for part in good]) if good else None,
        channels={key: summary.root(key) for key in summary.names},
        joints={key: {name: summary.root(key, name) for name in names} for key, names in summary.names.items()},
        trajectories=summary.trajectories(),
        clusters="logs" if blocks == 1 else "blocks",
        predictions=predictions,
        simulated_seconds=simulated_seconds,
    )


def was_fitted(model: RobotModel, log: Rollout) -> bool:
    """Whether a model's file says that it was fitted to this log."""
    return log.fingerprint() in (model.provenance.get("fitted_logs") or ())


@dataclass(frozen=True, eq=False)
class _Cut:
    """One log in clusters: a weight that adds up to one per log, and means over the cluster's rows."""

    log: Rollout
    weights: NDArray[np.float64]
    error_mrad: NDArray[np.float64]
    paper_eq7: NDArray[np.float64]
    squares: Mapping[str, NDArray[np.float64]]
    names: Mapping[str, list[str]]


def _cut(loss: TrajectoryLoss, prediction: Prediction, blocks: int) -> _Cut | None:
    if bool(prediction.failed.any()):
        return None
    log = prediction.log
    differences = {"/".join(key): d[0].numpy() for key, d in loss.differences(prediction).items()}
    rows = len(next(iter(differences.values())))
    number = np.minimum(np.arange(rows) * blocks // rows, blocks - 1)
    members = [number == block for block in range(blocks) if (number == block).any()]
    squares = {key: np.array([np.square(d[m]).mean(0) for m in members]) for key, d in differences.items()}
    columns = loss.columns(log)
    axes = {"imu/orientation": ["roll", "pitch"], "imu/angular_velocity": ["x", "y", "z"]}
    for key in [key for key in squares if key.startswith("joint/")]:
        kept = log.measured(key)[columns]
        axes[key] = [log.joints[column] for column, good in zip(columns, kept, strict=True) if good]
    # eq. (7) takes the body's vectors by their length and the joints on average
    terms = [s.sum(1) if key.startswith("imu") else s.mean(1) for key, s in squares.items()]
    return _Cut(
        log,
        np.array([m.mean() for m in members]),
        np.array([1e3 * np.abs(differences["joint/position"][m]).mean() for m in members]),
        np.sum(terms, axis=0),
        squares,
        {key: axes[key] for key in squares},
    )


class _Summary:
    """Estimates over all logs whose simulation did not diverge."""

    def __init__(self, parts: Sequence[_Cut], seed: int):
        self._parts = parts
        self._seed = seed
        self.names: dict[str, list[str]] = {key: names for part in parts for key, names in part.names.items()}

    def mean(self, values: Sequence[NDArray[np.float64]], parts: Sequence[_Cut] | None = None) -> Estimate:
        """Weighted mean over the clusters of parts."""
        weights = np.concatenate([part.weights for part in (parts or self._parts)])
        all_values = np.concatenate(values)
        low, high = bootstrap_interval(all_values, weights, seed=self._seed)
        return Estimate(float(weights @ all_values / weights.sum()), low, high)

    def root(self, key: str, name: str | None = None) -> Estimate:
        """Root mean square error of a channel, or of one joint or axis of it."""
        parts = [part for part in self._parts if key in part.squares and (name is None or name in part.names[key])]
        values = [
            part.squares[key].mean(1) if name is None else part.squares[key][:, part.names[key].index(name)]
            for part in parts
        ]
        mean = self.mean(values, parts)
        low, high = (None if end is None else float(np.sqrt(end)) for end in (mean.low, mean.high))
        return Estimate(float(np.sqrt(mean.value)), low, high)

    def trajectories(self) -> dict[str, Estimate]:
        """Position error by motion [mrad]."""
        by_motion: dict[str, list[_Cut]] = {}
        for part in self._parts:
            known = part.log.metadata
            by_motion.setdefault(known.motion or known.recording or "log", []).append(part)
        return {motion: self.mean([p.error_mrad for p in parts], parts) for motion, parts in by_motion.items()}
