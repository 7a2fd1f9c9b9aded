"""The workflow: windows, base, findings one after another, the model that predicts best, the gap before and after."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from op3.diagnose.base import Base, at_point, fit_base, unfitted
from op3.diagnose.candidates import Candidate
from op3.diagnose.coordinates import CHAIN
from op3.diagnose.doubts import doubts, held_odds, untold, unusual
from op3.diagnose.findings import Search, Stage
from op3.diagnose.reduction import Reduction
from op3.diagnose.settings import SETTINGS, Settings
from op3.diagnose.show import choose, show
from op3.diagnose.split import LogSplit
from op3.diagnose.unexplained import joint_gaps, lacking
from op3.diagnose.verdict import LIKELY, Finding, Rival, Verdict, plain
from op3.diagnose.whole_runs import on_whole_runs
from op3.diagnose.windows import HELD, WindowResiduals
from op3.servo import RobotModel, catalogue
from op3.servo.conditions import split_name

SHORTEST = 15.0
"""Fitted runs shorter than this in all carry no name [s]."""

ON_ITS_FEET = (
    "Only gaps are told of a robot on its feet, whose contacts hide what its servos do: record it on a stand, all"
    " joints moving."
)
STILL = "No joint moves in the fitted runs: move every joint through slow triangles and fast sines."
"""Why nothing can be told."""

FEWEST, PER_RUN = 72, 5
"""Windows of the fitted runs, and of each of them."""

RANKED = 15
"""Candidates that a verdict lists."""

QUANTILE = 1.645
"""Of a 90 % interval."""

STAGES = {"windows": 0.05, "base": 0.4, "candidates": 0.45, "show": 0.1}
"""Usual shares of the time."""


class Diagnosis:
    """Finds what a model lacks from the logs of a split.

    Args:
        model: effects that are on, and the values from which the refit starts.
        split: logs of one mount.
        seed: of the search and every resampling.
        without: names of effects not to consider.
        settings: tuned constants.
        progress: called with the stage and the share of all that is done.
    """

    def __init__(
        self,
        model: RobotModel,
        split: LogSplit,
        *,
        seed: int = 0,
        without: Sequence[str] = (),
        settings: Settings = SETTINGS,
        progress: Callable[[str, float], None] | None = None,
    ):
        self.given, self.split, self.seed, self.settings = model, split, seed, settings
        self.without = tuple(without)
        self._progress = progress or (lambda stage, share: None)
        self.seconds: dict[str, float] = {}
        self.stages: list[Stage] = []
        self.search: Search | None = None

    def run(self, rounds: int = 1) -> Verdict:
        """Diagnose; with more rounds, go on from the model handed back until nothing more is found.

        Linear algebra gets one thread: its matrices are small, and a second thread would wait, using a whole core.
        """
        with threadpool_limits(1):
            verdict = self._once(self.given)
            for _ in range(rounds - 1):
                if not any(finding.in_model and not finding.of_base for finding in verdict.findings):
                    break
                further = self._once(verdict.model)
                if not further.findings or not any(f.in_model for f in further.findings):
                    break
                findings = sorted((*verdict.findings, *further.findings), key=lambda finding: -finding.probability)
                doubted = tuple(dict.fromkeys((*verdict.doubts, *further.doubts)))
                verdict = replace(further, findings=tuple(findings), doubts=doubted, base=verdict.base)
                shown = show(verdict.base, verdict.model, self.split, self.seed)
                verdict = replace(verdict, gap=shown["gap"], loss=shown["loss"], shown=shown)
        return verdict

    def first_stage(self, fitted: bool = True) -> Stage:
        """The judge around the base with nothing named; of simulated logs around the given model as it is."""
        with threadpool_limits(1):
            reduction = self.reduction()
            base = self._base(reduction, self.given) if fitted else unfitted(reduction, self.given, self.settings)
            return self._searching(reduction).first(base)

    def _base(self, reduction: Reduction, model: RobotModel) -> Base:
        rng = np.random.default_rng([self.seed, 11])
        return fit_base(reduction, model, rng, self.settings, self._share("base"))

    def _searching(self, reduction: Reduction) -> Search:
        self.search = Search(reduction, self.without, self.settings, self._share("candidates"))
        return self.search

    def reduction(self) -> Reduction:
        """The windows of the fitted runs."""
        windows = self.settings.windows or max(FEWEST, PER_RUN * len(self.split.fit))
        return Reduction(WindowResiduals(self.split.fit, windows=windows), self.settings)

    def _once(self, model: RobotModel) -> Verdict:
        if self.split.fit[0].metadata.mount not in HELD:
            return self._void(model, ON_ITS_FEET)
        with self._timed("windows"):
            reduction = self.reduction()
        if not reduction.limbs:
            return self._void(model, STILL)
        with self._timed("base"):
            base = self._base(reduction, model)
        with self._timed("candidates"):
            self.stages = self._searching(reduction).run(base)
        with self._timed("show"):
            verdict = self._verdict(model, reduction)
        self._progress("show", 1.0)
        return replace(verdict, seconds=dict(self.seconds))

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        """Add the processor time of what is inside to a stage's."""
        began = time.process_time()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.process_time() - began

    def _share(self, stage: str) -> Callable[[float], None]:
        names = list(STAGES)
        before = sum(STAGES[name] for name in names[: names.index(stage)])
        return lambda share: self._progress(stage, before + STAGES[stage] * share)

    def _void(self, model: RobotModel, why: str) -> Verdict:
        shown = show(model, model, self.split, self.seed)
        return Verdict((), {}, (), (), (why,), model, model, gap=shown["gap"], loss=shown["loss"], shown=shown)

    def _verdict(self, given: RobotModel, reduction: Reduction) -> Verdict:
        first, last = self.stages[0], self.stages[-1]
        whole = [on_whole_runs(stage.base, self.split.fit) for stage in self.stages]
        points = [stage.base.point if at is None else at for stage, at in zip(self.stages, whole, strict=True)]
        models = [at_point(one.base.coordinates, point) for one, point in zip(self.stages, points, strict=True)]
        choice = choose(models, self.split.select) if len(models) > 1 else {"taken": 0, "left": [1.0], "channels": []}
        # what a name frees from a bound may have driven it there, or have let a poor base move on
        doubted = tuple(dict.fromkeys(doubt for stage in self.stages for doubt in doubts(stage.base)))
        most = LIKELY if doubted or self._short else 1.0
        held = most if whole[0] is None else LIKELY  # whole runs that were refitted know better
        findings = [*self._named(reduction, choice["taken"], most, held), *self._of_base(given, reduction, last, most)]
        stage, point = self.stages[choice["taken"]], points[choice["taken"]]
        deviation = np.sqrt(np.diag(stage.fit.covariance))[: len(point)]
        deviation = np.hypot(deviation, point - stage.base.point)  # windows and whole runs disagree by so much
        shown = show(models[0], models[choice["taken"]], self.split, self.seed)
        return Verdict(
            tuple(sorted(findings, key=lambda finding: -finding.probability)),
            joint_gaps(reduction, first, last),
            doubted,
            tuple(untold(first.base)),
            self._cannot_tell(reduction),
            models[0],
            at_point(stage.base.coordinates, point, deviation),
            choice,
            shown["gap"],
            shown["loss"],
            self._chain(first.base),
            self._ranking(reduction, first),
            shown=shown,
        )

    @property
    def _short(self) -> bool:
        return sum(log.duration for log in self.split.fit) < SHORTEST

    def _cannot_tell(self, reduction: Reduction) -> tuple[str, ...]:
        said = []
        still = [joint for joint, moves in zip(reduction.engine.joints, reduction.moving, strict=True) if not moves]
        if still:
            said.append(f"{', '.join(still)} hardly moved: nothing is said of them. Move every joint.")
        if self._short:
            said.append(f"The fitted runs last less than {SHORTEST:.0f} s in all: record 100 s, better three minutes.")
        return tuple(said)

    def _probability(self, log_odds: float) -> float:
        s = self.settings
        return float(1.0 / (1.0 + np.exp(-np.clip((log_odds - s.alarm) / s.temperature, -50, 50))))

    def _named(self, reduction: Reduction, taken: int, most: float, held: float) -> list[Finding]:
        """Findings of the last stage, sharing their probability with rivals; not handed back, at most `held`."""
        result, stage = [], self.stages[-1]
        joints = reduction.engine.joints
        variance = np.diag(stage.fit.covariance)
        entries = stage.base.coordinates.entries
        assert self.search is not None
        for number, (one, log_odds) in enumerate(zip(stage.named, self.search.worth(stage), strict=True)):
            if log_odds < self.settings.alarm - self.settings.temperature and number >= taken:
                continue  # it would not be named any more, and the model handed back does without
            i = entries.index(one.coordinates[0])
            whole = self._probability(log_odds)
            odds = np.array([one.log_odds, *(odds for _, odds in one.rivals)]) / self.settings.temperature
            share = np.exp(odds - odds.max())
            share = whole * share / share.sum()
            both = zip(one.rivals, share[1:], strict=True)
            rivals = tuple(_rival(candidate, joints, float(part)) for (candidate, _), part in both)
            known = one.candidate.model.parameters()[entries[i].parameter]
            size = float(stage.base.point[i] + (known.neutral or 0.0))
            form = self.settings.form * stage.base.point[i]
            half = QUANTILE * float(np.sqrt(self.settings.temperature * variance[i] + form**2))
            made = stage.base.linear.base[i] * (stage.base.point[i] / max(abs(stage.base.point[i]), 1e-12))
            torque = np.sqrt(np.square(made[..., reduction.kinds == 0]).mean((1, 2))) * abs(stage.base.point[i])
            torque = torque / 2 * reduction.unit  # the mean of four pieces is half of their turned sum
            felt = np.flatnonzero(torque > 0.1 * torque.max())
            around = [self.stages[min(k, len(self.stages) - 1)] for k in (number, number + 1)]
            before, after = (lacking(reduction, at) for at in around)
            result.append(
                Finding(
                    one.candidate.effect.name,
                    joints if one.candidate.joints is None else tuple(joints[j] for j in one.candidate.joints),
                    one.candidate.joints is None,
                    known.name,
                    size,
                    known.unit,
                    (size - half, size + half),
                    min(float(share[0]), most if number < taken else min(most, held)),
                    log_odds,
                    rivals,
                    float(1 - np.square(after).sum() / np.square(before).sum()),
                    {joints[reduction.judged[k]]: float(torque[k]) for k in felt},
                    in_model=number < taken,
                )
            )
        return result

    def _of_base(self, given: RobotModel, reduction: Reduction, stage: Stage, most: float) -> list[Finding]:
        """Numbers of the chain of measurement that are far from what is usual, or from what the given model says."""
        result, joints = [], reduction.engine.joints
        for i, odds, deviation, held in unusual(given, stage.base, stage.fit, stage.judge.numbers):
            if self._probability(odds) > LIKELY:
                odds = min(odds, held_odds(reduction, stage.base, i, held, self.settings))
            probability = self._probability(odds)
            if probability <= LIKELY:
                continue
            entry = stage.base.coordinates.entries[i]
            effect = next(e for e in catalogue().values() if entry.parameter in {p.name for p in e.parameters})
            known = next(p for p in effect.parameters if p.name == entry.parameter)
            value, half = float(stage.base.point[i]), QUANTILE * deviation
            where = joints if entry.joints is None else tuple(joints[j] for j in entry.joints)
            ends, probability = (value - half, value + half), min(probability, most)
            place = (where, entry.joints is None)
            told = (known.name, value, known.unit, ends, probability, odds)
            result.append(Finding(effect.name, *place, *told, of_base=True))
        return result

    @staticmethod
    def _chain(base: Base) -> list[dict[str, Any]]:
        """The numbers that joints share of the chain of measurement, beside what is usual."""
        told, known = [], base.model.parameters()
        for entry, value in zip(base.coordinates.entries, base.point, strict=True):
            chain = CHAIN.get(split_name(entry.parameter)[0])
            if chain is not None and entry.joints is None:
                numbers = {"found": float(f"{value:.4g}"), "usual": chain.usual, "spread": chain.spread}
                told.append({"name": entry.parameter, **numbers, "unit": known[entry.parameter].unit})
        return told

    def _ranking(self, reduction: Reduction, stage: Stage) -> list[dict[str, Any]]:
        """Candidates by their log odds before anything is named."""
        odds = stage.judge.scores(stage.fit)
        best: dict[tuple, tuple[float, Candidate]] = {}
        for number in np.argsort(-odds):
            if not np.isfinite(odds[number]) or len(best) == RANKED:
                break
            candidate = stage.found[number]
            best.setdefault(candidate.place, (float(odds[number]), candidate))
        return [
            plain(_rival(candidate, reduction.engine.joints, self._probability(score))) | {"log_odds": round(score, 2)}
            for score, candidate in best.values()
        ]


def _rival(candidate: Candidate, joints: Sequence[str], probability: float) -> Rival:
    where = tuple(joints) if candidate.joints is None else tuple(joints[j] for j in candidate.joints)
    return Rival(candidate.effect.name, where, candidate.joints is None, probability)
