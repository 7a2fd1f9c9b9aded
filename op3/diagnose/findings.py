"""The search for findings: in-sample evidence proposes candidates, and predictions of left-out runs decide."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

from op3.diagnose.base import FEW_STEPS, Baseline, gauss_newton, refitted_in_bounds, step_priors
from op3.diagnose.candidates import Candidate, Hypothesis, all_candidates, elementary, log_priors
from op3.diagnose.coordinates import Coordinates
from op3.diagnose.doubts import at_bound, with_wider_bounds
from op3.diagnose.held_out import Gain, HeldOut
from op3.diagnose.judge import Judge, Rows, Variances, log_mass
from op3.diagnose.linearisation import Column
from op3.diagnose.naming import NamedEffect, NamingStage, Proposal, Refit, ScoredRefit, best_refit, coefficient_priors
from op3.diagnose.reduction import COARSE, Reduction
from op3.diagnose.relevance import gear_coordinates, relevance
from op3.diagnose.starts import robust_costs

MOST = 3
"""Budget: findings, clipped joints that are examined, and hypotheses that are refitted."""

STARTS = 2
"""Budget: forms and secants of one hypothesis that are refitted."""

RELINEARISED = 60
"""Budget: number of best candidates whose columns are recomputed around a named effect."""

SIZES = (1 / 16, 1 / 8, 1 / 4, 1 / 2)
"""Numerical: initial sizes of a refit, relative to the smallest and the largest plausible size."""


class Search:
    """Searches for effects that a baseline does not include.

    Args:
        reduction: windows of the fitted runs.
        without: effects that are not considered.
        progress: called with the completed share.
    """

    def __init__(
        self, reduction: Reduction, without: Sequence[str] = (), progress: Callable[[float], None] = lambda share: None
    ):
        self.reduction, self.without, self.settings = reduction, tuple(without), reduction.settings
        self.progress = progress
        self.held_out, self.thin = HeldOut(reduction), reduction.thinned()

    def first(self, base: Baseline) -> NamingStage:
        """The linear model around a baseline with no effect named."""
        candidates = self._candidates(base)
        columns = self._columns(base, elementary(candidates), lambda share: self.progress(0.4 * share))
        if base.clipped.any():  # new variances would absorb the excess of a clipped joint
            return self._stage(base, (), candidates, columns, base.fit.variances, 0)
        return self._stage(base, (), candidates, columns, None)

    def _candidates(self, base: Baseline, named: Sequence[NamedEffect] = ()) -> tuple[Candidate, ...]:
        """All candidates except those of named hypotheses."""
        engine, hypotheses = self.reduction.engine, {effect.candidate.hypothesis for effect in named}
        every = all_candidates(base.model, engine.joints, self.reduction.moving, engine.mirror, self.without)
        return tuple(candidate for candidate in every if candidate.hypothesis not in hypotheses)

    def _columns(
        self, base: Baseline, parts: Sequence[Candidate], progress: Callable[[float], None] | None = None
    ) -> dict[tuple, Column]:
        columns = self.reduction.columns(base.linear, parts, progress)
        return {candidate.key: column for candidate, column in zip(parts, columns, strict=True)}

    def _stage(
        self,
        base: Baseline,
        named: tuple[NamedEffect, ...],
        candidates: tuple[Candidate, ...],
        columns: Mapping[tuple, Column],
        variances: Variances | None,
        rounds: int = 6,
        reference: Rows | None = None,
    ) -> NamingStage:
        rows = self.reduction.rows(base.linear, list(columns.values()), reference)
        priors = coefficient_priors(base, candidates, list(columns), rows, self.settings)
        judge = Judge(rows, priors, self.settings)
        return NamingStage(base, named, candidates, columns, judge, judge.fit(variances=variances, rounds=rounds))

    def run(self, base: Baseline) -> list[NamingStage]:
        """Stages with zero, one, two and more named effects, while the held-out density increases significantly."""
        stages = [self.first(base)]
        for number in range(MOST):
            further = self.further(stages[-1])
            if further is None and stages[-1].base.clipped.any():
                # no candidate explains the excess of the clipped joints: refit within the bounds and retry
                stages[-1] = self.around(stages[-1], stages[-1].base, stages[-1].named)
                further = self.further(stages[-1])
            if further is None:
                break
            gains = self.backward(further)
            if all(self.significant(gain) for gain in gains):
                named = tuple(replace(effect, gain=gain) for effect, gain in zip(further.named, gains, strict=True))
                stages.append(replace(further, named=named))
            else:  # the new effect replaces an earlier one
                kept = [effect for effect, gain in zip(further.named, gains, strict=True) if self.significant(gain)]
                stages[-1] = self.around(further, self._without_others(further, kept, 2), tuple(kept))
            self.progress(0.4 + 0.6 * (number + 1) / MOST)
        self.progress(1.0)
        return stages

    def significant(self, gain: Gain) -> bool:
        """Whether a held-out gain exceeds the threshold."""
        return gain.z >= self.settings.threshold

    def further(self, stage: NamingStage) -> NamingStage | None:
        """The stage with one more effect named; None if no candidate is accepted."""
        odds, shared = stage.judge.scores(stage.fit), self.shared(stage)
        leaders = self.leaders(stage, odds, stage.fit.variances)
        if (named := self._name(stage, [*shared, *self.in_clipped_joints(stage), *leaders])) is not None:
            return named
        # Student weights hide effects that act in few windows: propose these with Gaussian noise, then estimate the
        # weights again
        gaussian = Judge(stage.judge.rows, stage.judge.priors, self.settings, gaussian=True)
        odds = np.where(self._in_outlier_windows(stage), gaussian.scores(gaussian.fit(rounds=6)), -np.inf)
        return self._name(stage, self.leaders(stage, odds, None))

    def leaders(self, stage: NamingStage, odds: np.ndarray, variances: Variances | None) -> list[Proposal]:
        """The candidates of the best hypotheses in the linear model, best first, and their confounders.

        Args:
            stage: the linear model.
            odds: log odds by which hypotheses are ranked, ``[candidate]``.
            variances: initial variances; None: the defaults.
        """
        s, judge, priors = self.settings, stage.judge, stage.judge.priors
        by_hypothesis: dict[Hypothesis, list[int]] = {}
        for index in np.argsort(-odds):
            if np.isfinite(odds[index]):
                by_hypothesis.setdefault(stage.candidates[index].hypothesis, []).append(int(index))
        ranked = sorted(
            ((float(np.asarray(logsumexp(odds[indices]))), indices[:STARTS]) for indices in by_hypothesis.values()),
            reverse=True,
        )
        if not ranked or ranked[0][0] < 0.0:
            return []
        leading = [indices for _, indices in ranked[: s.leaders]]
        names = {stage.candidates[indices[0]].effect.name for indices in leading[:MOST]}
        confounders: dict[str, list[int]] = {}
        for _, indices in ranked[s.leaders :]:
            if (effect := stage.candidates[indices[0]].effect).related(names):
                confounders.setdefault(effect.name, indices[:1])
        rounds = 2 if variances else 6
        control, size = judge.fit(variances=variances, rounds=rounds), len(stage.base.point)
        proposals: list[tuple[float, Proposal]] = []
        for index in (index for indices in [*leading, *confounders.values()] for index in indices):
            fit = judge.fit([index], variances, rounds=rounds)
            share = float(np.clip(fit.mean[-1], priors.low[index], priors.high[index]))
            truncation = float(log_mass(priors.low[index], priors.high[index], 0.0, priors.slab[index]))
            gain = fit.evidence - control.evidence + priors.log_prior[index] - truncation
            # without the baseline's own step: long linear steps are wrong if joints stick
            step = fit.mean[:size] - control.mean[:size]
            proposals.append((gain, Proposal(index, step, share, fit.variances)))
        proposals.sort(key=lambda scored: -scored[0])
        hypotheses = list(dict.fromkeys(stage.candidates[proposal.index].hypothesis for _, proposal in proposals))
        related = {stage.candidates[indices[0]].hypothesis for indices in confounders.values()}
        kept = {*hypotheses[:MOST], *[hypothesis for hypothesis in hypotheses[MOST:] if hypothesis in related][:MOST]}
        return [proposal for _, proposal in proposals if stage.candidates[proposal.index].hypothesis in kept]

    def in_clipped_joints(self, stage: NamingStage) -> list[Proposal]:
        """The best candidate of each hypothesis in the joints that were clipped most, best first, at the size that
        predicts a third of the windows best. The linear model does not reveal a fault that makes a joint stick."""
        base, costs = stage.base, dict[Hypothesis, tuple[float, Proposal]]()
        excess = np.abs(base.linear.point - base.point) / base.coordinates.deviation
        clipped = [base.coordinates.entries[i].joints for i in np.argsort(-excess) if base.clipped[i]]
        limbs = {joints: self.thin.limb_of[joints[0]] for joints in list(dict.fromkeys(clipped))[:MOST] if joints}
        control = {joints: self._costs(base.coordinates, base.point[None], limb)[0] for joints, limb in limbs.items()}
        for index, candidate in enumerate(stage.candidates):
            if candidate.joints not in limbs:
                continue
            start, cost = self._best_start(self._joined(stage, index, 1.0), (base.point,), limbs[candidate.joints])
            share = float(start[len(base.point)]) / candidate.secant[candidate.size_parameter]
            change = cost - control[candidate.joints]
            if change < costs.get(candidate.hypothesis, (0.0,))[0]:
                proposal = Proposal(index, np.zeros(len(base.point)), share, stage.fit.variances)
                costs[candidate.hypothesis] = change, proposal
        return [proposal for _, proposal in sorted(costs.values(), key=lambda scored: scored[0])][:MOST]

    def shared(self, stage: NamingStage) -> list[Proposal]:
        """Candidates of all joints that have evidence after one nonlinear step with the baseline, best first.

        The baseline's shared parameters imitate such an effect, so the linear model at the fitted point does not reveal
        it. The step uses a third of the windows and the best secant of each form.
        """
        base, thin, odds = stage.base, self.thin, stage.judge.scores(stage.fit)
        start = gauss_newton(thin, base.coordinates, base.point, steps=0)
        rows = thin.rows(start.linear)

        def step(joined: Coordinates, point: np.ndarray) -> tuple[Baseline, float]:
            end = gauss_newton(thin, joined, point, 1, start.fit.variances, start.linear)
            judge = Judge(thin.rows(end.linear, (), rows), step_priors(joined, end.point), self.settings)
            return end, judge.fit(variances=end.fit.variances, rounds=2).evidence

        _, control = step(base.coordinates, base.point)
        best: dict[tuple, int] = {}
        for index in np.argsort(odds).tolist():
            candidate = stage.candidates[index]
            if candidate.joints is None and np.isfinite(odds[index]):
                best[candidate.effect.name, repr(candidate.model.effect(candidate.effect.name))] = index
        proposals: list[tuple[float, Proposal]] = []
        for index in best.values():
            joined, candidate = self._joined(stage, index, 1.0), stage.candidates[index]
            end, evidence = step(joined, np.concatenate([base.point, joined.start[len(base.point) :]]))
            thin.forget()
            gain = evidence - control + self._log_prior(stage, index, joined)
            share = float(end.point[len(base.point)]) / candidate.secant[candidate.size_parameter]
            change = end.point[: len(base.point)] - base.point
            proposals.append((gain, Proposal(index, change, share, stage.fit.variances)))
        proposals.sort(key=lambda scored: -scored[0])
        return [proposal for gain, proposal in proposals if gain > 0.0][:MOST]

    def _joined(self, stage: NamingStage, index: int, share: float) -> Coordinates:
        """The coordinates of the baseline and of a candidate, which starts at a share of its secant."""
        candidate, coordinates = stage.candidates[index], stage.base.coordinates
        model = candidate.switched_on(coordinates.model, self.reduction.engine.joints)
        further = candidate.coordinates(stage.base.model, coordinates.entries, share, self.settings)
        return coordinates.extended(model, further)

    def _log_prior(self, stage: NamingStage, index: int, joined: Coordinates) -> float:
        """Log prior of a candidate's hypothesis, with the priors of its coordinates truncated to their bounds."""
        further = joined.entries[len(stage.base.point) :]
        in_bounds = sum(float(log_mass(entry.low, entry.high, entry.prior, entry.deviation)) for entry in further)
        return float(log_priors(stage.candidates)[index]) - in_bounds

    def _in_outlier_windows(self, stage: NamingStage) -> np.ndarray:
        """Candidates that act mainly in windows with a low Student weight, ``[candidate]``."""
        total, outlying = np.zeros((2, len(stage.judge.priors.mean)))
        for j, (indices, design) in enumerate(zip(stage.judge.rows.coefficients, stage.judge.rows.design, strict=True)):
            energy = np.square(design[..., self.reduction.kinds < 2]).sum(2)
            total[indices] += energy.sum(1)
            outlying[indices] += energy[:, stage.fit.variances.weight[0, j] < 0.5].sum(1)
        members = [list(member) for member in stage.judge.priors.members]
        return np.array([outlying[member].sum() > 0.5 * total[member].sum() for member in members])

    def _name(self, stage: NamingStage, proposals: Sequence[Proposal]) -> NamingStage | None:
        """Refit the proposals and name one: among those that predict left-out runs as well as the best, the one with
        the most evidence. None if no proposal predicts them significantly better with a relevant torque."""
        if not proposals:
            return None
        refits, control = self.refitted(stage, proposals)
        densities = (self.held_out.density(base, stage.judge.rows) for base in (stage.base, control))
        without = max(densities, key=lambda density: density.sum())
        scored = [self._scored(stage, refit, without) for refit in refits]
        accepted = [refit for refit in scored if self._accepted(refit.effect)]
        if not accepted:
            return None
        best, rivals = best_refit(accepted, without, self.settings)
        return self.around(stage, best.base, (*stage.named, replace(best.effect, rivals=rivals)))

    def _accepted(self, effect: NamedEffect) -> bool:
        return self.significant(effect.gain) and effect.relevance.matters and effect.log_odds > self.settings.alarm

    def _scored(self, stage: NamingStage, refit: Refit, without: np.ndarray) -> ScoredRefit:
        """A refit with its held-out gain, and its relevance beside related effects and the gear law."""
        candidate, base, size = stage.candidates[refit.index], refit.base, len(stage.base.point)
        entries, further = base.coordinates.entries[:size], base.coordinates.entries[size:]
        related = [e.coordinates[0] for e in stage.named if candidate.effect.related({e.candidate.effect.name})]
        relatives = [entries.index(entry) for entry in (*related, *gear_coordinates(candidate.effect, base))]
        rows = self.reduction.rows(base.linear, (), stage.judge.rows)
        density = self.held_out.density(base, stage.judge.rows)
        relevant = relevance(self.reduction, base, size, rows, relatives)
        effect = NamedEffect(candidate, further, refit.log_odds, Gain.of(density, without), relevant)
        return ScoredRefit(effect, base, density)

    def refitted(self, stage: NamingStage, proposals: Sequence[Proposal]) -> tuple[list[Refit], Baseline]:
        """The best refit of each proposed hypothesis, the most evidence first, and the baseline refitted without the
        effect from the end point of the best refit.

        Sizes from the linear model are too small, because the baseline adapts only after the effect is included. The
        shape of an effect is fitted too.
        """
        coordinates, point = stage.base.coordinates, stage.base.point
        best: dict[Hypothesis, Refit] = {}

        def refit(
            joined: Coordinates, start: np.ndarray, variances: Variances, steps: int = 2
        ) -> tuple[Baseline, float]:
            """The fit and its evidence; the linear model around it is not kept, because it takes 100 MB."""
            base = gauss_newton(self.reduction, joined, start, steps, variances, stage.base.linear)
            self.reduction.forget()
            around = self._stage(base, stage.named, stage.candidates, stage.columns, variances, 2, stage.judge.rows)
            return base, around.fit.evidence

        def compared(index: int, end: tuple[Baseline, float], control: float) -> Refit:
            base, evidence = end
            return Refit(evidence - control + self._log_prior(stage, index, base.coordinates), base, index)

        alone = stage.judge.fit(variances=stage.fit.variances, rounds=2)
        _, control = refit(coordinates, point, alone.variances)  # as many steps as with an effect
        for proposal in proposals:
            joined = self._joined(stage, proposal.index, proposal.share)
            stepped = np.clip(point + proposal.step, coordinates.low, coordinates.high)
            start, _ = self._best_start(joined, (stepped, point))
            end = compared(proposal.index, refit(joined, start, proposal.variances), control)
            hypothesis = stage.candidates[proposal.index].hypothesis
            best[hypothesis] = max(end, best.get(hypothesis, end), key=lambda refit: refit.log_odds)
        # if joints stick, convergence is slow; gains of the baseline alone are not evidence
        first, *others = sorted(best.values(), key=lambda refit: -refit.log_odds)
        end = refit(first.base.coordinates, first.base.point, first.base.fit.variances, FEW_STEPS)
        back, evidence = refit(coordinates, end[0].point[: len(point)], end[0].fit.variances, FEW_STEPS)
        control = max(control, evidence)
        best[stage.candidates[first.index].hypothesis] = compared(first.index, end, control)
        for other in others[: MOST - 1]:
            if other.log_odds > self.settings.alarm:
                end = refit(other.base.coordinates, other.base.point, other.base.fit.variances, FEW_STEPS)
                best[stage.candidates[other.index].hypothesis] = compared(other.index, end, control)
        return sorted(best.values(), key=lambda refit: -refit.log_odds), back

    def _best_start(
        self, joined: Coordinates, points: Sequence[np.ndarray], limb: int | None = None
    ) -> tuple[np.ndarray, float]:
        """The start of a refit that best predicts a third of the windows, and its cost.

        Starts combine points of the baseline with the size from the linear model and with `SIZES`, because the linear
        model does not give the size of a fault that makes a joint stick.
        """
        size, shape = joined.entries[len(points[0])], joined.start[len(points[0]) + 1 :]
        sizes = [size.start, *(bound * share for bound in (size.low, size.high) for share in SIZES)]
        starts = np.array([np.concatenate([point, [value], shape]) for point in points for value in sizes])
        costs = self._costs(joined, starts, limb)
        return starts[int(costs.argmin())], float(costs.min())

    def _costs(self, coordinates: Coordinates, points: np.ndarray, limb: int | None = None) -> np.ndarray:
        """Robust costs of points ``[point, coordinate]`` on a third of the windows, of one limb or of all."""
        limbs = self.thin.limbs if limb is None else [self.thin.limbs[limb]]
        costs = robust_costs(self.thin.errors_at(coordinates, points, COARSE, limb), limbs).sum(0)
        self.thin.forget()
        return costs + coordinates.penalties(points)

    def around(self, stage: NamingStage, base: Baseline, named: tuple[NamedEffect, ...]) -> NamingStage:
        """The linear model around a baseline with named effects, with new columns of the best candidates."""
        base = refitted_in_bounds(self.reduction, base)
        odds, candidates = stage.judge.scores(stage.fit), self._candidates(base, named)
        keys = {key for i in np.argsort(-odds)[:RELINEARISED] for key in stage.candidates[i].components}
        parts = elementary(candidates)
        renewed = [part for part in parts if part.key in keys or part.key not in stage.columns]
        columns = {**stage.columns, **self._columns(base, renewed)}
        return self._stage(base, named, candidates, {part.key: columns[part.key] for part in parts}, base.fit.variances)

    def _without_others(self, stage: NamingStage, kept: Sequence[NamedEffect], steps: int) -> Baseline:
        """The baseline with some of the named effects only, fitted from the point with all."""
        removed = [effect for effect in stage.named if effect not in kept]
        removed_entries = [entry for effect in removed for entry in effect.coordinates]
        full = stage.base.coordinates
        indices = [i for i, entry in enumerate(full.entries) if entry not in removed_entries]
        entries = tuple(full.entries[i] for i in indices)
        fitted = {entry.parameter for entry in entries}
        effects = [effect.candidate.effect for effect in removed]
        off = [effect.name for effect in effects if not fitted & {p.name for p in effect.parameters}]
        coordinates = Coordinates(full.model.without(*off), full.joints, entries)
        point, variances = stage.base.point[indices], stage.base.fit.variances
        return gauss_newton(self.reduction, coordinates, point, steps, variances, stage.base.linear)

    def backward(self, stage: NamingStage) -> list[Gain]:
        """Held-out gain over the model without each named effect in turn, refitted from the point with the effect."""
        rows = stage.judge.rows
        density = self.held_out.density(stage.base, rows)
        others = [[other for other in stage.named if other is not effect] for effect in stage.named]
        reduced = (self._without_others(stage, kept, FEW_STEPS) for kept in others)
        return [Gain.of(density, self.held_out.density(base, rows)) for base in reduced]

    def gains_with_wider_bounds(self, stage: NamingStage) -> list[Gain] | None:
        """Gains of the named effects after widening the bounds of parameters that ended at a bound, because these might
        imitate the effects; None if no parameter did."""
        if not stage.named or not (entries := at_bound(stage.base)):
            return None
        point, variances = stage.base.point, stage.base.fit.variances
        wide = with_wider_bounds(stage.base, entries)
        base = gauss_newton(self.reduction, wide, point, FEW_STEPS, variances)
        return self.backward(replace(stage, base=base))
