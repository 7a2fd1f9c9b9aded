"""Free runs of models on logs that they were not fitted to: which predicts best, and the gap before and after.

A velocity that is measured late is compared with the simulation as late as it is, of which a model's own filter is a
part: the measuring chain explains that much, and a gain in angle is not thrown away for it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from op3.diagnose.smoothing import smooth as smoothed
from op3.diagnose.smoothing import velocity_sensing
from op3.diagnose.split import LogSplit
from op3.identify.loss import TrajectoryLoss
from op3.intervals import bootstrap_interval
from op3.rollout import Rollout
from op3.servo import RobotModel
from op3.tasks import Prediction, Replay
from op3.tasks.planned import with_whole_limbs

REPEATS = 2
"""Repeats of one command that are simulated; all of them tell the floor."""

CHANNELS = {("joint", "position"): "rad", ("joint", "velocity"): "rad/s", ("joint", "current"): "A"}
"""Channels whose gap is shown, and their units."""

ASTRAY = 5.0
"""Times the base's root mean square in a channel beyond which a run that went astray counts no more."""

SETTLE = 0.2
"""Time for which the first command is held before a replay begins [s]."""


def settle_time(logs: Sequence[Rollout]) -> float:
    """How long the first command of logs is held before their replay [s]: not at all where nothing holds the joints."""
    held = [bool((log.array("command/torque_enable")[0] > 0.5).all()) for log in logs if "command/torque_enable" in log]
    return SETTLE if all(held) else 0.0


class FreeRuns:
    """Closed-loop predictions of whole logs, from their first rows and commands alone.

    Args:
        logs: that are predicted.
    """

    def __init__(self, logs: Sequence[Rollout]):
        self.logs = list(logs)
        # a few logs keep one thread busy; handing their steps to more took three times the processor time
        self._replay = Replay([with_whole_limbs(log) for log in logs], settle=settle_time(logs), num_threads=1)
        self.channels = {key: unit for key, unit in CHANNELS.items() if all(key in log for log in logs)}
        self._lag = np.zeros(len(logs[0].joints))
        if ("joint", "velocity") in self.channels:
            self._lag = velocity_sensing([smoothed(log) for log in logs]).lag

    def of(self, model: RobotModel) -> list[Prediction]:
        """Predictions of one model, velocities as late as the logs' are."""
        predictions, joints = self._replay.run(model), self.logs[0].joints
        if ("joint", "velocity") not in self.channels:
            return predictions
        known = model.tensors(joints).get("velocity_time_constant")
        own = np.zeros(len(joints)) if known is None else np.broadcast_to(known[0].numpy(), len(joints))
        return [self._late(one, np.maximum(self._lag - own, 0.0)) for one in predictions]

    def _late(self, prediction: Prediction, lags: np.ndarray) -> Prediction:
        """A prediction with velocities later by some times, ``[joint]``."""
        key, time = ("joint", "velocity"), prediction.log.array("time")[:, 0]
        values = prediction.channels[key].clone()
        for joint, lag in zip(self.logs[0].joints, lags, strict=True):
            column = values[..., prediction.log.joints.index(joint)][0]
            now = time[: len(column)]
            column[:] = torch.from_numpy(np.interp(now - lag, now, column.numpy()))
        return replace(prediction, channels={**prediction.channels, key: values})

    def squares(self, predictions: Sequence[Prediction], key: tuple[str, str]) -> list[np.ndarray]:
        """Mean squares of a channel by log, ``[second]`` each, means over the joints of which it was measured."""
        both = zip(self.errors(predictions, key), self.logs, strict=True)
        return [by_second(error[:, log.measured(key)].mean(1), log) for error, log in both]

    def errors(self, predictions: Sequence[Prediction], key: tuple[str, str]) -> list[np.ndarray]:
        """Squared errors of a channel by log, ``[row, joint]`` each."""
        result = []
        for prediction, log in zip(predictions, self.logs, strict=True):
            columns = [prediction.log.joints.index(joint) for joint in log.joints]
            simulated = prediction.channels[key][0].numpy()[:, columns]
            error = np.square(simulated - log.array(key)[: len(simulated)])
            result.append(np.nan_to_num(error, nan=1e6, posinf=1e6))
        return result


def by_second(values: np.ndarray, log: Rollout) -> np.ndarray:
    """Means over the seconds of a log's first rows, ``[second]``."""
    time = log.array("time")[: len(values), 0]
    second = (time - time[0]).astype(int)
    return np.array([values[second == s].mean() for s in np.unique(second)])


def choose(models: Sequence[RobotModel], logs: Sequence[Rollout]) -> dict[str, Any]:
    """Which of nested models, simplest first, predicts withheld logs best: the one standard error rule.

    What a model leaves of a run is, in every channel, its mean square by that of the first model, the mean over
    channels. The simplest is taken that is not worse than the best by more than a standard error of their difference
    over runs (Breiman et al. 1984; of few runs over seconds), and never one that is worse than a simpler one.

    Returns:
        ``taken``, its number; ``left``, by model; ``channels``, by model and channel, root mean squares.
    """
    runs = FreeRuns(logs)
    predictions = [runs.of(model) for model in models]
    table, channels = [], []
    for prediction in predictions:
        parts, roots = [], {}
        for key in runs.channels:
            squares = runs.squares(prediction, key)
            usual = np.mean(np.concatenate(runs.squares(predictions[0], key)))
            kept = [np.minimum(one / max(usual, 1e-12), ASTRAY**2) for one in squares]
            parts.append(np.array([one.mean() for one in kept]) if len(logs) >= 5 else np.concatenate(kept))
            roots["/".join(key)] = float(np.sqrt(np.mean(np.concatenate(squares))))
        table.append(np.mean(parts, axis=0))
        channels.append(roots)
    left = [float(row.mean()) for row in table]
    best = int(np.argmin(left))
    taken = best
    for number in range(best):
        apart = table[number] - table[best]
        error = float(apart.std(ddof=1) / np.sqrt(len(apart))) if len(apart) > 1 else 0.0
        if left[number] - left[best] <= error:
            taken = int(np.argmin(left[: number + 1]))
            break
    return {"taken": taken, "left": [round(value, 4) for value in left], "channels": channels}


def show(before: RobotModel, after: RobotModel, split: LogSplit, seed: int = 0) -> dict[str, Any]:
    """Gaps of two models on the runs that show.

    Returns:
        ``gap`` by channel: ``before``, ``after`` and ``floor`` (how far repeats differ from their mean) as root mean
        squares with 90 % intervals over seconds, and ``better`` or ``worse`` if that is beyond chance; ``loss`` with
        ``paper_eq7`` before and after; and the predictions.
    """
    logs = shown_logs(split)
    runs = FreeRuns(logs)
    first = runs.of(before)
    second = first if after is before else runs.of(after)
    loss = TrajectoryLoss(tuple(logs[0].joints))
    gap = {}
    for key, unit in runs.channels.items():
        blocks = [np.concatenate(runs.squares(predictions, key)) for predictions in (first, second)]
        apart = blocks[0] - blocks[1]
        low, high = bootstrap_interval(apart, seed=seed)
        floor, change = _floor(split, key), "alike"
        if low is not None and high is not None:
            change = "better" if low > 0 else "worse" if high < 0 else "alike"
        entry: dict[str, Any] = {"unit": unit, "change": change}
        for name, squares in (("before", blocks[0]), ("after", blocks[1]), ("floor", floor)):
            entry[name] = None if squares is None else float(np.sqrt(squares.mean()))
            entry[f"{name}_interval"] = None if squares is None else _interval(squares, seed)
        entry["closure"] = _closure(entry)
        gap["/".join(key)] = entry
    told = {"name": "paper_eq7", "before": float(loss(first)[0]), "after": float(loss(second)[0])}
    return {"gap": gap, "loss": told, "before": first, "after": second}


def shown_logs(split: LogSplit) -> tuple[Rollout, ...]:
    """Logs that are simulated: no more than `REPEATS` of one command, as their free runs are nearly the same."""
    left_out = {i for group in split.repeats for i in group[REPEATS:]}
    return tuple(log for i, log in enumerate(split.show) if i not in left_out)


def _interval(blocks: np.ndarray, seed: int) -> list[float | None]:
    return [None if end is None else float(np.sqrt(max(end, 0.0))) for end in bootstrap_interval(blocks, seed=seed)]


def _floor(split: LogSplit, key: tuple[str, str]) -> np.ndarray | None:
    """Mean squares by which repeats of one command differ from their mean, by second, ``[block]``; None without any."""
    squares = []
    for group in split.repeats:
        rows = min(split.show[i].rows for i in group)
        values = np.stack([split.show[i].array(key)[:rows] for i in group])
        noise, first = np.square(values - values.mean(0)).sum(0) / (len(group) - 1), split.show[group[0]]
        squares.append(by_second(noise[:, first.measured(key)].mean(1), first))
    return np.concatenate(squares) if squares else None


def _closure(entry: Mapping[str, Any]) -> float | None:
    """Share of the gap above the floor that was closed; squares are what adds up."""
    floor = entry["floor"]
    if floor is None:
        return None
    before, after = (np.sqrt(max(entry[end] ** 2 - floor**2, 0.0)) for end in ("before", "after"))
    return float((before - after) / before) if before > 0 else None
