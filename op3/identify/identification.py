"""Identifies a model from logs: evaluates parameter sets, refines the best one, and tests it on held-out logs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import optuna
import torch

from op3.common.settings import Count, Whole, settings
from op3.identify.identifiability import Identifiability, identifiability
from op3.identify.intervals import followed_from_bounds, intervals_of
from op3.identify.loss import TrajectoryLoss, position_error
from op3.identify.polish import Polished, polish
from op3.identify.problem import Problem
from op3.identify.refine import refine
from op3.identify.sensitivity import Box, Residuals
from op3.identify.study import TrialOutcome
from op3.identify.surrogate import MOST_POINTS, explore
from op3.replay import Prediction, Replay
from op3.replay.setups import BENCH_CONTROL_PERIOD
from op3.rollout import LogError, Rollout
from op3.servo import Estimate, RobotModel
from op3.servo.conditions import split_name
from op3.sim.model_file import model_hash

PREFIX = "parameters."
"""Config key that contains all keys of the search space."""

BLOCKS_PER_LOG = 10
"""Number of equal blocks per log that intervals treat as independent; half a second each in a squat."""

CHECKED = 0.1
"""Length of each log that is simulated before the first trial, so that errors show at once [s]."""


@dataclass(frozen=True, eq=False)
class FitScore:
    """Errors of a model on a set of logs.

    Attributes:
        loss: minimised loss, averaged over logs.
        paper_eq7: paper eq. (7) with unit weights, for the same joints.
        terms: unweighted terms of eq. (7) by channel, averaged over logs.
        error_mrad: mean absolute joint position error, averaged over logs [mrad].
        errors_mrad: mean absolute joint position error of each log [mrad].
        predictions: simulations of the logs with one parameter set.
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
        label: name on the page.
        model: model with the identified values and their 90 % intervals.
        found: names of the searched parameters.
        fit: score on the fitted logs.
        heldout: score on the held-out logs; None if there are none.
        bounds: searched range by parameter name.
        starts: values before the search, by parameter name.
        trials: loss of every trial of the study, in order; NaN where it failed.
        refined: loss after the trials, then after every round and iteration; empty without refinement.
        identifiability: which parameters are identifiable from the logs.
        simulated_seconds: total simulated time [s].
    """

    label: str
    model: RobotModel
    found: Sequence[str]
    fit: FitScore
    heldout: FitScore | None
    bounds: Mapping[str, tuple[float, float]]
    starts: Mapping[str, float]
    trials: Sequence[float]
    refined: Sequence[float] = field(default_factory=tuple)
    identifiability: Identifiability | None = None
    simulated_seconds: float = 0.0


def check_unseen(logs: Sequence[Rollout], heldout: Sequence[Rollout]) -> None:
    """Check by content that no held-out log is among the fitted logs.

    Raises:
        LogError: if a held-out log is also fitted.
    """
    fitted = {log.fingerprint() for log in logs}
    for held in heldout:
        if held.fingerprint() in fitted:
            raise LogError(
                "the log is both fitted and held out",
                "remove it from `data` or from `heldout`",
                source=held.metadata.recording,
            )


@settings("refine")
class Refine:
    """Refinement after the trials of a study.

    Attributes:
        rounds: number of rounds of a surrogate search that starts from the trials.
        batch: points simulated per round.
        seed: seed of the rounds.
        starts: number of best points from which least squares starts.
        max_iterations: largest number of iterations of least squares.
        polish: number of final Gauss-Newton steps along combinations of parameters.
    """

    rounds: Whole = 0
    batch: Count = 12
    seed: Whole = 0
    starts: Whole = 0
    max_iterations: Count = 25
    polish: Whole = 0


def _check_name(name: str, model: RobotModel, logs: Sequence[Rollout]) -> None:
    """Raise an error for parameters that cannot be searched with this model and these logs."""
    base, condition = split_name(name)
    known = model.parameters()
    if base not in known:
        raise ValueError(
            f"groups contain {name!r}, but no effect of the model has it; active: {', '.join(model.effect_names)}."
            " Switch its effect on in the model, or omit the group"
        )
    estimate, joint = model.estimate(base), condition and condition.joint
    if condition is not None and joint is None and estimate.joints:
        raise ValueError(
            f"{name!r}: the model has values of {base} for {', '.join(estimate.joints)}, which a search under"
            " conditions of logs would discard; remove them from the model file, or omit the parameter from"
            " the search"
        )
    if joint is None:
        return
    if not known[base].per_joint:
        raise ValueError(f"{name!r}: {base} belongs to the whole robot; remove it from `per_joint`")
    for log in logs:
        if joint not in log.joints:
            raise ValueError(
                f"{name!r}: {log.metadata.recording} has no joint {joint!r}; it has {', '.join(log.joints)};"
                " select some of these with `joints`"
            )
    if estimate.by:
        raise ValueError(
            f"{name!r}: the model has values of {base} by condition (`by`), which cannot be searched per joint"
            " too; remove them from the model file, or remove the parameter from `per_joint`"
        )


class Identification:
    """Identifies the parameters of one model from logs.

    Args:
        model: active effects, and values of parameters that are not searched.
        names: parameters to search. ``encoder_offset@length=7e-2`` applies to logs that meet the condition, and
            ``coulomb_friction@joint=elbow`` to that joint.
        joints: compared joints; empty: all joints of a log.
        loss: minimised loss; by default paper eq. (7) with unit weights.
        bench_timestep: simulation step of bench logs [s].
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
        bench_timestep: float = BENCH_CONTROL_PERIOD,
    ):
        for name in names:
            _check_name(name, model, logs)
        check_unseen(logs, heldout)
        self.names = tuple(names)
        self.label = label
        self._bench_timestep = bench_timestep
        self.joints = tuple(joints)
        self.loss = loss or TrajectoryLoss(self.joints)
        self.problem = Problem(model, logs, self.loss, bench_timestep=bench_timestep)
        self._evaluated = 0
        # a batch of all logs costs little more than a batch of the fitted logs
        self._all = Problem(model, [*logs, *heldout], self.loss, bench_timestep=bench_timestep)

    def check(self) -> None:
        """Check before the first trial that the model can be simulated and compared on every log.

        Raises:
            ValueError: if not; the message names the mismatch.
        """
        first = Replay(self._all.replay.logs, duration=CHECKED, bench_timestep=self._bench_timestep)
        predictions = first.run(self.problem.model)
        for some in (predictions[: len(self.problem.replay.logs)], predictions[len(self.problem.replay.logs) :]):
            if some:
                self.loss(some)

    @property
    def identity(self) -> dict[str, str]:
        """Everything that the losses depend on except the searched parameters, for `op3.identify.study.run_study`."""
        logs = self.problem.replay.logs
        return {
            "logs": ", ".join(sorted(log.content_hash() for log in logs)),
            "robot": ", ".join(sorted({log.robot.content_hash for log in logs})),
            "model": model_hash(self.problem.model),
            "loss": repr((self.loss, self._bench_timestep)),
        }

    def evaluate(self, population: Sequence[Mapping[str, float]]) -> list[TrialOutcome]:
        """Losses of a study's trials, whose parameters are named by config keys."""
        self._evaluated += len(population)
        return self.problem.evaluate([self._values(trial) for trial in population])

    def finish(self, study: optuna.Study, **refine: Any) -> Fit:
        """Choose the best trial of a finished study, refine it with the settings `Refine`, and score the result.

        Args:
            refine: fields of `Refine`.

        Raises:
            ValueError: if no trial of the study completed.
        """
        how = Refine(**refine)
        complete = sorted(
            (t for t in study.trials if t.state == optuna.trial.TrialState.COMPLETE), key=lambda t: t.value or 0.0
        )
        if not complete:
            raise ValueError("no trial of the study completed: every simulation failed; check the log and the model")
        ranges = self._values(complete[0].distributions)
        bounds = {name: (float(ranges[name].low), float(ranges[name].high)) for name in self.names}
        residuals = self.problem.residual_function(Box.of(bounds))
        polished, refined = self._search_on(complete, Box.of(bounds), residuals, how)
        values, sensitivity = polished.values, polished.sensitivity
        fit, heldout = self.score(values)
        blocks, channels = self._blocks(fit.predictions)
        intervals = followed_from_bounds(residuals, sensitivity, intervals_of(sensitivity, blocks))
        model = self.problem.model.moved({name: Estimate(values[name], *intervals[name]) for name in self.names})
        model = model.with_values(_for_other_conditions(model, self.names))
        fitted = [log.fingerprint() for log in self.problem.replay.logs]
        # includes trials that other processes evaluated
        elsewhere = max(0, len(study.trials) - self._evaluated)
        return Fit(
            label=self.label,
            model=replace(model, provenance={**model.provenance, "fitted_logs": fitted}),
            found=self.names,
            fit=fit,
            heldout=heldout,
            bounds=bounds,
            starts={name: self.problem.model.estimate(name).value for name in self.names},
            trials=[np.nan if t.value is None else float(t.value) for t in study.trials],
            refined=refined,
            identifiability=identifiability(sensitivity, blocks, channels, intervals),
            simulated_seconds=self.problem.simulated_seconds + self.problem.replay.seconds * elsewhere,
        )

    def _search_on(
        self,
        trials: Sequence[optuna.trial.FrozenTrial],
        box: Box,
        residuals: Residuals,
        how: Refine,
    ) -> tuple[Polished, list[float]]:
        """Result of the refinement from these trials, which are sorted best first, and the losses during it."""
        candidates = [self._values(t.params) for t in trials[: max(how.starts, MOST_POINTS if how.rounds else 1)]]
        best, values, history = trials[0].value or 0.0, candidates[0], []
        failed = self.loss.failed_loss(len(self.problem.replay.logs))
        known: dict[str, np.ndarray] = {}
        if how.rounds:
            points, first = np.array([box.unit(c) for c in candidates]), self.problem.residuals_of(candidates).numpy()
            search = {"rounds": how.rounds, "batch": how.batch, "seed": how.seed, "failed_loss": failed}
            explored = explore(residuals, points, first, **search)
            history += explored.history
            known = {"curvature": explored.curvature, "known": explored.residual}
            best, candidates = float(explored.losses[0]), [box.values(unit) for unit in explored.points]
            values = candidates[0]
        if how.starts:
            descended = refine(residuals, box, candidates[: how.starts], max_iterations=how.max_iterations)
            history += descended.history[1:] if how.rounds else descended.history
            if descended.loss < best:
                values = descended.values
                known.pop("known", None)
        polished = polish(residuals, box, values, steps=how.polish, failed_loss=failed, **known)
        history += polished.history[1:] if history or not how.polish else polished.history
        return polished, history

    def score(self, values: Mapping[str, float]) -> tuple[FitScore, FitScore | None]:
        """Scores of one parameter set on fitted and held-out logs; the latter is None without held-out logs."""
        predictions = self._all.predict({name: torch.tensor([value]) for name, value in values.items()})
        self.problem.simulated_seconds += self.problem.replay.seconds
        count = len(self.problem.replay.logs)
        unseen = predictions[count:]
        return self._score(predictions[:count]), self._score(unseen) if unseen else None

    def _score(self, predictions: Sequence[Prediction]) -> FitScore:
        paper = TrajectoryLoss(self.joints)
        errors = 1e3 * position_error(predictions, self.joints)[0]
        return FitScore(
            loss=float(self.loss(predictions)[0]),
            paper_eq7=float(paper(predictions)[0]),
            terms={name: float(term[0]) for name, term in paper.mean_terms(predictions).items()},
            error_mrad=float(errors.mean()),
            errors_mrad=errors.tolist(),
            predictions=predictions,
        )

    def _values(self, by_key: Mapping[str, Any]) -> dict[str, Any]:
        return {key.removeprefix(PREFIX): value for key, value in by_key.items()}

    def _blocks(self, predictions: Sequence[Prediction]) -> tuple[list[np.ndarray], dict[str, np.ndarray]]:
        """Indices of the residual by time block and by channel. With many logs a block is a whole log, otherwise a part
        of a log.
        """
        stretches = 1 if len(self.problem.replay.logs) >= BLOCKS_PER_LOG else BLOCKS_PER_LOG
        blocks: list[list[np.ndarray]] = []
        channels: dict[str, list[np.ndarray]] = {}
        offset = 0
        for prediction in predictions:
            time = prediction.log.array("time")[self.loss.first_row(prediction.log) :, 0]
            share = (time - time[0]) / (time[-1] - time[0])
            number = np.minimum((share * stretches).astype(int), stretches - 1)
            members: list[list[np.ndarray]] = [[] for _ in range(stretches)]
            for key, difference in self.loss.differences(prediction).items():
                rows, columns = difference.shape[1:]
                index = offset + np.arange(rows * columns).reshape(rows, columns)
                for block in range(len(members)):
                    members[block].append(index[number[:rows] == block].ravel())
                channels.setdefault("/".join(key), []).append(index.ravel())
                offset += rows * columns
            blocks.extend(members)
        by_channel = {name: np.concatenate(parts) for name, parts in channels.items()}
        return [np.concatenate(block) for block in blocks], by_channel


def _for_other_conditions(model: RobotModel, names: Sequence[str]) -> dict[str, Estimate]:
    """Shared values of parameters that were only searched by log condition: the middle of these values."""
    result = {}
    for base in {split_name(name)[0] for name in names} - set(names):
        estimate = model.estimates[base]
        found = list(estimate.by.values())
        if not found:
            continue  # searched for single joints: other joints keep their values
        result[base] = replace(
            estimate,
            value=sum(special.value for special in found) / len(found),
            low=min(special.value if special.low is None else special.low for special in found),
            high=max(special.value if special.high is None else special.high for special in found),
        )
    return result
