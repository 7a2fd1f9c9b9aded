"""Findings, one after another: the judge's evidence proposes, predictions of runs that were left out decide."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from op3.diagnose.base import ELSEWHERE, Baseline, base_numbers, robust, settle, thin_windows
from op3.diagnose.candidates import Candidate, candidates, parts_of, place_priors, secants_of_place
from op3.diagnose.coordinates import Coordinate, Coordinates
from op3.diagnose.doubts import at_bound, opened
from op3.diagnose.held_out import Gain, HeldOut, HeldOutScore
from op3.diagnose.judge import Judge, Numbers, Posterior, Rows, Variances, log_mass
from op3.diagnose.judge_settings import SETTINGS, Settings
from op3.diagnose.reduction import COARSE, Reduction
from op3.diagnose.relevance import Relevance, relevance

MOST = 3
"""Findings that are looked for, and places of which candidates are refitted."""

STARTS = 2
"""Forms and secants of an effect in one place that are refitted, at most."""

RELINEARISED = 60
"""Candidates whose columns are made anew around a named effect; those of the others hardly matter."""

ALIKE = 0.7
"""Correlation over runs and joints from which on two gains are gains on the same."""

SIZES = (1 / 16, 1 / 8, 1 / 4, 1 / 2)
"""Shares of the largest plausible size, and of the least, from which a refit may begin."""

NOTHING = 1e-6
"""Torque below which a candidate does nothing here [units]."""

Place = tuple[str, tuple[int, ...] | None]


@dataclass(frozen=True, eq=False)
class Proposal:
    """A candidate with the size that is linear in the judge's rows.

    Attributes:
        number: of the candidate.
        step: how far the base's numbers move with it, ``[coordinate]``.
        share: of its secant.
        state: the judge's variances.
    """

    number: int
    step: np.ndarray
    share: float
    state: Variances


@dataclass(frozen=True, eq=False)
class Refit:
    """A candidate fitted with everything else, nonlinearly.

    Attributes:
        log_odds: by the evidence of the windows that were fitted.
        base: the fit.
        number: of the candidate.
        coordinates: its own numbers in the fit, its size the first.
    """

    log_odds: float
    base: Baseline
    number: int
    coordinates: tuple[Coordinate, ...]


@dataclass(frozen=True, eq=False)
class Judged:
    """A refit beside the model without it.

    Attributes:
        refit: what was fitted.
        candidate: what it is of.
        score: of runs that were left out.
        gain: on the model without it.
        relevance: what it does.
    """

    refit: Refit
    candidate: Candidate
    score: HeldOutScore
    gain: Gain
    relevance: Relevance

    @property
    def evidence(self) -> float:
        """What fitted windows and runs that were left out say together."""
        return self.refit.log_odds + self.gain.mean * self.gain.runs


@dataclass(frozen=True, eq=False)
class Rival:
    """A name that predicts runs that were left out as well as a finding's, and the same of them.

    Attributes:
        candidate: what it is.
        behind: the finding's gain on it.
    """

    candidate: Candidate
    behind: Gain


@dataclass(frozen=True, eq=False)
class Named:
    """An effect that was found.

    Attributes:
        candidate: what it is.
        coordinates: its numbers in the fit, its size the first.
        log_odds: by the evidence of the windows that were fitted, when it was named.
        gain: of the model with it on the model without, in runs that were left out.
        relevance: what it does.
        rivals: names that are not distinguished from it.
    """

    candidate: Candidate
    coordinates: tuple[Coordinate, ...]
    log_odds: float
    gain: Gain
    relevance: Relevance
    rivals: tuple[Rival, ...] = ()


@dataclass(frozen=True, eq=False)
class NamingStage:
    """The judge around a base with some effects named.

    Attributes:
        base: the fit, the named effects' numbers the last of its own.
        named: the effects.
        found: candidates.
        columns: of those in one joint or in all, by key, ``[joint, window, row]``.
        judge: of them.
        fit: with nothing else named.
    """

    base: Baseline
    named: tuple[Named, ...]
    found: tuple[Candidate, ...]
    columns: Mapping[tuple, np.ndarray]
    judge: Judge
    fit: Posterior


def numbers_of(
    base: Baseline, found: Sequence[Candidate], parts: Sequence[tuple], rows: Rows, settings: Settings = SETTINGS
) -> Numbers:
    """Priors of the base's numbers and of the candidates.

    A spike is what makes so much torque, root mean square over the joints that feel it; the secants of one effect in
    one place share it, and the place's prior. Parts are keys of candidates in one joint or in all, of which the others
    are sums.
    """
    own, number = base.numbers, {key: i for i, key in enumerate(parts)}
    model = base.model
    low, high, slab = np.array([one.reach(model, settings) for one in found]).reshape(-1, 3).T
    size = _torques(rows, len(base.point), len(parts))
    spike, secants = np.full(len(parts), 1e-9), secants_of_place(found)
    for one, wide, count in zip(found, slab, secants, strict=True):
        i = number.get(one.key)
        if i is not None and size[i] > NOTHING:
            ends = settings.spike_ends[0] * wide, settings.spike_ends[1] * wide
            spike[i] = np.clip(settings.spike / size[i], *ends) / np.sqrt(count)
    members = [tuple(number[key] for key in one.parts if key in number) for one in found]
    seen = np.array([max((size[i] for i in one), default=0.0) > NOTHING for one in members], bool)
    return Numbers(
        np.concatenate([own.mean, np.zeros(len(parts))]),
        np.concatenate([own.deviation, spike]),
        tuple(tuple(len(base.point) + i for i in one) for one in members),
        slab,
        low,
        high,
        np.where(seen, place_priors(found) - np.log(secants), -np.inf),
        np.concatenate([own.least, np.full(len(parts), -np.inf)]),
        np.concatenate([own.most, np.full(len(parts), np.inf)]),
    )


def _torques(rows: Rows, own: int, count: int) -> np.ndarray:
    """What each column behind the base's makes, root mean square over the joints that feel it [units], ``[column]``."""
    square, felt, torque = np.zeros(count), np.zeros(count), rows.kinds < 2
    for columns, values, variance in zip(rows.columns, rows.values, rows.variance, strict=True):
        mine, seen = columns >= own, np.isfinite(variance[:, 0])
        part = np.abs(values[mine][:, seen][..., torque]).reshape(int(mine.sum()), -1)
        if part.size:
            part = np.minimum(part, np.quantile(part, 0.97, axis=1, keepdims=True))
            square[columns[mine] - own] += np.square(part).sum(1)
            felt[columns[mine] - own] += part.shape[1]
    return np.sqrt(square / np.maximum(felt, 1))


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
        self.considered: list[Judged] = []

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
            if further is None:
                break
            gains = self.backward(further)
            if all(self.good(gain) for gain in gains):
                stages.append(self._with_gains(further, gains))
            else:  # the new name makes an earlier one needless, and takes its place
                kept = [one for one, gain in zip(further.named, gains, strict=True) if self.good(gain)]
                stages[-1] = self._around(further, self._less(further, kept, 2), tuple(kept))
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
        if (named := self._name(stage, [*shared, *self.taken_back(stage), *leaders])) is not None:
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
        relatives = [(odd, mine) for odd, mine in ranked[s.leaders :] if stage.found[mine[0]].effect.related(names)]
        for number in (number for _, mine in [*leading, *_one_of_each(stage, relatives)] for number in mine):
            with_it = judge.fit([number], state, rounds=rounds)
            share = float(np.clip(with_it.mean[-1], n.low[number], n.high[number]))
            truncated = float(log_mass(n.low[number], n.high[number], 0.0, n.slab[number]))
            gain = with_it.evidence - control.evidence + n.place[number] - truncated
            # what the base would do by itself it has tried: where joints stick, long steps lead astray
            step = with_it.mean[:own] - control.mean[:own]
            estimates.append((gain, Proposal(number, step, share, with_it.state)))
        estimates.sort(key=lambda one: -one[0])
        places = list(dict.fromkeys(stage.found[one.number].place for _, one in estimates))
        first, behind = places[:MOST], {stage.found[mine[0]].place for _, mine in relatives}
        kept = {*first, *[place for place in places[MOST:] if place in behind][:MOST]}
        return [one for _, one in estimates if stage.found[one.number].place in kept]

    def taken_back(self, stage: NamingStage) -> list[Proposal]:
        """Candidates for what the base was taken back from; the base has a little of the same, which hides them."""
        base = stage.base
        entries = [base.coordinates.entries[i] for i in np.flatnonzero(base.taken_back)]
        places = {(entry.parameter, entry.joints) for entry in entries}
        no_step = np.zeros(len(base.point))
        return [
            Proposal(number, no_step, 1.0, stage.fit.state)
            for number, candidate in enumerate(stage.found)
            if (candidate.sized, candidate.joints) in places
        ]

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
        """The proposals refitted with the base; the one named that predicts runs that were left out best, with those
        that are not distinguished from it; None where none predicts them better beyond chance, or all do too little."""
        if not proposals:
            return None
        refits, control = self._refitted(stage, proposals)
        rows = stage.judge.rows
        scores = (self.held.score(base, rows) for base in (stage.base, control))
        without = max(scores, key=lambda one: one.density.sum())
        judged = [self._judged(stage, refit, without) for refit in refits]
        self.considered += judged
        alarm = self.settings.alarm
        passed = [o for o in judged if self.good(o.gain) and o.relevance.matters and o.refit.log_odds > alarm]
        if not passed:
            return None
        best = max(passed, key=lambda one: one.evidence)
        alike = [one for one in passed if one is not best and _alike(best.score, one.score, without)]
        behind = [Rival(one.candidate, Gain.of(best.score, one.score)) for one in alike]
        rivals = tuple(rival for rival in behind if not self.good(rival.behind))
        named = Named(best.candidate, best.refit.coordinates, best.refit.log_odds, best.gain, best.relevance, rivals)
        return self._around(stage, best.refit.base, (*stage.named, named))

    def _judged(self, stage: NamingStage, refit: Refit, without: HeldOutScore) -> Judged:
        """A refit beside the model without it; what it does is held against what named effects of its family do."""
        candidate, base, rows = stage.found[refit.number], refit.base, stage.judge.rows
        related = [one for one in stage.named if candidate.effect.related({one.candidate.effect.name})]
        relatives = [base.coordinates.entries.index(one.coordinates[0]) for one in related]
        its = self.reduction.rows(base.linear, (), rows)
        does = relevance(self.reduction, base, len(stage.base.point), its, self.settings, relatives)
        score = self.held.score(base, rows)
        return Judged(refit, candidate, score, Gain.of(score, without), does)

    def with_best(self, stage: NamingStage, proposals: Sequence[Proposal]) -> NamingStage:
        """The stage with the most evident of proposals named, whether or not runs that were left out bear it out."""
        best = self._refitted(stage, proposals)[0][0]
        rows = stage.judge.rows
        gain = Gain.of(self.held.score(best.base, rows), self.held.score(stage.base, rows))
        does = relevance(self.reduction, best.base, len(stage.base.point), rows, self.settings)
        named = Named(stage.found[best.number], best.coordinates, best.log_odds, gain, does)
        return self._around(stage, best.base, (*stage.named, named))

    def _refitted(self, stage: NamingStage, proposals: Sequence[Proposal]) -> tuple[list[Refit], Baseline]:
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
            return Refit(gain, end.base, number, end.base.coordinates.entries[len(point) :])

        alone = stage.judge.fit(state=stage.fit.state, rounds=2)
        without = refit(coordinates, point, alone.state).fit.evidence  # the base takes as many steps without
        for one in proposals:
            joined = self._joined(stage, one.number, one.share)
            moved = np.clip(point + one.step, coordinates.low, coordinates.high)
            end = compared(one.number, refit(joined, self._begun(joined, (moved, point)), one.state), without)
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

    def _begun(self, joined: Coordinates, points: Sequence[np.ndarray]) -> np.ndarray:
        """Where a refit begins: with the base at one of some points, and the effect at its linear size or any that is
        plausible, whichever predicts a third of the windows best.

        Where a large fault makes a joint stick, or the base has taken it for noise, nothing linear says its size.
        """
        size, shape = joined.entries[len(points[0])], joined.start[len(points[0]) + 1 :]
        sizes = [size.start, *(end * share for end in (size.low, size.high) for share in SIZES)]
        starts = np.array([np.concatenate([at, [value], shape]) for at in points for value in sizes])
        costs = robust(self.thin.at(joined, starts, COARSE), self.thin.limbs).sum(0) + joined.penalties(starts)
        self.thin.forget()
        return starts[int(costs.argmin())]

    def _around(self, stage: NamingStage, base: Baseline, named: tuple[Named, ...]) -> NamingStage:
        """The judge around a base with what was named, the leading candidates' columns made anew."""
        base = settle(self.reduction, base.coordinates, base.point, self.settings, state=base.fit.state)
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
        coordinates = Coordinates(whole.model, whole.joints, tuple(whole.entries[i] for i in at))
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


def _one_of_each(stage: NamingStage, ranked: Sequence[tuple[float, list[int]]]) -> list[tuple[float, list[int]]]:
    """The best place of each effect."""
    best: dict[str, tuple[float, list[int]]] = {}
    for odds, mine in ranked:
        best.setdefault(stage.found[mine[0]].effect.name, (odds, mine[:1]))
    return list(best.values())


def _alike(one: HeldOutScore, other: HeldOutScore, without: HeldOutScore) -> bool:
    """Whether two models predict the same joints of the same runs better: the correlation of their gains."""
    first, second = ((score.density - without.density).ravel() for score in (one, other))
    return float(first @ second) > ALIKE * float(np.linalg.norm(first) * np.linalg.norm(second))


def _within(own: Sequence[Coordinate]) -> float:
    """Log of what the priors of an effect's numbers say of their being within their ranges."""
    return sum(float(log_mass(one.low, one.high, one.prior, one.deviation)) for one in own)
