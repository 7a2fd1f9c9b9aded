"""The diagnosis from logs to verdict: windows, baseline fit, findings in turn, gap in held-out runs."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from op3.common.plain_names import words
from op3.diagnose.aliasing import not_shown
from op3.diagnose.base import QUANTILE, Baseline, model_at, refitted_in_bounds, unfitted
from op3.diagnose.candidates import Candidate, Hypothesis
from op3.diagnose.coordinates import CHAIN
from op3.diagnose.doubts import chain_deviations, doubts, free_and_expected, unidentifiable
from op3.diagnose.findings import Search
from op3.diagnose.held_out import Gain
from op3.diagnose.judge_settings import MIN_WINDOWS, SETTINGS, Settings
from op3.diagnose.naming import NamedEffect, NamingStage, probability_shares
from op3.diagnose.reduction import Reduction
from op3.diagnose.show import show, shown_logs
from op3.diagnose.split import LogSplit
from op3.diagnose.starts import fit_base
from op3.diagnose.unexplained import joint_gaps
from op3.diagnose.verdict import LIKELY, Alternative, Finding, Verdict
from op3.diagnose.whole_runs import on_whole_runs
from op3.diagnose.window_gaps import window_gaps
from op3.replay.windows import HELD, WindowResiduals
from op3.servo import RobotModel, catalogue
from op3.servo.conditions import split_name

SHORTEST = 15.0
"""Total duration of the fitted runs below which no finding is called likely [s]."""

ON_ITS_FEET = (
    "No effects are named from logs of a robot on the floor, because contacts hide the servos' torques: record the"
    " robot on a stand, with all joints moving."
)
STILL = "No joint moves in the fitted runs: move every joint through slow triangles and fast sines."
"""Why no effect can be named."""

PER_RUN = 5
"""Budget: windows of each fitted run."""

RANKED = 15
"""Display: candidates that a verdict lists."""

STAGES = {"windows": 0.05, "baseline fit": 0.4, "candidates": 0.45, "held-out runs": 0.1}
"""Display: typical shares of the run time."""


class Diagnosis:
    """Finds the effects that a model does not include from logs.

    Args:
        model: active effects, and the initial values of the baseline fit.
        split: logs of one mount.
        seed: seed of the search and of resampling.
        without: names of effects that are not considered.
        settings: tuned constants.
        progress: called with the stage and the completed share.

    Attributes:
        seconds: processor time by stage [s].
        stages: the linear model with no effect named, one, two and so on.
        search: the search for findings; None before the run.
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
        """Diagnose; with several rounds, repeat from the returned model until nothing more is found.

        Linear algebra uses one thread, because a second thread does not help with small matrices.
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
                all_doubts = tuple(dict.fromkeys((*verdict.doubts, *further.doubts)))
                verdict = replace(further, findings=tuple(findings), doubts=all_doubts, base=verdict.base)
                shown = show(verdict.base, verdict.model, self.split, self.seed, self.given)
                models = (self.given, verdict.base, verdict.model)
                windows = window_gaps(models, first, self.split, shown_logs(self.split))
                verdict = replace(verdict, windows=windows, gap=shown["gap"], loss=shown["loss"], shown=shown)
        return verdict

    def first_stage(self, fitted: bool = True) -> NamingStage:
        """The linear model around the baseline fit, or around the given model, with no effect named."""
        with threadpool_limits(1):
            reduction = self.reduction()
            base = self._fit_base(reduction, self.given) if fitted else unfitted(reduction, self.given)
            return self._new_search(reduction).first(base)

    def _fit_base(self, reduction: Reduction, model: RobotModel) -> Baseline:
        return fit_base(reduction, model, np.random.default_rng([self.seed, 11]), self._share("baseline fit"))

    def _new_search(self, reduction: Reduction) -> Search:
        self.search = Search(reduction, self.without, self._share("candidates"))
        return self.search

    def reduction(self) -> Reduction:
        """The windows of the fitted runs."""
        windows = self.settings.windows or max(MIN_WINDOWS, PER_RUN * len(self.split.fit))
        return Reduction(WindowResiduals(self.split.fit, windows=windows), self.settings)

    def _once(self, model: RobotModel) -> Verdict:
        if self.split.fit[0].metadata.mount not in HELD:
            return self._void(model, ON_ITS_FEET)
        with self._timed("windows"):
            reduction = self.reduction()
        if not reduction.limbs:
            return self._void(model, STILL)
        with self._timed("baseline fit"):
            base = self._fit_base(reduction, model)
        with self._timed("candidates"):
            self.stages = self._new_search(reduction).run(base)
        with self._timed("held-out runs"):
            verdict = self._verdict(model, reduction)
        self._progress("held-out runs", 1.0)
        return replace(verdict, seconds=dict(self.seconds))

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        """Add the processor time of a code block to a stage."""
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
        base = refitted_in_bounds(reduction, first.base) if first.base.clipped.any() else first.base
        refits = [on_whole_runs(fitted, self.split.fit) for fitted in (base, last.base)]
        before, after = (
            fitted.point if point is None else point for fitted, point in zip((base, last.base), refits, strict=True)
        )
        baseline = model_at(base.coordinates, before)
        deviation = np.sqrt(np.diag(last.fit.covariance))[: len(after)]
        deviation = np.hypot(
            deviation, after - last.base.point
        )  # includes the difference between windows and whole runs
        returned = model_at(last.base.coordinates, after, deviation)
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
            ends=tuple(-optimum.gain for optimum in first.base.other_optima),
            not_shown=not_shown(first, reduction.engine.joints),
            shown=shown,
        )

    @property
    def _short(self) -> bool:
        return sum(log.duration for log in self.split.fit) < SHORTEST

    def _cannot_tell(self, reduction: Reduction) -> tuple[str, ...]:
        said = []
        still = [joint for joint, moves in zip(reduction.engine.joints, reduction.moving, strict=True) if not moves]
        if self.search is not None and self.search.held_out.in_time:
            said.append(
                "There are too few runs, so the end of each log is held out: errors on other motions may be larger."
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
        """Probability of a finding from its held-out gain in standard errors; at most one half for short logs."""
        s = self.settings
        most = LIKELY if self._short else 1.0
        return min(most, float(1.0 / (1.0 + np.exp(-s.steepness * (z - s.threshold)))))

    def _named(self, reduction: Reduction, stage: NamingStage) -> list[Finding]:
        assert self.search is not None
        gains = self.search.gains_with_wider_bounds(stage)
        opened = [None] * len(stage.named) if gains is None else [gain.z for gain in gains]
        return [self._finding(reduction, stage, *pair) for pair in zip(stage.named, opened, strict=True)]

    def _finding(self, reduction: Reduction, stage: NamingStage, effect: NamedEffect, opened: float | None) -> Finding:
        """A finding from a named effect, whose probability is shared with its alternatives."""
        joints, base, candidate = reduction.engine.joints, stage.base, effect.candidate
        entries = base.coordinates.entries
        i = entries.index(effect.coordinates[0])
        z = effect.gain.z if opened is None else min(effect.gain.z, opened)
        share = self._probability(z) * probability_shares(effect.rivals, self.settings)
        alternatives = tuple(
            Alternative(*_place(rival.candidate, joints), probability)
            for rival, probability in zip(effect.rivals, share[1:].tolist(), strict=True)
        )
        p = candidate.model.parameters()[entries[i].parameter]
        # includes the baseline's coordinate of the same parameter and joints
        same = [
            k
            for k, entry in enumerate(entries)
            if (entry.parameter, entry.joints) == (entries[i].parameter, entries[i].joints) and entry.kind != "scale"
        ]
        amount, variance = base.point[same].sum(), stage.fit.covariance[np.ix_(same, same)].sum()
        size = float(amount + (p.neutral or 0.0))
        half = QUANTILE * float(np.sqrt(variance + (self.settings.form_error * amount) ** 2))
        return Finding(
            candidate.effect.name,
            joints if candidate.joints is None else tuple(joints[j] for j in candidate.joints),
            candidate.joints is None,
            p.name,
            size,
            p.unit,
            (max(size - half, p.least), min(size + half, p.most)),
            float(share[0]),
            effect.log_odds,
            effect.gain,
            alternatives,
            effect.relevance.torque,
            effect.relevance.load,
            beyond=bool(base.point[i] in (entries[i].low, entries[i].high) and amount != 0.0),
            opened=opened,
        )

    def _of_base(self, given: RobotModel, reduction: Reduction, stage: NamingStage) -> list[Finding]:
        """Findings about the measurement chain: values far from usual or from the given model."""
        result, joints = [], reduction.engine.joints
        assert self.search is not None
        base, rows = stage.base, stage.judge.rows
        for deviation in chain_deviations(given, base):
            if deviation.log_odds < self.settings.alarm:
                continue
            models = free_and_expected(reduction, base, deviation.index, deviation.expected)
            gain = Gain.of(*(self.search.held_out.density(model, rows) for model in models))
            probability = self._probability(gain.z)
            if probability <= LIKELY:
                continue
            entry = base.coordinates.entries[deviation.index]
            effect = next(e for e in catalogue().values() if entry.parameter in {p.name for p in e.parameters})
            p = next(p for p in effect.parameters if p.name == entry.parameter)
            value = float(base.point[deviation.index])
            form_error = self.settings.form_error * (value - deviation.expected.prior)
            half = QUANTILE * float(np.hypot(deviation.deviation, form_error))
            interval = max(value - half, p.least), min(value + half, p.most)
            size = p.name, value, p.unit, interval
            result.append(
                Finding(effect.name, joints, True, *size, probability, deviation.log_odds, gain, of_base=True)
            )
        return result

    @staticmethod
    def _chain(base: Baseline) -> list[dict[str, Any]]:
        """Shared parameters of the measurement chain, fitted and usual."""
        result, parameters = [], base.model.parameters()
        for entry, value in zip(base.coordinates.entries, base.point, strict=True):
            usual = CHAIN.get(split_name(entry.parameter)[0])
            if usual is not None and entry.joints is None:
                values = {"found": float(f"{value:.4g}"), "usual": usual.value, "spread": usual.spread}
                result.append({"name": entry.parameter, **values, "unit": parameters[entry.parameter].unit})
        return result

    def _ranking(self, reduction: Reduction, stage: NamingStage) -> list[dict[str, Any]]:
        """Hypotheses by the log odds of their best candidate, before any effect is named."""
        odds = stage.judge.scores(stage.fit)
        best: dict[Hypothesis, tuple[float, Candidate]] = {}
        for index in np.argsort(-odds):
            if not np.isfinite(odds[index]) or len(best) == RANKED:
                break
            candidate = stage.candidates[index]
            best.setdefault(candidate.hypothesis, (float(odds[index]), candidate))
        return [
            {"effect": name, "joints": list(joints), "shared": shared, "log_odds": round(score, 2)}
            for score, candidate in best.values()
            for name, joints, shared in [_place(candidate, reduction.engine.joints)]
        ]


def _place(candidate: Candidate, joints: Sequence[str]) -> tuple[str, tuple[str, ...], bool]:
    """Effect, names of its joints, and whether these are all joints."""
    names = joints if candidate.joints is None else [joints[j] for j in candidate.joints]
    return candidate.effect.name, tuple(names), candidate.joints is None
