"""Re-identification from failed transfers: match the returns of episodes, not their time series (paper, eq. 6).

There are two objectives: the loss of the excitation, eq. (7), and the Wasserstein-1 distance between the policy's
returns R_eval on the robot and in simulation.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import ceil
from typing import Any

import numpy as np
import optuna
import torch
from scipy.stats import wasserstein_distance
from torch import Tensor

from op3.identify.identification import PREFIX
from op3.identify.level_set import draw_level_set
from op3.identify.level_set_sampler import IMAGE, MISFIT, quantile_misfit, residual_image
from op3.identify.loss import TrajectoryLoss
from op3.identify.polish import polish
from op3.identify.problem import Problem, columns
from op3.identify.sensitivity import Box
from op3.identify.study import TrialOutcome
from op3.policy import PolicyBundle
from op3.rollout import Rollout
from op3.servo import RobotModel
from op3.sim import model_hash
from op3.sim.crew import Crew
from op3.tasks.evaluation import evaluation_return
from op3.tasks.task import POLICY_PERIOD, Task, find_task
from op3.transfer.failed_episodes import check_episode
from op3.transfer.reidentified import Array, ParetoPoint, Reidentified, better_half, chance_distances, unbeaten
from op3.transfer.returns import ReturnsBench

PLAUSIBLE = 2.0
"""Candidates with an excitation loss above this multiple of the initial model's run no episodes."""

TRIED = 0.3
"""Share of the episodes that every plausible candidate runs; only the better candidates run the rest."""

TOLERATED = 1.25
"""Largest excitation loss of the chosen candidate, as a multiple of the initial model's. Others only run the first
episodes, unless they are on the Pareto front."""

DISTINCT = 0.01
"""Smallest difference between finalists in one parameter, as a share of the trials' range, because generations contain
clones."""

CHANCE = 0.9
"""The initial model is kept if its distance is below this quantile of the distances that chance causes."""

RISES = (0.1, 0.25, 0.6)
"""Expected rise of the first candidates' excitation loss above the initial model's, as shares of the latter."""


class Simulations:
    """Simulates candidates; several processes, each with one of these objects, share the candidates.

    The arguments are those of `Reidentification`; `joints` are the focusing joints, and `num_threads` threads step the
    physics (0: all processors).
    """

    def __init__(
        self,
        model: RobotModel,
        excitation: Sequence[Rollout],
        joints: Sequence[str],
        policy: PolicyBundle,
        task: Task,
        repeats: int,
        seed: int,
        num_threads: int,
    ):
        self.problem = Problem(model, excitation, TrajectoryLoss(tuple(joints)), num_threads=num_threads)
        self.bench = ReturnsBench(policy, model, task, repeats, seed, num_threads=num_threads)

    def losses(self, values: Mapping[str, Tensor], candidates: int) -> tuple[Tensor, float]:
        """Loss of the excitation and image of its residual, ``[candidate, 1 + number]``, and the simulated time [s]."""
        before = self.problem.simulated_seconds
        predictions = self.problem.predict(values, candidates)
        losses, image = self.problem.loss(predictions), residual_image(self.problem.loss.residuals(predictions))
        return torch.cat([losses[:, None], image], 1), self.problem.simulated_seconds - before

    def returns(self, values: Mapping[str, Tensor], candidates: int, episodes: Sequence[int]) -> tuple[Tensor, float]:
        """Returns of the given episodes ``[candidate, episode]``, and the simulated time [s]."""
        before = self.bench.simulated_seconds
        returns = self.bench.run(values, candidates, episodes=episodes).returns
        return returns, self.bench.simulated_seconds - before


