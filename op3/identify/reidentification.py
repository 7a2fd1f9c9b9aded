"""Re-identification from failed transfers: match what episodes were worth, not how they went (paper, eq. 6).

Two objectives: the loss of the excitation, eq. (7), and the Wasserstein-1 distance between the returns under R_eval
that a policy got on the robot and those that it gets in simulation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import optuna
import torch
from scipy.stats import wasserstein_distance
from torch import Tensor

from op3.envs.returns import Returns, ReturnsBench
from op3.identify.identification import PREFIX
from op3.identify.loss import TrajectoryLoss
from op3.identify.problem import Problem
from op3.identify.study import Outcome
from op3.policy import PolicyBundle
from op3.robot import CONTROLLED_JOINTS
from op3.rollout import Rollout
from op3.servo import RobotModel
from op3.tasks.evaluation import evaluation_return
from op3.tasks.task import Task, find_task

PLAUSIBLE = 3.0
"""Candidates whose excitation loss is more than so many times that of the start are not worth an episode."""

TOLERATED = 1.25
"""The chosen candidate's excitation loss may be so many times that of the start."""


@dataclass(frozen=True)
class Candidate:
    """A point of the Pareto front, or the start.

    Attributes:
        values: parameter values by name.
        excitation: loss of the excitation, paper eq. (7).
        distance: Wasserstein-1 distance of the returns.
        returns: of the policy in simulation.
    """

    values: Mapping[str, float]
    excitation: float
    distance: float
    returns: Sequence[float] = field(default_factory=tuple)


@dataclass(frozen=True, eq=False)
class Reidentified:
    """What a re-identification found.

    Attributes:
        model: with the chosen candidate's values.
        start: the model that the policy was trained on.
        chosen: smallest distance among those whose excitation loss is at most `TOLERATED` times the start's.
        front: the Pareto front, by rising excitation loss.
        actual: returns on the robot.
    """

    model: RobotModel
    start: Candidate
    chosen: Candidate
    front: Sequence[Candidate]
    actual: Sequence[float]


class Reidentification:
    """Evaluates parameter sets by both objectives, many at once.

    Args:
        model: that the policy was trained on; its effects stay, its values are the start.
        excitation: logs of the excitation.
        episodes: logs of the policy's episodes on the robot.
        policy: whose episodes they are.
        names: parameters to search.
        task: that was attempted; None: as the episodes say.
        repeats: episodes of each candidate, K in the paper.
        seed: of the simulated episodes.
        joints: focusing joints of the excitation loss; those of a log where it has others.

    Raises:
        ValueError: if the model has no such parameter.
        LogError: if a log lacks what R_eval or the loss needs.
    """

    def __init__(
        self,
        model: RobotModel,
        excitation: Sequence[Rollout],
        episodes: Sequence[Rollout],
        policy: PolicyBundle,
        names: Sequence[str],
        *,
        task: str | Task | None = None,
        repeats: int = 10,
        seed: int = 0,
        joints: Sequence[str] = CONTROLLED_JOINTS,
    ):
        if not episodes:
            raise ValueError("episodes: re-identification needs at least one episode of the policy on the robot")
        known = model.parameters()
        unknown = [name for name in names if name not in known]
        if unknown:
            raise ValueError(f"the model has no parameter {unknown[0]!r}; it has {', '.join(known)}")
        attempted = task if task is not None else episodes[0].metadata.extra.get("task", policy.manifest.task)
        self.names = tuple(names)
        self.model = model
        self.actual = [evaluation_return(log, attempted) for log in episodes]
        self.problem = Problem(model, excitation, TrajectoryLoss(tuple(joints)))
        self.bench = ReturnsBench(policy, model, find_task(attempted), repeats, seed)
        self.start = self._measure([{name: model.value(name) for name in names}])[0]

    def evaluate(self, population: Sequence[Mapping[str, float]]) -> list[Outcome]:
        """Both objectives of trials whose parameters are config keys, as the study asks them."""
        trials = [{key.removeprefix(PREFIX): float(value) for key, value in trial.items()} for trial in population]
        outcomes = []
        for one in self._measure(trials, PLAUSIBLE * self.start.excitation):
            if not np.isfinite(one.excitation):
                outcomes.append(Outcome(None, error="diverged"))
                continue
            attributes = {"returns": list(one.returns)} if one.returns else {"skipped": "implausible excitation loss"}
            outcomes.append(Outcome((one.excitation, one.distance), attributes))
        return outcomes

    def _measure(self, trials: Sequence[Mapping[str, float]], plausible: float = np.inf) -> list[Candidate]:
        """Both objectives; beyond a plausible excitation loss the distance is that of episodes worth nothing."""
        values = {name: torch.tensor([trial[name] for trial in trials], dtype=torch.float64) for name in self.names}
        losses = self.problem.loss(self.problem.predict(values, len(trials)))
        worth = (losses <= plausible).nonzero()[:, 0]
        returns: dict[int, Tensor] = {}
        if len(worth):
            result: Returns = self.bench.run({name: value[worth] for name, value in values.items()}, len(worth))
            returns = dict(zip(worth.tolist(), result.returns, strict=True))
        worthless = float(np.abs(self.actual).mean())
        measured = []
        for i, trial in enumerate(trials):
            own = returns.get(i)
            loss = float(losses[i])
            if own is None:
                measured.append(Candidate(trial, loss, worthless))
            elif not bool(torch.isfinite(own).all()):
                measured.append(Candidate(trial, float("nan"), worthless))
            else:
                distance = float(wasserstein_distance(self.actual, own.numpy()))
                measured.append(Candidate(trial, loss, distance, tuple(own.tolist())))
        return measured

    def finish(self, study: optuna.Study) -> Reidentified:
        """Choose a point of the front.

        Raises:
            ValueError: if no trial of the study completed.
        """
        complete = [t for t in study.trials if t.state == optuna.trial.TrialState.COMPLETE]
        if not complete:
            raise ValueError("no trial of the study completed: every simulation failed; check the logs and the model")
        candidates = [self._candidate(trial) for trial in complete]
        near = [c for c in candidates if c.returns and c.excitation <= TOLERATED * self.start.excitation]
        chosen = min([self.start, *near], key=lambda c: (c.distance, c.excitation))
        front = sorted((self._candidate(trial) for trial in study.best_trials), key=lambda c: c.excitation)
        return Reidentified(
            model=self.model.with_values(dict(chosen.values)),
            start=self.start,
            chosen=chosen,
            front=front,
            actual=self.actual,
        )

    def _candidate(self, trial: optuna.trial.FrozenTrial) -> Candidate:
        values = {key.removeprefix(PREFIX): float(value) for key, value in trial.params.items()}
        excitation, distance = trial.values
        return Candidate(values, excitation, distance, tuple(trial.user_attrs.get("returns", ())))
