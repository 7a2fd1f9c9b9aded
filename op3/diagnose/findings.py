"""Findings, one after another: the judge's evidence proposes, predictions of runs that were left out decide."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

from op3.diagnose.base import ELSEWHERE, Baseline, base_numbers, settle, settled
from op3.diagnose.candidates import Candidate, candidates, parts_of, place_priors
from op3.diagnose.coordinates import Coordinate, Coordinates
from op3.diagnose.doubts import at_bound, opened
from op3.diagnose.held_out import Gain, HeldOut, HeldOutScore
from op3.diagnose.judge import Judge, Rows, Variances, log_mass
from op3.diagnose.judge_settings import SETTINGS, Settings
from op3.diagnose.naming import Judged, Named, NamingStage, Proposal, Refit, Rival, numbers_of
from op3.diagnose.reduction import COARSE, Reduction
from op3.diagnose.relevance import relevance
from op3.diagnose.starts import GEAR, robust, thin_windows
from op3.servo import Effect

MOST = 3
"""Findings that are looked for, bad joints, and places of which candidates are refitted."""

STARTS = 2
"""Forms and secants of an effect in one place that are refitted, at most."""

RELINEARISED = 60
"""Candidates whose columns are made anew around a named effect; those of the others hardly matter."""

ALIKE = 0.7
"""Correlation over runs and joints from which on two gains are gains on the same, and of rows two effects alike."""

SIZES = (1 / 16, 1 / 8, 1 / 4, 1 / 2)
"""Shares of the largest plausible size, and of the least, from which a refit may begin."""

Place = tuple[str, tuple[int, ...] | None]


class Search:
    """Looks for effects that a base lacks, but for those `without` which it has to do."""

    def __init__(
        self,
        reduction: Reduction,
        without: Sequence[str] = (),
        settings: Settings = SETTINGS,
        progress: Callable[[float], None] = lambda share: None,
    ):
        self.reduction, self.without, self.settings = reduction, tuple(without), settings
        self.progress = progress
        self.held, self.thin = HeldOut(reduction), reduction.thinned(thin_windows(reduction))

    def first(self, base: Baseline) -> NamingStage:
        """The judge around a base with nothing named."""
        found = self._candidates(base)
        columns = self._columns(base, parts_of(found), lambda share: self.progress(0.4 * share))
        if base.taken_back.any():  # all that a bad joint does would be noise
            return self._stage(base, (), found, columns, base.fit.state, 0)
        return self._stage(base, (), found, columns, None)

    def _candidates(self, base: Baseline, named: Sequence[Named] = ()) -> tuple[Candidate, ...]:
        """All that could be missing but what is named."""
        engine, taken = self.reduction.engine, {one.candidate.place for one in named}
        found = candidates(base.model, engine.joints, self.reduction.moving, engine.mirror, self.without)
        return tuple(one for one in found if one.place not in taken)

    def _columns(
        self, base: Baseline, parts: Sequence[Candidate], progress: Callable[[float], None] | None = None
    ) -> dict[tuple, np.ndarray]:
        made = self.reduction.columns(base.linear, parts, progress)
        return {one.key: column for one, column in zip(parts, made, strict=True)}

    def _stage(
        self,
        base: Baseline,
        named: tuple[Named, ...],
        found: tuple[Candidate, ...],
        columns: Mapping[tuple, np.ndarray],
        state: Variances | None,
        rounds: int = 6,
        like: Rows | None = None,
    ) -> NamingStage:
        rows = self.reduction.rows(base.linear, list(columns.values()), like)
        numbers = numbers_of(base, found, list(columns), rows, self.settings)
        judge = Judge(rows, numbers, self.settings)
        return NamingStage(base, named, found, columns, judge, judge.fit(state=state, rounds=rounds))

    def run(self, base: Baseline, most: int = MOST) -> list[NamingStage]:
        """Stages with nothing named, one effect named, two, as far as runs that were left out are predicted better."""
        stages = [self.first(base)]
        for number in range(most):
            further = self.further(stages[-1])
            if further is None and stages[-1].base.taken_back.any():
                # nothing explains what the base was taken back from: fitted within its range it may show something else
                stages[-1] = self.around(stages[-1], stages[-1].base, stages[-1].named)
                further = self.further(stages[-1])
            if further is None:
                break
            gains = self.backward(further)
            if all(self.good(gain) for gain in gains):
                stages.append(self._with_gains(further, gains))
            else:  # the new name makes an earlier one needless, and takes its place
                kept = [one for one, gain in zip(further.named, gains, strict=True) if self.good(gain)]
                stages[-1] = self.around(further, self._less(further, kept, 2), tuple(kept))
            self.progress(0.4 + 0.6 * (number + 1) / most)
        self.progress(1.0)
        return stages

    def good(self, gain: Gain) -> bool:
        """Whether runs that were left out are predicted better beyond chance."""
        return gain.z >= self.settings.threshold

    def further(self, stage: NamingStage) -> NamingStage | None:
        """The stage with one more effect named; None where none is worth it."""
        odds, shared = stage.judge.scores(stage.fit), self.shared(stage)
        leaders = self.leaders(stage, odds, stage.fit.state)
        if (named := self._name(stage, [*shared, *self.in_bad_joints(stage), *leaders])) is not None:
            return named
        # what happens in few windows only is hidden where these count for little: let them count in full to propose it,
        # and begin anew with it, so that windows which it explains count again
        gaussian = Judge(stage.judge.rows, stage.judge.numbers, self.settings, gaussian=True)
        odds = np.where(self._in_wild_windows(stage), gaussian.scores(gaussian.fit(rounds=6)), -np.inf)
        return self._name(stage, self.leaders(stage, odds, None))

    def leaders(self, stage: NamingStage, odds: np.ndarray, state: Variances | None) -> list[Proposal]:
        """Candidates of a few places, estimated anew with everything else, best first, and behind them those of their
        family: other names for what they do.

        Args:
            odds: by which candidates are proposed, ``[candidate]``.
            state: variances from which the estimates begin; None: the judge's start.
        """
        s, judge, n = self.settings, stage.judge, stage.judge.numbers
        secants: dict[Place, list[int]] = {}
        for number in np.argsort(-odds):
            if np.isfinite(odds[number]):
                secants.setdefault(stage.found[number].place, []).append(int(number))
        ranked = sorted(
            ((float(np.asarray(logsumexp(odds[mine]))), mine[:STARTS]) for mine in secants.values()), reverse=True
        )
        if not ranked or ranked[0][0] < 0.0:
            return []
        rounds = 2 if state else 6
        control, own = judge.fit(state=state, rounds=rounds), len(stage.base.point)
        estimates: list[tuple[float, Proposal]] = []
        leading = ranked[: s.leaders]
        names = {stage.found[mine[0]].effect.name for _, mine in leading[:MOST]}
        relatives: dict[str, list[int]] = {}
        for _, mine in ranked[s.leaders :]:
            if (effect := stage.found[mine[0]].effect).related(names):
                relatives.setdefault(effect.name, mine[:1])
        for number in (number for mine in [*(mine for _, mine in leading), *relatives.values()] for number in mine):
            with_it = judge.fit([number], state, rounds=rounds)
            share = float(np.clip(with_it.mean[-1], n.low[number], n.high[number]))
            truncated = float(log_mass(n.low[number], n.high[number], 0.0, n.slab[number]))
            gain = with_it.evidence - control.evidence + n.place[number] - truncated
            # what the base would do by itself it has tried: where joints stick, long steps lead astray
            step = with_it.mean[:own] - control.mean[:own]
            estimates.append((gain, Proposal(number, step, share, with_it.state)))
        estimates.sort(key=lambda one: -one[0])
        places = list(dict.fromkeys(stage.found[one.number].place for _, one in estimates))
        first, behind = places[:MOST], {stage.found[mine[0]].place for mine in relatives.values()}
        kept = {*first, *[place for place in places[MOST:] if place in behind][:MOST]}
        return [one for _, one in estimates if stage.found[one.number].place in kept]

    def in_bad_joints(self, stage: NamingStage) -> list[Proposal]:
        """Candidates in the joints of which the base was taken back farthest, one of each place, the best first, at the
        size that predicts a third of the windows best: where a fault makes a joint stick nothing linear says what it
        is, and the base has a little of what it was taken back from, which hides that."""
        base, costs = stage.base, dict[Place, tuple[float, Proposal]]()
        back = np.abs(base.linear.point - base.point) / base.coordinates.deviation
        bad = [base.coordinates.entries[i].joints for i in np.argsort(-back) if base.taken_back[i]]
        limbs = {joints: self.thin.limb_of[joints[0]] for joints in list(dict.fromkeys(bad))[:MOST] if joints}
        without = {at: self._costs(base.coordinates, base.point[None], limb)[0] for at, limb in limbs.items()}
        for number, candidate in enumerate(stage.found):
            if candidate.joints not in limbs:
                continue
            start, cost = self._begun(self._joined(stage, number, 1.0), (base.point,), limbs[candidate.joints])
            share = float(start[len(base.point)]) / candidate.secant[candidate.sized]
            gained = cost - without[candidate.joints]
            if gained < costs.get(candidate.place, (0.0,))[0]:
                costs[candidate.place] = gained, Proposal(number, np.zeros(len(base.point)), share, stage.fit.state)
        return [one for _, one in sorted(costs.values(), key=lambda one: one[0])][:MOST]

    def shared(self, stage: NamingStage) -> list[Proposal]:
        """Candidates of all joints that are evident once the base has taken a step with them, best first.

        Numbers that all joints share take such an effect's place as far as they can, and where they have, nothing that
        is linear there tells it from them. That shows on a third of the windows, with the secant of each form that the
        judge prefers.
        """
        base, thin, odds = stage.base, self.thin, stage.judge.scores(stage.fit)
        here = settle(thin, base.coordinates, base.point, self.settings, steps=0)
        rows = thin.rows(here.linear, ())

        def step(joined: Coordinates, point: np.ndarray) -> tuple[Baseline, float]:
            end = settle(thin, joined, point, self.settings, steps=1, state=here.fit.state, like=here.linear)
            judge = Judge(thin.rows(end.linear, (), rows), base_numbers(joined, end.point), self.settings)
            return end, judge.fit(state=end.fit.state, rounds=2).evidence

        _, without = step(base.coordinates, base.point)
        best: dict[tuple, int] = {}
        for number in np.argsort(odds).tolist():
            candidate = stage.found[number]
            if candidate.joints is None and np.isfinite(odds[number]):
                best[candidate.effect.name, repr(candidate.model.effect(candidate.effect.name))] = number
        proposed: list[tuple[float, Proposal]] = []
        for number in best.values():
            joined, candidate = self._joined(stage, number, 1.0), stage.found[number]
            end, evident = step(joined, np.concatenate([base.point, joined.start[len(base.point) :]]))
            thin.forget()
            gain = evident - without + self._prior(stage, number, joined)
            size = float(end.point[len(base.point)]) / candidate.secant[candidate.sized]
            moved = end.point[: len(base.point)] - base.point
            proposed.append((gain, Proposal(number, moved, size, stage.fit.state)))
        proposed.sort(key=lambda one: -one[0])
        return [one for gain, one in proposed if gain > 0.0][:MOST]

    def _joined(self, stage: NamingStage, number: int, share: float) -> Coordinates:
        """The base's numbers and a candidate's, which begin at a share of its secant."""
        candidate, coordinates = stage.found[number], stage.base.coordinates
        model = candidate.switched_on(coordinates.model, self.reduction.engine.joints)
        more = candidate.coordinates(stage.base.model, coordinates.entries, share, self.settings)
        return coordinates.extended(model, more)

    def _prior(self, stage: NamingStage, number: int, joined: Coordinates) -> float:
        """Log prior of a candidate's place, and of its numbers' being within their ranges."""
        return float(place_priors(stage.found)[number]) - _within(joined.entries[len(stage.base.point) :])

    def _in_wild_windows(self, stage: NamingStage) -> np.ndarray:
        """Candidates most of whose torque lies in windows that Student's tails weigh down, ``[candidate]``."""
        total, wild = np.zeros((2, len(stage.judge.numbers.mean)))
        for j, (at, values) in enumerate(zip(stage.judge.rows.columns, stage.judge.rows.values, strict=True)):
            energy = np.square(values[..., self.reduction.kinds < 2]).sum(2)
            total[at] += energy.sum(1)
            wild[at] += energy[:, stage.fit.state.weight[0, j] < 0.5].sum(1)
        members = [list(one) for one in stage.judge.numbers.members]
        return np.array([wild[one].sum() > 0.5 * total[one].sum() for one in members])

    def _name(self, stage: NamingStage, proposals: Sequence[Proposal]) -> NamingStage | None:
        """The proposals refitted with the base, and one of them named: the one with the most evidence, which counts
        against needless numbers, among those that predict the runs that were left out as well as the best. None where
        none predicts them better beyond chance, or all do too little."""
        if not proposals:
            return None
        refits, control = self.refitted(stage, proposals)
        scores = (self.held.score(base, stage.judge.rows) for base in (stage.base, control))
        without = max(scores, key=lambda one: one.density.sum())
        judged = [self._judged(stage, refit, without) for refit in refits]
        passed = [one for one in judged if self._passes(one.named)]
        if not passed:
            return None
        best, rivals = chosen(passed, without, self.settings.threshold)
        return self.around(stage, best.base, (*stage.named, replace(best.named, rivals=rivals)))

    def _passes(self, one: Named) -> bool:
        return self.good(one.gain) and one.relevance.matters and one.log_odds > self.settings.alarm

    def _judged(self, stage: NamingStage, refit: Refit, without: HeldOutScore) -> Judged:
        """A refit beside the model without it; what it does is held against what named effects of its family do, and
        what the base's own law of the gear does."""
        candidate, base, rows, size = stage.found[refit.number], refit.base, stage.judge.rows, len(stage.base.point)
        own, more = base.coordinates.entries[:size], base.coordinates.entries[size:]
        named = [one.coordinates[0] for one in stage.named if candidate.effect.related({one.candidate.effect.name})]
        relatives = [own.index(entry) for entry in (*named, *_of_gear(candidate.effect, base))]
        its, score = self.reduction.rows(base.linear, (), rows), self.held.score(base, rows)
        does = relevance(self.reduction, base, size, its, self.settings, relatives)
        named = Named(candidate, more, refit.log_odds, Gain.of(score, without), does)
        return Judged(named, base, score)

    def refitted(self, stage: NamingStage, proposals: Sequence[Proposal]) -> tuple[list[Refit], Baseline]:
        """Proposals refitted with the base, the best of each place, the most evident first; and the base refitted
        without, from where the most evident has left it.

        Sizes are linear in the judge's rows and too small, as the base gives way only once the effect is there; and the
        effect has one of a few shapes there, and any that is plausible here.
        """
        coordinates, point = stage.base.coordinates, stage.base.point
        best: dict[Place, Refit] = {}

        def refit(joined: Coordinates, start: np.ndarray, state: Variances, steps: int = 2) -> NamingStage:
            base = settle(self.reduction, joined, start, self.settings, steps, state, stage.base.linear)
            self.reduction.forget()
            return self._stage(base, stage.named, stage.found, stage.columns, state, 2, stage.judge.rows)

        def compared(number: int, end: NamingStage, base: float) -> Refit:
            gain = end.fit.evidence - base + self._prior(stage, number, end.base.coordinates)
            return Refit(gain, end.base, number)

        alone = stage.judge.fit(state=stage.fit.state, rounds=2)
        without = refit(coordinates, point, alone.state).fit.evidence  # the base takes as many steps without
        for one in proposals:
            joined = self._joined(stage, one.number, one.share)
            moved = np.clip(point + one.step, coordinates.low, coordinates.high)
            end = compared(one.number, refit(joined, self._begun(joined, (moved, point))[0], one.state), without)
            place = stage.found[one.number].place
            best[place] = max(end, best.get(place, end), key=lambda one: one.log_odds)
        # where joints stick the way is long; and what lets a poor base move on has no merit in what that gains
        first, *others = sorted(best.values(), key=lambda one: -one.log_odds)
        end = refit(first.base.coordinates, first.base.point, first.base.fit.state, ELSEWHERE)
        back = refit(coordinates, end.base.point[: len(point)], end.base.fit.state, ELSEWHERE)
        without = max(without, back.fit.evidence)
        best[stage.found[first.number].place] = compared(first.number, end, without)
        for one in others[: MOST - 1]:
            if one.log_odds > self.settings.alarm:
                end = refit(one.base.coordinates, one.base.point, one.base.fit.state, ELSEWHERE)
                best[stage.found[one.number].place] = compared(one.number, end, without)
        return sorted(best.values(), key=lambda one: -one.log_odds), back.base

    def _begun(
        self, joined: Coordinates, points: Sequence[np.ndarray], limb: int | None = None
    ) -> tuple[np.ndarray, float]:
        """Where a refit begins: with the base at one of some points, and the effect at its linear size or any that is
        plausible, whichever predicts a third of the windows best, of one limb where it sits there; and how well.

        Where a large fault makes a joint stick, or the base has taken it for noise, nothing linear says its size.
        """
        size, shape = joined.entries[len(points[0])], joined.start[len(points[0]) + 1 :]
        sizes = [size.start, *(end * share for end in (size.low, size.high) for share in SIZES)]
        starts = np.array([np.concatenate([at, [value], shape]) for at in points for value in sizes])
        costs = self._costs(joined, starts, limb)
        return starts[int(costs.argmin())], float(costs.min())

    def _costs(self, coordinates: Coordinates, points: np.ndarray, limb: int | None = None) -> np.ndarray:
        """How badly points ``[point, coordinate]`` predict a third of the windows."""
        limbs = self.thin.limbs if limb is None else [self.thin.limbs[limb]]
        costs = robust(self.thin.at(coordinates, points, COARSE, limb), limbs).sum(0)
        self.thin.forget()
        return costs + coordinates.penalties(points)

    def around(self, stage: NamingStage, base: Baseline, named: tuple[Named, ...]) -> NamingStage:
        """The judge around a base with what was named, the leading candidates' columns made anew."""
        base = settled(self.reduction, base, self.settings)
        odds, found = stage.judge.scores(stage.fit), self._candidates(base, named)
        moved = {key for i in np.argsort(-odds)[:RELINEARISED] for key in stage.found[i].parts}
        parts = [one for one in parts_of(found) if one.key in moved or one.key not in stage.columns]
        columns = {**stage.columns, **self._columns(base, parts)}
        return self._stage(base, named, found, {one.key: columns[one.key] for one in parts_of(found)}, base.fit.state)

    def _less(self, stage: NamingStage, kept: Sequence[Named], steps: int) -> Baseline:
        """The base with some of its names only, fitted from where it is with all."""
        gone = [entry for one in stage.named if one not in kept for entry in one.coordinates]
        whole = stage.base.coordinates
        at = [i for i, entry in enumerate(whole.entries) if entry not in gone]
        entries = tuple(whole.entries[i] for i in at)
        fitted = {entry.parameter for entry in entries}
        effects = [one.candidate.effect for one in stage.named if one not in kept]
        off = [one.name for one in effects if not fitted & {known.name for known in one.parameters}]
        coordinates = Coordinates(whole.model.without(*off), whole.joints, entries)
        state, like = stage.base.fit.state, stage.base.linear
        return settle(self.reduction, coordinates, stage.base.point[at], self.settings, steps, state, like)

    def backward(self, stage: NamingStage) -> list[Gain]:
        """The gain of the model on the model without each named effect, fitted from where it is with it."""
        rows = stage.judge.rows
        score = self.held.score(stage.base, rows)
        rest = [[other for other in stage.named if other is not one] for one in stage.named]
        return [Gain.of(score, self.held.score(self._less(stage, kept, ELSEWHERE), rows)) for kept in rest]

    def opened(self, stage: NamingStage) -> list[Gain] | None:
        """Gains of named effects with the ranges of numbers opened that ended at a bound, which might imitate them;
        None where no number did."""
        if not stage.named or not (numbers := at_bound(stage.base)):
            return None
        state = stage.base.fit.state
        base = settle(self.reduction, opened(stage.base, numbers), stage.base.point, self.settings, ELSEWHERE, state)
        return self.backward(replace(stage, base=base))

    def _with_gains(self, stage: NamingStage, gains: Sequence[Gain]) -> NamingStage:
        """The stage with gains as they are beside all that is named."""
        named = tuple(replace(one, gain=gain) for one, gain in zip(stage.named, gains, strict=True))
        return replace(stage, named=named)


