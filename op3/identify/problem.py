"""An identification problem: logs, an initial model, and the searched parameters."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from op3.identify.loss import TrajectoryLoss
from op3.identify.sensitivity import Box, Residuals
from op3.identify.study import TrialOutcome
from op3.replay import Prediction, Replay
from op3.rollout import Rollout
from op3.servo import RobotModel

KEPT = 128
"""Number of recent parameter sets whose residuals are kept."""


class Problem:
    """Evaluates many parameter sets at once on logs.

    Args:
        model: active effects, and values of all other parameters.
        replay: options of `op3.replay.Replay`.
    """

    def __init__(self, model: RobotModel, logs: Sequence[Rollout], loss: TrajectoryLoss, **replay: Any):
        self.model = model
        self.loss = loss
        self.replay = Replay(logs, **replay)
        self.simulated_seconds = 0.0
        self._kept: dict[tuple[tuple[str, float], ...], Tensor] = {}

    def predict(self, parameters: Mapping[str, Tensor] | None = None, candidates: int = 1) -> list[Prediction]:
        """Simulate the logs.

        Args:
            parameters: values by name, possibly with a condition: ``[candidate, joint]``, or shared values
                ``[candidate]``, which scale the values of joints in proportion (`RobotModel.for_joints`).
        """
        self.simulated_seconds += self.replay.seconds * candidates
        joints = self.replay.logs[0].joints
        given = {
            name: self.model.for_joints(name, value, joints) if "@" not in name and value.ndim == 1 else value
            for name, value in (parameters or {}).items()
        }
        return self.replay.run(self.model, given, candidates)

    def evaluate(self, population: Sequence[Mapping[str, float]]) -> list[TrialOutcome]:
        """The loss of every parameter set, and the unweighted terms by channel."""
        predictions = self.predict(columns(population), len(population))
        losses = self.loss(predictions)
        self._keep(population, self.loss.residuals(predictions))
        terms = {name: term.tolist() for name, term in self.loss.mean_terms(predictions).items()}
        return [
            TrialOutcome((loss,), {name: values[i] for name, values in terms.items()})
            if loss == loss
            else TrialOutcome(None, error="diverged")
            for i, loss in enumerate(losses.tolist())
        ]

    def _keep(self, population: Sequence[Mapping[str, float]], residual: Tensor) -> None:
        for member, row in list(zip(population, residual, strict=True))[-KEPT:]:
            self._kept[_key(member)] = row.clone()
        for key in list(self._kept)[:-KEPT]:
            del self._kept[key]

    def residuals_of(self, population: Sequence[Mapping[str, float]]) -> Tensor:
        """Residuals of parameter sets, ``[candidate, residual]``; recently evaluated sets are not simulated again."""
        missing = [member for member in population if _key(member) not in self._kept]
        found = {_key(member): self._kept[_key(member)] for member in population if member not in missing}
        if missing:
            rows = self.loss.residuals(self.predict(columns(missing), len(missing)))
            found.update({_key(member): row for member, row in zip(missing, rows, strict=True)})
        return torch.stack([found[_key(member)] for member in population])

    def residual_function(self, box: Box) -> Residuals:
        """Residuals of points in the unit box, ``[candidate, parameter] -> [candidate, residual]``."""

        def residuals(unit: Tensor) -> Tensor:
            values = torch.from_numpy(box.low) + unit * torch.from_numpy(box.span)
            return self.loss.residuals(self.predict(dict(zip(box.names, values.unbind(1), strict=True)), len(unit)))

        return residuals


def columns(population: Sequence[Mapping[str, float]]) -> dict[str, Tensor]:
    """Values by name, ``[candidate]``."""
    return {name: torch.tensor([float(m[name]) for m in population], dtype=torch.float64) for name in population[0]}


def _key(member: Mapping[str, float]) -> tuple[tuple[str, float], ...]:
    return tuple(sorted((name, float(value)) for name, value in member.items()))
