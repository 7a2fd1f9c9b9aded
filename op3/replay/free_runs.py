"""Free-run simulation of whole logs: closed-loop predictions from their first rows and commands alone.

Simulated velocities get the delay of the measured velocities, which includes a model's filter, so that the measurement
delay does not count as a model error.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from op3.replay import Prediction, Replay
from op3.replay.planned import with_whole_limbs
from op3.replay.smoothing import smooth as smoothed
from op3.replay.smoothing import velocity_sensing
from op3.rollout import Rollout
from op3.servo import RobotModel

CHANNELS = {("joint", "position"): "rad", ("joint", "velocity"): "rad/s", ("joint", "current"): "A"}
"""Channels whose gap is shown, and their units."""

SETTLE = 0.2
"""Time for which the first command is held before a replay begins [s]."""


def settle_time(logs: Sequence[Rollout]) -> float:
    """Time for which the first command of logs is held before their replay [s]; zero without a controller."""
    held = [bool((log.array("command/torque_enable")[0] > 0.5).all()) for log in logs if "command/torque_enable" in log]
    return SETTLE if all(held) else 0.0


class FreeRuns:
    """Closed-loop predictions of whole logs, from their first rows and commands alone.

    Args:
        logs: logs to predict.
    """

    def __init__(self, logs: Sequence[Rollout]):
        self.logs = list(logs)
        # one thread is enough for a few logs; more threads took three times the processor time
        self._replay = Replay([with_whole_limbs(log) for log in logs], settle=settle_time(logs), num_threads=1)
        self.channels = {key: unit for key, unit in CHANNELS.items() if all(key in log for log in logs)}
        self._lag = np.zeros(len(logs[0].joints))
        if ("joint", "velocity") in self.channels:
            self._lag = velocity_sensing([smoothed(log) for log in logs]).lag

    def of(self, model: RobotModel) -> list[Prediction]:
        """Predictions of one model, with velocities delayed like those of the logs."""
        predictions, joints = self._replay.run(model), self.logs[0].joints
        if ("joint", "velocity") not in self.channels:
            return predictions
        known = model.tensors(joints).get("velocity_time_constant")
        own = np.zeros(len(joints)) if known is None else np.broadcast_to(known[0].numpy(), len(joints))
        return [self._late(one, np.maximum(self._lag - own, 0.0)) for one in predictions]

    def _late(self, prediction: Prediction, lags: np.ndarray) -> Prediction:
        """A prediction with velocities delayed by times ``[joint]`` [s]."""
        key, time = ("joint", "velocity"), prediction.log.array("time")[:, 0]
        values = prediction.channels[key].clone()
        for joint, lag in zip(self.logs[0].joints, lags, strict=True):
            column = values[..., prediction.log.joints.index(joint)][0]
            now = time[: len(column)]
            column[:] = torch.from_numpy(np.interp(now - lag, now, column.numpy()))
        return replace(prediction, channels={**prediction.channels, key: values})

    def squares(self, predictions: Sequence[Prediction], key: tuple[str, str]) -> list[np.ndarray]:
        """Mean squares of a channel by log, ``[second]`` each, averaged over the joints with measurements."""
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
    """Means over each second of a log's first rows, ``[second]``."""
    time = log.array("time")[: len(values), 0]
    second = (time - time[0]).astype(int)
    return np.array([values[second == s].mean() for s in np.unique(second)])
