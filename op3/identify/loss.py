"""Difference between a prediction and a log: the paper's loss, its terms, and residuals for least squares."""

from collections.abc import Mapping, Sequence
from dataclasses import field

import numpy as np
import torch
from torch import Tensor

from op3.common.settings import Listed, NotNegative, Positive, settings
from op3.replay import Prediction
from op3.rollout import CHANNELS, LogError, Rollout

UNIT_WEIGHTS: Mapping[tuple[str, str], float] = {
    ("imu", "orientation"): 1.0,
    ("imu", "angular_velocity"): 1.0,
    ("joint", "position"): 1.0,
    ("joint", "velocity"): 1.0,
    ("joint", "current"): 1.0,
}
"""Weights of paper eq. (7): one for every channel, in rad, rad/s and A."""

FAILED_RESIDUAL = 10.0
"""Residual of every sample of a diverged simulation; far larger than any real residual."""


@settings("loss")
class TrajectoryLoss:
    """Paper eq. (7), with a weight per channel.

    ``1/T sum_t (|r|^2 + |dr|^2) + 1/(N T) sum_t sum_i (q^2 + w^2 + I^2)`` with differences (simulated minus measured)
    of orientation r as roll and pitch [rad], body rates dr [rad/s], joint angles q [rad], velocities w [rad/s] and
    currents I [A] over N focusing joints and T rows. Missing channels are ignored.

    With a `robust_scale` c, a square d^2 is replaced by ``2 c (sqrt(d^2 + c^2) - c)``: it remains d^2 for small
    differences and grows like ``2 c |d|`` for large ones, so that a few outlying runs do not dominate (pseudo-Huber).

    Attributes:
        joints: focusing joints; empty: all joints of a log.
        weights: weights by channel; one in the paper.
        robust_scale: c, in the unit of the channels; None for squares.
        skip: time omitted at the beginning of a log [s], because the initial contact forces are not in the log but
            determine when the joints first break away.
    """

    joints: Listed[str] = ()
    weights: Mapping[tuple[str, ...], NotNegative] = field(default_factory=lambda: UNIT_WEIGHTS)
    robust_scale: Positive | None = None
    skip: NotNegative = 0.0

    def __post_init__(self):
        unknown = ", ".join("/".join(key) for key in self.weights if key not in CHANNELS)
        if unknown or not self.weights:
            names = ", ".join("/".join(key) for key in UNIT_WEIGHTS)
            raise ValueError(f"weights: unknown channel {unknown or 'list (empty)'}; use channels such as {names}")

    def columns(self, log: Rollout) -> list[int]:
        """Indices of the focusing joints in a log's joint axis.

        Raises:
            LogError: if the log does not contain one of them.
        """
        missing = [joint for joint in self.joints if joint not in log.joints]
        if missing:
            raise LogError(
                f"the log has no joint {', '.join(missing)}",
                f"choose from {', '.join(log.joints)}",
                source=log.metadata.recording,
                column="joints",
            )
        return [log.joints.index(joint) for joint in self.joints] or list(range(len(log.joints)))

    def first_row(self, log: Rollout) -> int:
        """Index of the first compared row.

        Raises:
            LogError: if no row is compared.
        """
        time = log.array("time")[:, 0]
        row = int(np.searchsorted(time, time[0] + self.skip - 1e-9))
        if row >= len(time):
            raise LogError(
                f"the log lasts {time[-1] - time[0]:.2f} s, of which the first {self.skip:g} s are omitted",
                "lower `skip`, or record a longer log",
                source=log.metadata.recording,
            )
        return row

    def differences(self, prediction: Prediction) -> dict[tuple[str, str], Tensor]:
        """Simulated minus measured, by channel, ``[candidate, time, joint | axis]``, from the first compared row.

        Raises:
            LogError: if the log has none of the weighted channels.
        """
        log = prediction.log
        columns, first = self.columns(log), self.first_row(log)
        result = {}
        for group, name in self.weights:
            key = group, name
            if key not in log or key not in prediction.channels:
                continue
            simulated = prediction.channels[key]
            measured = torch.from_numpy(log.array(key)[: simulated.shape[1]])
            difference = simulated[:, first:] - measured[first:]
            if group == "joint":
                kept = log.measured(key)  # excluded columns must not count as zero error
                difference = difference[..., [column for column in columns if kept[column]]]
            elif key == ("imu", "orientation"):
                difference = _wrap(difference[..., :2])
            if difference.shape[-1]:
                result[key] = difference
            elif key == ("joint", "position"):
                raise LogError(
                    f"the positions of {', '.join(self.joints)} were excluded by the checks",
                    "omit this log, or choose other joints",
                    source=log.metadata.recording,
                )
        if not result:
            names = ", ".join("/".join(key) for key in self.weights)
            raise LogError(
                "the log has no channel to compare",
                f"record at least one of the channels {names}",
                source=log.metadata.recording,
            )
        return result

    def terms(self, prediction: Prediction) -> dict[tuple[str, str], Tensor]:
        """The unweighted terms by channel, ``[candidate]``; NaN where the simulation failed."""
        result = {}
        for key, difference in self.differences(prediction).items():
            squares = self._tamed(difference).square()
            value = squares.mean((1, 2)) if key[0] == "joint" else squares.sum(2).mean(1)
            result[key] = torch.where(prediction.failed, torch.nan, value)
        return result

    def mean_terms(self, predictions: Sequence[Prediction]) -> dict[str, Tensor]:
        """The terms by channel name, ``[candidate]``, averaged over the logs that have the channel."""
        terms = [self.terms(prediction) for prediction in predictions]
        keys = sorted({key for term in terms for key in term})
        return {"/".join(key): torch.stack([term[key] for term in terms if key in term]).mean(0) for key in keys}

    def __call__(self, predictions: Sequence[Prediction]) -> Tensor:
        """Weighted loss, averaged over logs, ``[candidate]``; NaN where a simulation failed."""
        losses = []
        for prediction in predictions:
            terms = self.terms(prediction)
            losses.append(torch.stack([self.weights[key] * term for key, term in terms.items()]).sum(0))
        return torch.stack(losses).mean(0)

    def residuals(self, predictions: Sequence[Prediction]) -> Tensor:
        """Vectors whose squared length is the loss, ``[candidate, residual]``."""
        parts = []
        for prediction in predictions:
            for key, difference in self.differences(prediction).items():
                count = difference.shape[1] * (difference.shape[2] if key[0] == "joint" else 1)
                scale = (self.weights[key] / (count * len(predictions))) ** 0.5
                bad = prediction.failed.view(-1, 1, 1) | ~torch.isfinite(difference)
                parts.append(torch.where(bad, FAILED_RESIDUAL, self._tamed(difference)).flatten(1) * scale)
        return torch.cat(parts, 1)

    def failed_loss(self, logs: int) -> float:
        """A loss over this number of logs that only occurs if at least one simulation diverged."""
        return 0.5 * FAILED_RESIDUAL**2 * min(weight for weight in self.weights.values() if weight > 0) / logs

    def _tamed(self, difference: Tensor) -> Tensor:
        """Differences whose squares give the loss: unchanged, or transformed by the pseudo-Huber function."""
        if self.robust_scale is None:
            return difference
        c = self.robust_scale
        # d^2 / (sqrt(d^2 + c^2) + c) equals sqrt(d^2 + c^2) - c without cancellation near zero
        return difference * torch.sqrt(2 * c / (torch.sqrt(difference.square() + c * c) + c))


def position_error(predictions: Sequence[Prediction], joints: Sequence[str] = ()) -> Tensor:
    """Mean absolute position error [rad] per log over the given or all joints, ``[candidate, log]``; NaN if failed."""
    focus = TrajectoryLoss(tuple(joints))
    errors = []
    for prediction in predictions:
        simulated = prediction.channels[("joint", "position")]
        measured = torch.from_numpy(prediction.log.array("joint/position")[: simulated.shape[1]])
        kept = [column for column in focus.columns(prediction.log) if prediction.log.measured("joint/position")[column]]
        error = (simulated - measured)[..., kept].abs().mean((1, 2))
        errors.append(torch.where(prediction.failed, torch.nan, error))
    return torch.stack(errors, 1)


def _wrap(angle: Tensor) -> Tensor:
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi
