"""Errors of a model's open-loop predictions of logs, per channel, joint and trajectory, with intervals."""

from collections import defaultdict
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
"""With fewer logs, each log is cut into blocks, and the bootstrap draws blocks instead of logs."""

BLOCKS = 10
"""Blocks of equal length per log."""

Array = NDArray[np.float64]

ERROR, EQ7 = ("error_mrad",), ("paper_eq7",)
CHANNEL, JOINT, TRAJECTORY = "channel", "joint", "trajectory"
"""Kinds of errors, each followed by channel, channel and joint, or motion."""


@dataclass(frozen=True, eq=False)
class LogScore:
    """Error of a model on one log.

    Attributes:
        error_mrad: mean absolute joint position error [mrad]; None if the simulation diverged.
        paper_eq7: paper eq. (7) with unit weights; None if the simulation diverged.
        seen: whether the model was fitted to this log.
    """

    log: Rollout
    error_mrad: float | None
    paper_eq7: float | None
    seen: bool


@dataclass(frozen=True, eq=False)
class PredictionScore:
    """Errors of open-loop predictions of logs, each with its 90 % interval.

    Attributes:
        error_mrad: mean absolute joint position error, averaged over logs [mrad].
        paper_eq7: paper eq. (7) with unit weights, averaged over logs.
        channels: root mean square error by channel, in the channel's unit.
        joints: root mean square error by channel, and joint or axis.
        trajectories: position error by motion [mrad].
        clusters: units of the bootstrap: ``logs`` or ``blocks``.
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
    """Replay logs open loop with a model, and measure the errors.

    With at least `FEWEST_LOGS` logs, the bootstrap draws whole logs with replacement, because rows of one log are not
    independent. With fewer logs, it draws from `BLOCKS` blocks per log, so the intervals do not cover other motions.

    Args:
        model: model; for logs that meet a condition, values under this condition replace shared values.
        joints: compared joints; empty: all joints of a log.
        bench_timestep: simulation step of bench logs [s].

    Raises:
        LogError: if a log does not contain a joint, or a command that the model's servos need.
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
    """Measure the errors of given predictions; see `predict_logs`."""
    loss = TrajectoryLoss(tuple(joints))
    blocks = 1 if len(predictions) >= FEWEST_LOGS else BLOCKS
    scores, pooled = [], defaultdict(list)
    for prediction in predictions:
        seen = was_fitted(model, prediction.log)
        if bool(prediction.failed.any()):
            scores.append(LogScore(prediction.log, None, None, seen))
            continue
        weights, errors = _cluster_errors(loss, prediction, blocks)
        for key, values in errors.items():
            pooled[key].append((values, weights))
        mrad, eq7 = (float(weights @ errors[key] / weights.sum()) for key in (ERROR, EQ7))
        scores.append(LogScore(prediction.log, mrad, eq7, seen))
    means = {key: _mean(parts, seed) for key, parts in pooled.items()}
    channels = {key[1]: _root(mean) for key, mean in means.items() if key[0] == CHANNEL}
    return PredictionScore(
        logs=scores,
        error_mrad=means.get(ERROR),
        paper_eq7=means.get(EQ7),
        channels=channels,
        joints={c: {k[2]: _root(mean) for k, mean in means.items() if k[:2] == (JOINT, c)} for c in channels},
        trajectories={key[1]: mean for key, mean in means.items() if key[0] == TRAJECTORY},
        clusters="logs" if blocks == 1 else "blocks",
        predictions=predictions,
        simulated_seconds=simulated_seconds,
    )


def was_fitted(model: RobotModel, log: Rollout) -> bool:
    """Whether a model was fitted to this log, according to the model file."""
    return log.fingerprint() in (model.provenance.get("fitted_logs") or ())


def _cluster_errors(
    loss: TrajectoryLoss, prediction: Prediction, blocks: int
) -> tuple[Array, dict[tuple[str, ...], Array]]:
    """One log divided into clusters ``[cluster]``: weights with sum one, and mean errors by kind.

    Errors of channels and joints are mean squares.
    """
    log = prediction.log
    differences = {"/".join(key): d[0].numpy() for key, d in loss.differences(prediction).items()}
    rows, columns = len(next(iter(differences.values()))), loss.columns(log)
    number = np.minimum(np.arange(rows) * blocks // rows, blocks - 1)
    members = [number == block for block in range(blocks) if (number == block).any()]
    mrad = np.array([1e3 * np.abs(differences["joint/position"][m]).mean() for m in members])
    motion = log.metadata.motion or log.metadata.recording or "log"
    errors: dict[tuple[str, ...], Array] = {ERROR: mrad, EQ7: np.zeros(len(members)), (TRAJECTORY, motion): mrad}
    axes = {"imu/orientation": ["roll", "pitch"], "imu/angular_velocity": ["x", "y", "z"]}
    for key, difference in differences.items():
        squares = np.array([np.square(difference[m]).mean(0) for m in members])
        body = key.startswith("imu/")
        names = axes[key] if body else [log.joints[column] for column in columns if log.measured(key)[column]]
        errors |= {(CHANNEL, key): squares.mean(1)} | {(JOINT, key, n): squares[:, i] for i, n in enumerate(names)}
        # eq. (7) uses the length of the body's vectors and the mean over joints
        errors[EQ7] = errors[EQ7] + (squares.sum(1) if body else squares.mean(1))
    return np.array([m.mean() for m in members]), errors


def _mean(parts: Sequence[tuple[Array, Array]], seed: int) -> Estimate:
    """Weighted mean over the clusters of all logs, with its interval."""
    values, weights = (np.concatenate(each) for each in zip(*parts, strict=True))
    low, high = bootstrap_interval(values, weights, seed=seed)
    return Estimate(float(weights @ values / weights.sum()), low, high)


def _root(mean: Estimate) -> Estimate:
    """A root mean square from a mean square."""
    low, high = (None if end is None else float(np.sqrt(end)) for end in (mean.low, mean.high))
    return Estimate(float(np.sqrt(mean.value)), low, high)
