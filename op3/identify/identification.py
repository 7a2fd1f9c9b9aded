"""From logs to a model: evaluate parameter sets, choose the best, refine it, test it on logs not used."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import optuna
import torch
from torch import Tensor

from op3.identify.identifiability import Identifiability, identifiability
from op3.identify.intervals import followed_from_bounds, intervals_of
from op3.identify.loss import TrajectoryLoss, position_error
from op3.identify.polish import polish as polish_off
from op3.identify.problem import Problem
from op3.identify.refine import refine
from op3.identify.study import Outcome
from op3.identify.surrogate import MOST_POINTS, explore
from op3.rollout import LogError, Rollout
from op3.servo import Estimate, RobotModel
from op3.servo.conditions import split_name
from op3.tasks import Prediction, Replay
from op3.tasks.setups import BENCH_CONTROL_PERIOD

PREFIX = "parameters."
"""Search-space keys are config keys below this one."""

BLOCKS_PER_LOG = 10
"""Stretches of equal length of each log that intervals take as independent; half a second of a squat."""

CHECKED = 0.1
"""How much of every log is simulated before the first trial [s]: whether that can be done shows at once."""


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
        starts: the model's values before the search, by parameter name.
        trials: loss of every trial of the study, in order; NaN where it failed.
        refined: loss before what follows the trials, then after every round and iteration; empty without.
        identifiability: what the logs tell apart, and what not.
        simulated_seconds: simulated time spent [s].
    """

    label: str
    model: RobotModel
    found: Sequence[str]
    fit: Score
    heldout: Score | None
    bounds: Mapping[str, tuple[float, float]]
    starts: Mapping[str, float]
    trials: Sequence[float]
    refined: Sequence[float] = field(default_factory=tuple)
    identifiability: Identifiability | None = None
    simulated_seconds: float = 0.0


def check_unseen(logs: Sequence[Rollout], heldout: Sequence[Rollout]) -> None:
    """Make sure that no held-out log is among the fitted ones, whatever the files are called.

    Raises:
        LogError: if one is.
    """
    for held in heldout:
        for log in logs:
            same = log.data.batch_size == held.data.batch_size and log.metadata.mount == held.metadata.mount
            if same and all(np.array_equal(log.array(key), held.array(key)) for key in ("time", "joint/position")):
                raise LogError(
                    "the log is both fitted and held out",
                    "take it out of `data` or out of `heldout`",
                    source=held.metadata.recording,
                )