class Reidentification:
    """Evaluates both objectives for many parameter sets at once.

    Args:
        model: model that the policy was trained on, which defines the effects and the initial values.
        episodes: logs of the policy's episodes on the robot.
        task: task of the policy; None: the task of the episodes.
        repeats: number of episodes per candidate, K in the paper.
        race: whether candidates with poor first episodes skip the other episodes.
        processes: processes that share the simulations of a population; 0 for all processors.

    Raises:
        ValueError: if the model has no such parameter, or cannot be simulated.
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
        race: bool = True,
        seed: int = 0,
        processes: int = 1,
    ):
        if not episodes:
            raise ValueError("episodes: re-identification needs at least one episode of the policy on the robot")
        start = {name: model.value(name) for name in names}  # what the model does not have is refused here
        attempted = task if task is not None else episodes[0].metadata.extra.get("task", policy.manifest.task)
        self.names = tuple(names)
        self.model, self.race = model, race
        self._logs, self._policy, self._seed = (tuple(excitation), tuple(episodes)), policy, seed
        self.task, self.episodes = find_task(attempted), repeats
        for log in episodes:
            check_episode(log, self.task, policy)
        self.actual = [evaluation_return(log, attempted) for log in episodes]
        what = {
            "model": model,
            "excitation": list(excitation),
            "joints": episodes[0].robot.controlled,
            "policy": policy,
            "task": self.task,
            "repeats": repeats,
            "seed": seed,
            "num_threads": 0 if processes == 1 else 1,
        }
        self._crew = Crew(Simulations, what, processes)
        self.simulations = self._crew.worker
        self.simulated_seconds = 0.0
        self.start = self._measure([start])[0]
        if not np.isfinite(self.start.excitation):
            raise ValueError(
                "the model that the policy was trained on diverges in simulation, so the search cannot start from it"
            )

    @property
    def identity(self) -> str:
        """Identity of the objectives, which depends on logs, policy, model, task and number of episodes."""
        logs = [log.fingerprint() for log in (*self._logs[0], *self._logs[1])]
        weights = hashlib.sha256()
        for name in sorted(self._policy.weights):
            weights.update(self._policy.weights[name].numpy().tobytes())
        settings = [self.task.name, str(self.task.duration), str(self.episodes), str(self.race), str(self._seed)]
        whole = " ".join([*logs, weights.hexdigest(), model_hash(self.model), *settings])
        return hashlib.sha256(whole.encode()).hexdigest()[:12]

    def evaluate(self, population: Sequence[Mapping[str, float]]) -> list[TrialOutcome]:
        """Both objectives of trials whose parameters are config keys, as the study requests."""
        trials = [{key.removeprefix(PREFIX): float(value) for key, value in trial.items()} for trial in population]
        outcomes = []
        for one in self._measure(trials, PLAUSIBLE * self.start.excitation, self.race):
            if not np.isfinite(one.excitation):
                outcomes.append(TrialOutcome(None, error="diverged"))
                continue
            attributes: dict[str, object] = {"episodes": len(one.returns), **one.attributes}
            if len(one.returns) == self.episodes:
                attributes["returns"] = list(one.returns)
            elif not one.returns:
                attributes["skipped"] = "implausible excitation loss"
            outcomes.append(TrialOutcome((one.excitation, one.distance), attributes))
        return outcomes

    def propose(self, count: int, bounds: Mapping[str, tuple[float, float]], seed: int = 0) -> list[dict[str, float]]:
        """First trials of a study: parameter sets, by config key, that fit the excitation about as well as the
        identified set.

        Args:
            count: number of parameter sets, divided equally among the `RISES`.
            bounds: range that the study searches, by parameter name.
        """
        problem = self.simulations.problem
        box = Box.of({name: bounds[name] for name in self.names})
        before, residuals = problem.simulated_seconds, problem.residual_function(box)
        sensitivity = polish(residuals, box, self.start.values, steps=0).sensitivity
        self.simulated_seconds += problem.simulated_seconds - before
        rng = np.random.default_rng([seed, 7])
        shares = np.array_split(np.arange(count), len(RISES))
        residual, jacobian = sensitivity.residual, sensitivity.jacobian
        ellipsoid = (sensitivity.unit, jacobian.T @ jacobian, jacobian.T @ residual)
        loss = float(residual @ residual)
        points = [
            draw_level_set(*ellipsoid, rise * loss, len(own), rng) for rise, own in zip(RISES, shares, strict=True)
        ]
        values = map(box.values, np.concatenate(points))
        return [{PREFIX + name: value for name, value in each.items()} for each in values]

    def _shared(self, what: str, values: Mapping[str, Tensor], count: int, **more: Any) -> Tensor:
        """Results of `Simulations` for all candidates, interleaved over processes because neighbours take equal
        times."""
        shares = [torch.arange(first, count, self._crew.size) for first in range(min(self._crew.size, count))]
        parts = [
            {"values": {name: value[share] for name, value in values.items()}, "candidates": len(share), **more}
            for share in shares
        ]
        done = self._crew.run(what, parts)
        self.simulated_seconds += sum(seconds for _, seconds in done)
        return torch.cat([result for result, _ in done])[torch.cat(shares).argsort()]

    def _measure(
        self, trials: Sequence[Mapping[str, float]], plausible: float = np.inf, race: bool = False
    ) -> list[ParetoPoint]:
        """Both objectives; for implausible excitation losses the distance is set above any possible one."""
        values = columns(trials)
        seen = self._shared("losses", values, len(trials))
        losses, images = seen[:, 0], seen[:, 1:].numpy()
        worth = (losses <= plausible).nonzero()[:, 0]
        returns = self._play({name: value[worth] for name, value in values.items()}, losses[worth], race)
        played = dict(zip(worth.tolist(), returns, strict=True))
        # the reward of a step is at most 1, so no returns differ more
        worthless = float(max(*np.abs(self.actual), ceil(self.task.duration / POLICY_PERIOD)))
        measured = []
        for i, trial in enumerate(trials):
            loss, own = float(losses[i]), played.get(i)
            attributes = {IMAGE: _short(images[i])}
            if own is None:
                measured.append(ParetoPoint(trial, loss, worthless, attributes=attributes))
            elif not np.isfinite(own).all():
                measured.append(ParetoPoint(trial, float("nan"), worthless))
            else:
                whole = self._foresee(own)
                attributes[MISFIT] = _short(quantile_misfit(whole, self.actual))
                measured.append(ParetoPoint(trial, loss, self._distance(whole), tuple(own.tolist()), attributes))
        return measured

    def _play(self, values: Mapping[str, Tensor], losses: Tensor, race: bool) -> list[Array]:
        """Returns of candidates: of all episodes, or in a race only of the first ones for poor candidates.

        Every candidate runs the first episodes. Its other returns are predicted as the initial model's returns in these
        episodes plus the mean difference in the first ones. Only the better half runs the rest, except candidates that
        the initial model beats in both objectives or whose excitation loss is too large.
        """
        count, episodes = len(losses), self.episodes
        first = ceil(TRIED * episodes) if race else episodes
        if not count:
            return []
        returns = self._shared("returns", values, count, episodes=range(first)).numpy()
        if first == episodes:
            return list(returns)
        foreseen = [self._distance(self._foresee(own)) for own in returns]
        chosen = better_half(losses.numpy(), np.array(foreseen), (self.start.excitation, self.start.distance))
        chosen = chosen[losses.numpy()[chosen] <= TOLERATED * self.start.excitation]
        result = list(returns)
        if len(chosen):
            rows = torch.from_numpy(chosen)
            some = {name: value[rows] for name, value in values.items()}
            rest = self._shared("returns", some, len(chosen), episodes=range(first, episodes)).numpy()
            for row, more in zip(chosen, rest, strict=True):
                result[row] = np.concatenate([returns[row], more])
        return result

    def _foresee(self, first: Array) -> Array:
        """All returns of a candidate; missing ones are the initial model's plus the mean difference of the first
        ones."""
        if len(first) == self.episodes:
            return first
        start = np.array(self.start.returns)
        return np.concatenate([first, start[len(first) :] + (first - start[: len(first)]).mean()])

    def finish(self, study: optuna.Study, finalists: int = 8) -> Reidentified:
        """Choose a point of the Pareto front, and evaluate it on new episodes.

        The finalists are the closest few different candidates whose excitation loss is at most `TOLERATED` times the
        initial model's. They and the initial model run the same number of new episodes, because the best of hundreds
        was partly lucky in the first ones; the smallest distance over the new episodes wins. The initial model is kept
        if its returns are as close to the robot's as chance allows. A third set of episodes measures the result.

        Raises:
            ValueError: if no trial of the study completed.
        """
        complete = [t for t in study.trials if t.state == optuna.trial.TrialState.COMPLETE]
        if not complete:
            raise ValueError("no trial of the study completed: every simulation failed; check the logs and the model")
        played = [self._candidate(trial) for trial in complete if trial.user_attrs.get("episodes", 0)]
        whole = [one for one in played if one.returns]
        # candidates that only ran the first episodes but may be on the front run the others now
        short = [one for one in unbeaten(played) if not one.returns]
        whole += [one for one in (self._replay(short, 0) if short else ()) if np.isfinite(one.distance)]
        near = [one for one in whole if one.excitation <= TOLERATED * self.start.excitation]
        # the start is the study's nominal trial
        near = [one for one in near if dict(one.values) != dict(self.start.values)]
        final = [self.start, *self._distinct(sorted(near, key=lambda one: one.distance), whole, finalists)]
        again = self._replay(final, 1)
        returns = np.array([*self.start.returns, *again[0].returns])
        chance = chance_distances(returns, len(self.actual), len(returns))
        at_chance = self._distance(returns) <= float(np.quantile(chance, CHANCE))
        best = 0 if at_chance else int(np.argmin([one.distance for one in again]))
        chosen = final[best]
        fresh_start, fresh_chosen = self._replay([self.start, chosen], 2)
        simulated = (*chosen.returns, *again[best].returns, *fresh_chosen.returns)
        return Reidentified(
            model=self.model.moved(dict(chosen.values)),
            start=self.start,
            chosen=chosen,
            front=sorted(unbeaten(whole), key=lambda one: one.excitation),
            actual=self.actual,
            fresh_start=fresh_start,
            fresh_chosen=fresh_chosen,
            noise=float(chance_distances(np.array(simulated), len(self.actual), self.episodes).mean()),
            at_chance=at_chance,
        )

    def _distinct(self, ordered: Sequence[ParetoPoint], all_: Sequence[ParetoPoint], count: int) -> list[ParetoPoint]:
        """The first candidates that differ from one another and from the initial model."""
        values = np.array([[one.values[name] for name in self.names] for one in all_])
        span = np.ptp(values, axis=0) if len(values) else np.ones(len(self.names))
        taken: list[ParetoPoint] = []
        for one in ordered:
            others = [self.start, *taken]
            steps = [[abs(one.values[name] - other.values[name]) for name in self.names] for other in others]
            if len(taken) < count and (np.array(steps) > DISTINCT * span).any(1).all():
                taken.append(one)
        return taken

    def _replay(self, candidates: Sequence[ParetoPoint], times: int) -> list[ParetoPoint]:
        """The candidates over further episodes, after `times` earlier sets."""
        values = columns([one.values for one in candidates])
        numbers = range(times * self.episodes, (times + 1) * self.episodes)
        returns = self._shared("returns", values, len(candidates), episodes=numbers).numpy()
        return [
            replace(one, returns=tuple(own.tolist()), distance=self._distance(own))
            for one, own in zip(candidates, returns, strict=True)
        ]

    def _distance(self, returns: Sequence[float] | Array) -> float:
        """Wasserstein-1 distance to the robot's returns."""
        known = np.asarray(returns)
        return float(wasserstein_distance(self.actual, known)) if np.isfinite(known).all() else float("inf")

    def _candidate(self, trial: optuna.trial.FrozenTrial) -> ParetoPoint:
        values = {key.removeprefix(PREFIX): float(value) for key, value in trial.params.items()}
        excitation, distance = trial.values
        return ParetoPoint(values, excitation, distance, tuple(trial.user_attrs.get("returns", ())))


def _short(vector: Array) -> list[float]:
    """Numbers rounded to six digits, as in a study."""
    return [float(f"{number:.6g}") for number in vector]