def chosen(passed: Sequence[Judged], without: HeldOutScore, threshold: float) -> tuple[Judged, tuple[Rival, ...]]:
    """Which of several refits is named, and the rivals that are not distinguished from it.

    Held-out runs decide where they can. Among the refits that gain in the same runs and joints as the one with the
    largest gain, and are not worse beyond chance, the evidence decides: it counts against needless numbers.

    Args:
        passed: refits that predict held-out runs better than the model without them.
        without: held-out scores of that model.
        threshold: standard errors beyond which one refit is better than another.
    """
    leader = max(passed, key=lambda one: one.named.gain.mean)
    alike = [one for one in passed if one is leader or _alike(leader.score, one.score, without)]
    level = [one for one in alike if Gain.of(leader.score, one.score).z < threshold]
    best = max(level, key=lambda one: one.named.log_odds)
    behind = [Rival(one.named.candidate, Gain.of(best.score, one.score)) for one in level if one is not best]
    return best, tuple(rival for rival in behind if rival.behind.z < threshold)


def _alike(one: HeldOutScore, other: HeldOutScore, without: HeldOutScore) -> bool:
    """Whether two models predict the same joints of the same runs better: the correlation of their gains."""
    first, second = ((score.density - without.density).ravel() for score in (one, other))
    return float(first @ second) > ALIKE * float(np.linalg.norm(first) * np.linalg.norm(second))


def _of_gear(effect: type[Effect], base: Baseline) -> list[Coordinate]:
    """The base's shared numbers of the gear's losses, if an effect is another law of these."""
    if effect.stage not in GEAR:
        return []
    laws = [one for one in base.coordinates.model.effects if one.stage in GEAR and effect.related({one.name})]
    names = {known.name for law in laws for known in law.parameters if known.neutral is not None}
    shared = [entry for entry in base.coordinates.entries if entry.joints is None and entry.kind == "value"]
    return [entry for entry in shared if entry.parameter in names]


def _within(own: Sequence[Coordinate]) -> float:
    """Log of what the priors of an effect's numbers say of their being within their ranges."""
    return sum(float(log_mass(one.low, one.high, one.prior, one.deviation)) for one in own)