class Identification:
    """Identifies the parameters of one model from logs.

    Args:
        model: effects that are on, and values of parameters that are not searched.
        logs: what to fit.
        heldout: logs for testing only.
        names: parameters to search; one with a condition, such as ``encoder_offset@length=7e-2``, counts for the logs
            that meet it, one such as ``coulomb_friction@joint=elbow`` for that joint.
        joints: joints whose traces count; all of a log where empty.
        loss: what to minimise; by default paper eq. (7) with unit weights.
        label: what the model is called.
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
        known = model.parameters()
        for name in names:
            if split_name(name)[0] not in known:
                raise ValueError(
                    f"group asks for {name!r}, but no effect of the model has it; effects on: "
                    f"{', '.join(model.effect_names)}. Switch its effect on in the model, or leave the group out"
                )
        for name in names:
            base, condition = split_name(name)
            if condition is not None and condition.joint is not None:
                self._check_joint(name, condition.joint, model, logs)
            elif condition is not None and model.estimate(base).joints:
                raise ValueError(
                    f"{name!r}: the model has values of {base} for {', '.join(model.estimate(base).joints)}, which a"
                    " search under conditions of logs would discard; remove them from the model file or leave the"
                    " parameter out of the search"
                )
        check_unseen(logs, heldout)
        self.names = tuple(names)
        self.label = label
        self._bench_timestep = bench_timestep
        self.joints = tuple(joints)
        self.loss = loss or TrajectoryLoss(self.joints)
        self.problem = Problem(model, logs, self.loss, bench_timestep=bench_timestep)
        self._evaluated = 0
        # one batch of all logs costs little more than one of the fitted ones alone
        self._all = Problem(model, [*logs, *heldout], self.loss, bench_timestep=bench_timestep)

    @staticmethod
    def _check_joint(name: str, joint: str, model: RobotModel, logs: Sequence[Rollout]) -> None:
        base = split_name(name)[0]
        if not model.parameters()[base].per_joint:
            raise ValueError(f"{name!r}: {base} is a quantity of the whole robot; leave it out of `per_joint`")
        for log in logs:
            if joint not in log.joints:
                raise ValueError(
                    f"{name!r}: {log.metadata.recording} has no joint {joint!r}, it has {', '.join(log.joints)};"
                    " choose some of them by `joints`"
                )
        if model.estimate(base).by:
            raise ValueError(
                f"{name!r}: the model has values of {base} under conditions of logs, which cannot be searched per joint"
                " too; remove them from the model file or leave the parameter out of `per_joint`"
            )

    def check(self) -> None:
        """Find out before the first trial whether the model can be simulated and compared on every log.

        Raises:
            ValueError: if not; the message names what does not fit.
        """
        first = Replay(self._all.replay.logs, duration=CHECKED, bench_timestep=self._bench_timestep)
        predictions = first.run(self.problem.model)
        for some in (predictions[: len(self.problem.replay.logs)], predictions[len(self.problem.replay.logs) :]):
            if some:
                self.loss(some)

    def evaluate(self, population: Sequence[Mapping[str, float]]) -> list[Outcome]:
        """Losses of trials whose parameters are config keys, as the study asks them."""
        self._evaluated += len(population)
        stripped = [{key.removeprefix(PREFIX): value for key, value in trial.items()} for trial in population]
        return self.problem.evaluate(stripped)

    def finish(
        self,
        study: optuna.Study,
        *,
        starts: int = 0,
        max_iterations: int = 25,
        rounds: int = 0,
        batch: int = 12,
        polish: int = 0,
        seed: int = 0,
        progress: Callable[[int, float], None] | None = None,
    ) -> Fit:
        """Choose the best trial, search on from the trials and refine the best by least squares if asked, and score it.

        Args:
            study: finished.
            starts: how many of the best trials least squares starts from; 0 for no refinement.
            max_iterations: of least squares.
            rounds: of a search with a surrogate of the residuals, before least squares; it begins with the trials.
            batch: points simulated per round.
            polish: Gauss-Newton steps along combinations of parameters, last of all.
            seed: of what the rounds draw.
            progress: called with iteration and loss.

        Raises:
            ValueError: if no trial of the study completed.
        """
        if starts < 0 or max_iterations < 1 or rounds < 0 or batch < 1 or polish < 0:
            raise ValueError(
                "refine: starts, rounds and polish must be at least 0, max_iterations and batch 1,"
                f" got {starts}, {rounds}, {polish}, {max_iterations} and {batch}"
            )
        complete = sorted(
            (t for t in study.trials if t.state == optuna.trial.TrialState.COMPLETE), key=lambda t: t.value or 0.0
        )
        if not complete:
            raise ValueError("no trial of the study completed: every simulation failed; check the log and the model")
        candidates = [self._values(trial) for trial in complete[: max(starts, MOST_POINTS if rounds else 1)]]
        best, values = complete[0].value or 0.0, candidates[0]
        ranges = {key.removeprefix(PREFIX): d for key, d in complete[0].distributions.items()}
        bounds = {name: (float(ranges[name].low), float(ranges[name].high)) for name in self.names}
        refined: list[float] = []
        curvature: np.ndarray | None = None
        there: np.ndarray | None = None
        residuals = self._residuals(bounds)
        failed_loss = self.loss.failed_loss(len(self.problem.replay.logs))
        if rounds:
            low = np.array([bounds[name][0] for name in self.names])
            span = np.array([bounds[name][1] for name in self.names]) - low
            points = (np.array([[c[name] for name in self.names] for c in candidates]) - low) / span
            known = self.problem.residuals_of(candidates).numpy()
            found = explore(
                residuals, points, known, rounds=rounds, batch=batch, seed=seed, failed_loss=failed_loss,
                progress=progress,
            )  # fmt: skip
            refined += found.history
            curvature, there = found.curvature, found.residual
            best = float(found.losses[0])
            candidates = [dict(zip(self.names, (low + u * span).tolist(), strict=True)) for u in found.points]
            values = candidates[0]
        if starts:
            result = refine(residuals, bounds, candidates[:starts], max_iterations=max_iterations, progress=progress)
            refined += result.history[1:] if rounds else result.history
            if result.loss < best:
                values, there = result.values, None
        polished = polish_off(
            residuals,
            bounds,
            values,
            steps=polish,
            curvature=curvature,
            known=there,
            failed_loss=failed_loss,
            progress=progress,
        )
        values, sensitivity = polished.values, polished.sensitivity
        refined += polished.history[1:] if refined or not polish else polished.history
        fit, heldout = self.score(values)
        blocks, channels = self._blocks(fit.predictions)
        intervals = followed_from_bounds(residuals, sensitivity, intervals_of(sensitivity, blocks))
        model = self.problem.model.moved({name: Estimate(values[name], *intervals[name]) for name in self.names})
        model = model.with_values(_for_other_conditions(model, self.names))
        fitted = [log.fingerprint() for log in self.problem.replay.logs]
        model = replace(model, provenance={**model.provenance, "fitted_logs": fitted})
        trials = [np.nan if t.value is None else float(t.value) for t in study.trials]
        return Fit(
            label=self.label,
            model=model,
            found=self.names,
            fit=fit,
            heldout=heldout,
            bounds=bounds,
            starts={name: self.problem.model.estimate(name).value for name in self.names},
            trials=trials,
            refined=refined,
            identifiability=identifiability(sensitivity, blocks, channels, intervals),
            # trials that other processes evaluated count as well
            simulated_seconds=self.problem.simulated_seconds
            + self.problem.replay.seconds * max(0, len(trials) - self._evaluated),
        )

    def score(self, values: Mapping[str, float]) -> tuple[Score, Score | None]:
        """Score one parameter set on the fitted and on the held-out logs; None where nothing is held out."""
        fitted, unseen = self._predict({name: torch.tensor([value]) for name, value in values.items()})
        return self._score(fitted), self._score(unseen) if unseen else None

    def _predict(self, parameters: Mapping[str, Tensor]) -> tuple[list[Prediction], list[Prediction]]:
        """One candidate on the fitted and on the held-out logs."""
        predictions = self._all.predict(parameters, 1)
        count = len(self.problem.replay.logs)
        self.problem.simulated_seconds += self.problem.replay.seconds
        return predictions[:count], predictions[count:]

    def _score(self, predictions: Sequence[Prediction]) -> Score:
        paper = TrajectoryLoss(self.joints)
        terms = [paper.terms(prediction) for prediction in predictions]
        keys = sorted({key for term in terms for key in term})
        errors = 1e3 * position_error(predictions, self.joints)[0]
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

    def _blocks(self, predictions: Sequence[Prediction]) -> tuple[list[np.ndarray], dict[str, np.ndarray]]:
        """Indices of the residual that belong together: by stretch of time, and by channel.

        A stretch is a whole log where there are many, else a part of one.
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
    """Shared values of parameters that were searched under conditions of logs only: the middle of what was found."""
    result = {}
    for base in {split_name(name)[0] for name in names} - set(names):
        estimate = model.estimates[base]
        found = list(estimate.by.values())
        if not found:
            continue  # searched for single joints: the others stay as they were simulated
        result[base] = replace(
            estimate,
            value=sum(special.value for special in found) / len(found),
            low=min(special.value if special.low is None else special.low for special in found),
            high=max(special.value if special.high is None else special.high for special in found),
        )
    return result
