"""The workflow: windows, baseline fit, findings one after another, the gap of the model with them."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from op3.common.plain_names import words
from op3.diagnose.base import QUANTILE, Baseline, at_point, settled, unfitted
from op3.diagnose.candidates import Candidate
from op3.diagnose.coordinates import CHAIN
from op3.diagnose.doubts import doubts, freed, unidentifiable, unusual
from op3.diagnose.findings import Search
from op3.diagnose.held_out import Gain
from op3.diagnose.judge_settings import SETTINGS, Settings
from op3.diagnose.naming import NamingStage
from op3.diagnose.reduction import Reduction
from op3.diagnose.show import show, shown_logs
from op3.diagnose.split import LogSplit
from op3.diagnose.starts import fit_base
from op3.diagnose.unexplained import joint_gaps
from op3.diagnose.verdict import LIKELY, Alternative, Finding, Verdict
from op3.diagnose.visibility import not_shown
from op3.diagnose.whole_runs import on_whole_runs
from op3.diagnose.window_gaps import window_gaps
from op3.replay.windows import HELD, WindowResiduals
from op3.servo import RobotModel, catalogue
from op3.servo.conditions import split_name

SHORTEST = 15.0
"""Fitted runs shorter than this in all carry no name [s]."""

ON_ITS_FEET = (
    "No effects are named from logs of a robot on the floor, because contacts hide its servos' torques: record it on a"
    " stand, with all joints moving."
)
STILL = "No joint moves in the fitted runs: move every joint through slow triangles and fast sines."
"""Why no effect can be named."""

FEWEST, PER_RUN = 72, 5
"""Windows of the fitted runs, and of each of them."""

RANKED = 15
"""Candidates that a verdict lists."""

STAGES = {"windows": 0.05, "baseline fit": 0.4, "candidates": 0.45, "held-out runs": 0.1}
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
        self.stages: list[NamingStage] = []
        self.search: Search | None = None

    def run(self, rounds: int = 1) -> Verdict:
        """Diagnose; with more rounds, go on from the model handed back until nothing more is found.

        Linear algebra gets one thread: its matrices are small, and a second thread would wait, using a whole core.
        """
        with threadpool_limits(1):
            verdict = self._once(self.given)
            for _ in range(rounds - 1):
                if all(finding.of_base for finding in verdict.findings):
                    break
                first, further = self.stages[0].base, self._once(verdict.model)
                if all(finding.of_base for finding in further.findings):
                    break
                findings = sorted((*verdict.findings, *further.findings), key=lambda finding: -finding.probability)
                doubted = tuple(dict.fromkeys((*verdict.doubts, *further.doubts)))
                verdict = replace(further, findings=tuple(findings), doubts=doubted, base=verdict.base)
                shown = show(verdict.base, verdict.model, self.split, self.seed, self.given)
                models = (self.given, verdict.base, verdict.model)
                windows = window_gaps(models, first, self.split, shown_logs(self.split))
                verdict = replace(verdict, windows=windows, gap=shown["gap"], loss=shown["loss"], shown=shown)
        return verdict

    def first_stage(self, fitted: bool = True) -> NamingStage:
        """The judge around the base with nothing named; of simulated logs around the given model as it is."""
        with threadpool_limits(1):
            reduction = self.reduction()
            base = self._base(reduction, self.given) if fitted else unfitted(reduction, self.given, self.settings)
            return self._searching(reduction).first(base)

    def _base(self, reduction: Reduction, model: RobotModel) -> Baseline:
        rng = np.random.default_rng([self.seed, 11])
        return fit_base(reduction, model, rng, self.settings, self._share("baseline fit"))

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
        with self._timed("baseline fit"):
            base = self._base(reduction, model)
        with self._timed("candidates"):
            self.stages = self._searching(reduction).run(base)
        with self._timed("held-out runs"):
            verdict = self._verdict(model, reduction)
        self._progress("held-out runs", 1.0)
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
        return Verdict((), {}, (), (), (why,), model, model, None, shown["gap"], shown["loss"], shown=shown)

    def _verdict(self, given: RobotModel, reduction: Reduction) -> Verdict:
        first, last = self.stages[0], self.stages[-1]
        base = settled(reduction, first.base, self.settings) if first.base.taken_back.any() else first.base
        points = [on_whole_runs(one, self.split.fit) for one in (base, last.base)]
        before, after = (one.point if at is None else at for one, at in zip((base, last.base), points, strict=True))
        baseline = at_point(base.coordinates, before)
        deviation = np.sqrt(np.diag(last.fit.covariance))[: len(after)]
        deviation = np.hypot(deviation, after - last.base.point)  # windows and whole runs disagree by so much
        returned = at_point(last.base.coordinates, after, deviation)
        findings = [*self._named(reduction, last), *self._of_base(given, reduction, last)]
        shown = show(baseline, returned, self.split, self.seed, given)
        return Verdict(
            tuple(sorted(findings, key=lambda finding: -finding.probability)),
            joint_gaps(reduction, first, last),
            doubts(base),
            tuple(unidentifiable(base)),
            self._cannot_tell(reduction),
            baseline,
            returned,
            window_gaps((given, baseline, returned), base, self.split, shown_logs(self.split)),
            shown["gap"],
            shown["loss"],
            self._chain(base),
            self._ranking(reduction, first),
            ends=tuple(-end.gain for end in first.base.others),
            not_shown=not_shown(first, reduction.engine.joints),
            shown=shown,
        )

    @property
    def _short(self) -> bool:
        return sum(log.duration for log in self.split.fit) < SHORTEST

    def _cannot_tell(self, reduction: Reduction) -> tuple[str, ...]:
        said = []
        still = [joint for joint, moves in zip(reduction.engine.joints, reduction.moving, strict=True) if not moves]
        if self.search is not None and self.search.held.in_time:
            said.append(
                "There are too few runs, so the logs were cut in time instead: errors on other motions may be larger."
            )
        if still:
            said.append(
                f"{', '.join(map(words, still))} hardly moved, so no effect can be named there: move every joint."
            )
        if self._short:
            said.append(
                f"The fitted runs last less than {SHORTEST:.0f} s in total: record 100 s or, better, three minutes."
            )
        return tuple(said)

    def _probability(self, z: float) -> float:
        """That a gain of so many standard errors is no chance; of short logs not beyond a half."""
        s = self.settings
        most = LIKELY if self._short else 1.0
        return min(most, float(1.0 / (1.0 + np.exp(-s.steepness * (z - s.threshold)))))

    def _named(self, reduction: Reduction, stage: NamingStage) -> list[Finding]:
        """Findings of the last stage, sharing their probability with rivals."""
        assert self.search is not None
        result, joints, opened = [], reduction.engine.joints, self.search.opened(stage)
        entries = stage.base.coordinates.entries
        places = [(entry.parameter, entry.joints) for entry in entries]
        for number, one in enumerate(stage.named):
            i = entries.index(one.coordinates[0])
            share = np.exp(-self.settings.steepness * np.array([0.0, *(max(r.behind.z, 0.0) for r in one.rivals)]))
            z = one.gain.z if opened is None else min(one.gain.z, opened[number].z)
            share = self._probability(z) * share / share.sum()
            shares = zip(one.rivals, share[1:].tolist(), strict=True)
            rivals = tuple(_alternative(rival.candidate, joints, part) for rival, part in shares)
            known = one.candidate.model.parameters()[entries[i].parameter]
            # with what the baseline has of the same number of that servo alone
            both = [k for k, place in enumerate(places) if place == places[i] and entries[k].kind != "scale"]
            point, variance = stage.base.point[both].sum(), stage.fit.covariance[np.ix_(both, both)].sum()
            size = float(point + (known.neutral or 0.0))
            half = QUANTILE * float(np.sqrt(variance + (self.settings.form * point) ** 2))
            result.append(
                Finding(
                    one.candidate.effect.name,
                    joints if one.candidate.joints is None else tuple(joints[j] for j in one.candidate.joints),
                    one.candidate.joints is None,
                    known.name,
                    size,
                    known.unit,
                    (max(size - half, known.least), min(size + half, known.most)),
                    float(share[0]),
                    one.log_odds,
                    one.gain,
                    rivals,
                    one.relevance.torque,
                    one.relevance.load,
                    beyond=bool(stage.base.point[i] in (entries[i].low, entries[i].high) and point != 0.0),
                    opened=None if opened is None else opened[number].z,
                )
            )
        return result

    def _of_base(self, given: RobotModel, reduction: Reduction, stage: NamingStage) -> list[Finding]:
        """Numbers of the chain of measurement that are far from what is usual, or from what the given model says."""
        result, joints = [], reduction.engine.joints
        assert self.search is not None
        base, rows = stage.base, stage.judge.rows
        for one in unusual(given, base):
            if one.log_odds < self.settings.alarm:
                continue
            better, usual = freed(reduction, base, one.number, one.held, self.settings)
            gain = Gain.of(self.search.held.score(better, rows), self.search.held.score(usual, rows))
            probability = self._probability(gain.z)
            if probability <= LIKELY:
                continue
            entry = base.coordinates.entries[one.number]
            effect = next(e for e in catalogue().values() if entry.parameter in {p.name for p in e.parameters})
            known = next(p for p in effect.parameters if p.name == entry.parameter)
            value = float(base.point[one.number])
            off = self.settings.form * (value - one.held.prior)
            half = QUANTILE * float(np.hypot(one.deviation, off))
            ends = max(value - half, known.least), min(value + half, known.most)
            told = (known.name, value, known.unit, ends, probability, one.log_odds, gain)
            result.append(Finding(effect.name, joints, True, *told, of_base=True))
        return result

    @staticmethod
    def _chain(base: Baseline) -> list[dict[str, Any]]:
        """The numbers that joints share of the chain of measurement, beside what is usual."""
        told, known = [], base.model.parameters()
        for entry, value in zip(base.coordinates.entries, base.point, strict=True):
            chain = CHAIN.get(split_name(entry.parameter)[0])
            if chain is not None and entry.joints is None:
                numbers = {"found": float(f"{value:.4g}"), "usual": chain.value, "spread": chain.spread}
                told.append({"name": entry.parameter, **numbers, "unit": known[entry.parameter].unit})
        return told

    def _ranking(self, reduction: Reduction, stage: NamingStage) -> list[dict[str, Any]]:
        """Candidates by their log odds before anything is named."""
        odds = stage.judge.scores(stage.fit)
        best: dict[tuple, tuple[float, Candidate]] = {}
        for number in np.argsort(-odds):
            if not np.isfinite(odds[number]) or len(best) == RANKED:
                break
            candidate = stage.found[number]
            best.setdefault(candidate.place, (float(odds[number]), candidate))
        return [
            {"effect": name, "joints": joints, "shared": shared, "log_odds": round(score, 2)}
            for score, candidate in best.values()
            for name, joints, shared in [_place(candidate, reduction.engine.joints)]
        ]


def _place(candidate: Candidate, joints: Sequence[str]) -> tuple[str, list[str], bool]:
    """Effect, names of its joints, and whether these are all."""
    where = list(joints) if candidate.joints is None else [joints[j] for j in candidate.joints]
    return candidate.effect.name, where, candidate.joints is None


def _alternative(candidate: Candidate, joints: Sequence[str], probability: float) -> Alternative:
    name, where, shared = _place(candidate, joints)
    return Alternative(name, tuple(where), shared, probability)
