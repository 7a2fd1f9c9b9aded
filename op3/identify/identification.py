"""From logs to a model: evaluate parameter sets, choose the best, refine it, test it on logs not used."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import optuna
import torch
from torch import Tensor

from op3.identify.intervals import sandwich_intervals
from op3.identify.loss import TrajectoryLoss, position_error
from op3.identify.problem import Problem
from op3.identify.refine import refine
from op3.identify.study import Outcome
from op3.rollout import Rollout
from op3.servo import Estimate, RobotModel
from op3.tasks import Prediction

PREFIX = "parameters."
"""Search-space keys are config keys below this one."""

BLOCK_SECONDS = 0.5
"""Length of the blocks of samples that intervals take as independent [s]."""


@dataclass(frozen=True, eq=False)
class Score:
    """How a model does on a set of logs.

    Attributes:
        loss: what was minimised, averaged over logs.
        paper_eq7: paper eq. (7) with unit weights, over the same joints.
        terms: unweighted terms of eq. (7) by channel, averaged over logs.
        error_mrad: mean absolute joint position error, averaged over logs [mrad].
        errors_mrad: the same per log.
        predictions: what was simulated, one candidate.
    """

    loss: float
    paper_eq7: float
    terms: Mapping[str, float]
    error_mrad: float
    errors_mrad: Sequence[float]
    predictions: Sequence[Prediction]


@dataclass(frozen=True, eq=False)
class Fit:
    """An identified model.

    Attributes:
        label: what it is called on the page.
        model: with the values found and their 90 % intervals.
        found: names of the parameters that were searched.
        fit: score on the logs that were fitted.
        heldout: score on the held-out logs; None where there are none.
        bounds: the range searched, by parameter name.
        trials: loss of every trial of the study, in order; NaN where it failed.
        refined: loss after every iteration of least squares; empty without.
        simulated_seconds: simulated time spent [s].
    """

    label: str
    model: RobotModel
    found: Sequence[str]
    fit: Score
    heldout: Score | None
    bounds: Mapping[str, tuple[float, float]]
    trials: Sequence[float]
    refined: Sequence[float] = field(default_factory=tuple)
    simulated_seconds: float = 0.0


class Identification:
    """Identifies the parameters of one model from logs.

    Args:
        model: effects that are on, and values of parameters that are not searched.
        logs: what to fit.
        heldout: logs for testing only.
        names: parameters to search.
        joints: joints whose traces count; all of a log where empty.
        loss: what to minimise; by default paper eq. (7) with unit weights.
        label: what the model is called.
    """

    def __init__(
        self,
        model: RobotModel,
        logs: Sequence[Rollout],
        heldout: Sequence[Rollout],
        names: Sequence[str],
        *,
        joints: Sequence[str] = (),
        loss: TrajectoryLoss | None = None,
        label: str = "model",
    ):
        known = model.parameters()
        for name in names:
            if name not in known:
                raise ValueError(
                    f"group asks for {name!r}, but no effect of the model has it; effects on: "
                    f"{', '.join(model.effect_names)}. Switch its effect on in the model, or leave the group out"
                )
        self.names = tuple(names)
        self.label = label
        self.joints = tuple(joints)
        self.loss = loss or TrajectoryLoss(self.joints)
        self.problem = Problem(model, logs, self.loss)
        self.heldout = Problem(model, heldout, self.loss) if heldout else None

    def evaluate(self, population: Sequence[Mapping[str, float]]) -> list[Outcome]:
        """Losses of trials whose parameters are config keys, as the study asks them."""
        stripped = [{key.removeprefix(PREFIX): value for key, value in trial.items()} for trial in population]
        return [
            Outcome(None if e.loss is None else (e.loss,), dict(e.terms), None if e.loss is not None else "diverged")
            for e in self.problem.evaluate(stripped)
        ]

    def finish(
        self,
        study: optuna.Study,
        *,
        starts: int = 0,
        max_iterations: int = 25,
        progress: Callable[[int, float], None] | None = None,
    ) -> Fit:
        """Choose the best trial, refine it by least squares if asked, and score it.

        Args:
            study: finished.
            starts: how many of the best trials least squares starts from; 0 for no refinement.
            max_iterations: of least squares.
            progress: called with iteration and loss.

        Raises:
            ValueError: if no trial of the study completed.
        """
        complete = sorted(
            (t for t in study.trials if t.state == optuna.trial.TrialState.COMPLETE), key=lambda t: t.value or 0.0
        )
        if not complete:
            raise ValueError("no trial of the study completed: every simulation failed; check the log and the model")
        values = self._values(complete[0])
        ranges = {key.removeprefix(PREFIX): d for key, d in complete[0].distributions.items()}
        bounds = {name: (float(ranges[name].low), float(ranges[name].high)) for name in self.names}
        refined: Sequence[float] = ()
        residuals = self._residuals(bounds)
        if starts:
            result = refine(
                residuals,
                bounds,
                [self._values(trial) for trial in complete[:starts]],
                max_iterations=max_iterations,
                progress=progress,
            )
            refined = result.history
            if result.loss < (complete[0].value or 0.0):
                values = result.values
        intervals = sandwich_intervals(residuals, bounds, values, self._blocks())
        model = self.problem.model.with_values({name: Estimate(values[name], *intervals[name]) for name in self.names})
        trials = [np.nan if t.value is None else float(t.value) for t in study.trials]
        return Fit(
            label=self.label,
            model=model,
            found=self.names,
            fit=self.score(self.problem, values),
            heldout=None if self.heldout is None else self.score(self.heldout, values),
            bounds=bounds,
            trials=trials,
            refined=refined,
            simulated_seconds=self.problem.replay.seconds * len(trials) + self.problem.simulated_seconds,
        )

    def score(self, problem: Problem, values: Mapping[str, float]) -> Score:
        """Score one parameter set on a problem's logs."""
        predictions = problem.predict({name: torch.tensor([value]) for name, value in values.items()}, 1)
        paper = TrajectoryLoss(self.joints)
        terms = [paper.terms(prediction) for prediction in predictions]
        keys = sorted({key for term in terms for key in term})
        errors = 1e3 * position_error(predictions)[0]
        return Score(
            loss=float(self.loss(predictions)[0]),
            paper_eq7=float(paper(predictions)[0]),
            terms={"/".join(key): float(torch.stack([t[key][0] for t in terms if key in t]).mean()) for key in keys},
            error_mrad=float(errors.mean()),
            errors_mrad=errors.tolist(),
            predictions=predictions,
        )

    def _values(self, trial: optuna.trial.FrozenTrial) -> dict[str, float]:
        return {key.removeprefix(PREFIX): float(value) for key, value in trial.params.items()}

    def _residuals(self, bounds: Mapping[str, tuple[float, float]]) -> Callable[[Tensor], Tensor]:
        low = torch.tensor([bounds[name][0] for name in self.names], dtype=torch.float64)
        high = torch.tensor([bounds[name][1] for name in self.names], dtype=torch.float64)
        return self.problem.residual_function(self.names, low, high)

    def _blocks(self) -> list[np.ndarray]:
        """Indices of the residual that belong to one stretch of time of one log, over all channels."""
        blocks: list[list[np.ndarray]] = []
        offset = 0
        for prediction in self.problem.predict({}, 1):
            time = prediction.log.array("time")[:, 0]
            number = ((time - time[0]) / BLOCK_SECONDS).astype(int)
            members: list[list[np.ndarray]] = [[] for _ in range(number.max() + 1)]
            for difference in self.loss.differences(prediction).values():
                rows, columns = difference.shape[1:]
                index = offset + np.arange(rows * columns).reshape(rows, columns)
                for block in range(len(members)):
                    members[block].append(index[number[:rows] == block].ravel())
                offset += rows * columns
            blocks.extend(members)
        return [np.concatenate(block) for block in blocks]
