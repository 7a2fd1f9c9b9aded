"""Findings, one after another: the judge's leaders estimated anew, refitted with the base, and checked backwards."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from op3.diagnose.base import ELSEWHERE, Base, base_numbers, settle
from op3.diagnose.candidates import Candidate, candidates, parts_of, place_priors, secants_of_place
from op3.diagnose.coordinates import Coordinate, Coordinates
from op3.diagnose.judge import Judge, Numbers, Posterior, Rows, State, log_mass
from op3.diagnose.reduction import Reduction
from op3.diagnose.settings import SETTINGS, Settings

MOST = 3
"""Findings that are looked for, and places of which candidates are refitted."""

STARTS = 4
"""Forms and secants of an effect in one place that are refitted, at most."""

RELINEARISED = 60
"""Candidates whose columns are made anew around a named effect; those of the others hardly matter."""

NOTHING = 1e-6
"""Torque below which a candidate does nothing here [units]."""

Place = tuple[str, tuple[int, ...] | None]

Estimated = tuple[int, np.ndarray, float, State]
"""A candidate's number; how far the base's numbers move with it and its share of the secant; the judge's variances."""

Refitted = tuple[float, Base, int, tuple[Coordinate, ...]]
"""Log odds, the base around it, the candidate's number, and its own in the fit."""


@dataclass(frozen=True, eq=False)
class Named:
    """An effect that was found.

    Attributes:
        candidate: what it is.
        coordinates: its numbers in the fit, its size the first.
        log_odds: against its being there only a little, when it was named.
        place_prior: how probable its place is beforehand, a logarithm.
        rivals: names that the logs tell from it by less than `Settings.family`, with their log odds.
    """

    candidate: Candidate
    coordinates: tuple[Coordinate, ...]
    log_odds: float
    place_prior: float
    rivals: tuple[tuple[Candidate, float], ...]


@dataclass(frozen=True, eq=False)
class Stage:
    """The judge around a base with some effects named.

    Attributes:
        base: the fit, the named effects' numbers the last of its own.
        named: the effects.
        found: candidates.
        columns: of those in one joint or in all, by key, ``[joint, window, row]``.
        judge: of them.
        fit: with nothing else named.
    """

    base: Base
    named: tuple[Named, ...]
    found: tuple[Candidate, ...]
    columns: Mapping[tuple, np.ndarray]
    judge: Judge
    fit: Posterior


def numbers_of(
    base: Base, found: Sequence[Candidate], parts: Sequence[tuple], rows: Rows, settings: Settings = SETTINGS
) -> Numbers:
    """Priors of the base's numbers and of the candidates.

    A spike is what makes so much torque, root mean square over the joints that feel it; the secants of one effect in
    one place share it, and the place's prior. Parts are keys of candidates in one joint or in all, of which the others
    are sums.
    """
    own, number = base_numbers(base.coordinates, base.point), {key: i for i, key in enumerate(parts)}
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

    def first(self, base: Base) -> Stage:
        """The judge around a base with nothing named."""
        found = self._candidates(base)
        columns = self._columns(base, parts_of(found), lambda share: self.progress(0.4 * share))
        return self._stage(base, (), found, columns, None)

    def _candidates(self, base: Base, named: Sequence[Named] = ()) -> tuple[Candidate, ...]:
        """All that could be missing but what is named."""
        engine, taken = self.reduction.engine, {one.candidate.place for one in named}
        found = candidates(base.model, engine.joints, self.reduction.moving, engine.mirror, self.without)
        return tuple(one for one in found if one.place not in taken)

    def _columns(
        self, base: Base, parts: Sequence[Candidate], progress: Callable[[float], None] | None = None
    ) -> dict[tuple, np.ndarray]:
        made = self.reduction.columns(base.linear, parts, progress)
        return {one.key: column for one, column in zip(parts, made, strict=True)}

    def _stage(
        self,
        base: Base,
        named: tuple[Named, ...],
        found: tuple[Candidate, ...],
        columns: Mapping[tuple, np.ndarray],
        state: State | None,
        rounds: int = 6,
        like: Rows | None = None,
    ) -> Stage:
        rows = self.reduction.rows(base.linear, list(columns.values()), like)
        numbers = numbers_of(base, found, list(columns), rows, self.settings)
        judge = Judge(rows, numbers, self.settings)
        return Stage(base, named, found, columns, judge, judge.fit(state=state, rounds=rounds))

    def run(self, base: Base, most: int = MOST) -> list[Stage]:
        """Stages with nothing named, one effect named, two, as far as the evidence goes."""
        stages = [self.first(base)]
        for _ in range(2 * most):
            further = None if len(stages) > most else self.further(stages[-1])
            odds = [] if further is None else self.backward_odds(further)
            if further is None or odds[-1] <= 0:
                break
            if min(odds) > 0:
                stages.append(further)
            else:  # the new name makes an earlier one needless, and takes its place
                needless = [one for one, its in zip(further.named, odds, strict=True) if its <= 0]
                stages[-1] = self._without(further, needless)
            self.progress(0.4 + 0.6 * len(further.named) / most)
        self.progress(1.0)
        return stages

    def further(self, stage: Stage) -> Stage | None:
        """The stage with one more effect named; None where no candidate is worth its slab."""
        odds, shared = stage.judge.scores(stage.fit), self.shared(stage)
        while True:
            leaders = self.leaders(stage, odds, stage.fit.state)
            if (found := self._name(stage, leaders, shared)) is not None:
                return found
            if not leaders or leaders[0][0] < self.settings.alarm:
                break
            # of an effect that no refit finds where its odds are best, they deceive: what they hid is refitted next
            deceive = {name for name, _ in self._leading(stage, leaders)}
            odds = np.where([one.place[0] in deceive for one in stage.found], -np.inf, odds)
            shared = []
        # what happens in few windows only is hidden where these count for little: let them count in full to propose it,
        # and begin anew with it, so that windows which it explains count again
        gaussian = Judge(stage.judge.rows, stage.judge.numbers, self.settings, gaussian=True)
        odds = np.where(self._in_wild_windows(stage), gaussian.scores(gaussian.fit(rounds=6)), -np.inf)
        return self._name(stage, self.leaders(stage, odds, None))

    def leaders(self, stage: Stage, odds: np.ndarray, state: State | None) -> list[tuple[float, Estimated]]:
        """Log odds and numbers of candidates of a few places, estimated anew with everything else, best first.

        Empty unless the best is within a family of the alarm: sizes are linear here, and a refit finds more.

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
        if not ranked or ranked[0][0] < s.alarm - s.family:
            return []
        rounds = 2 if state else 6
        control, anew, own = judge.fit(state=state, rounds=rounds), [], len(stage.base.point)
        for number in (number for _, mine in ranked[: s.leaders] for number in mine):
            with_it = judge.fit([number], state, rounds=rounds)
            if not n.low[number] <= with_it.mean[-1] <= n.high[number]:
                continue
            truncated = float(log_mass(n.low[number], n.high[number], 0.0, n.slab[number]))
            gain = with_it.evidence - control.evidence + n.place[number] - truncated
            # what the base would do by itself it has tried: where joints stick, long steps lead astray
            step = with_it.mean[:own] - control.mean[:own]
            anew.append((gain, (number, step, float(with_it.mean[-1]), with_it.state)))
        anew.sort(key=lambda one: -one[0])
        return anew if anew and anew[0][0] > s.alarm - s.family else []

    def shared(self, stage: Stage) -> list[Estimated]:
        """Candidates of all joints that are above the alarm once the base has taken a step with them, best first.

        Numbers that all joints share take such an effect's place as far as they can, and where they have, nothing that
        is linear there tells it from them.
        """
        base, found = stage.base, []
        rows = self.reduction.rows(base.linear, ())

        def step(joined: Coordinates, point: np.ndarray) -> tuple[Base, float]:
            end = settle(self.reduction, joined, point, self.settings, steps=1, state=base.fit.state, like=base.linear)
            its = self.reduction.rows(end.linear, (), rows)
            judge = Judge(its, base_numbers(joined, end.point), self.settings)
            return end, judge.fit(state=end.fit.state, rounds=2).evidence

        _, without = step(base.coordinates, base.point)
        for number, one in enumerate(stage.found):
            if one.joints is None and np.isfinite(stage.judge.numbers.place[number]):
                joined = self._joined(stage, number, 1.0)
                end, evident = step(joined, np.concatenate([base.point, joined.start[len(base.point) :]]))
                self.reduction.forget()
                gain = evident - without + self._prior(stage, number, joined)
                size = float(end.point[len(base.point)]) / one.secant[one.sized]
                found.append((gain, (number, end.point[: len(base.point)] - base.point, size, end.fit.state)))
        found.sort(key=lambda one: -one[0])
        return [one for gain, one in found if gain > self.settings.alarm][:MOST]

    def _joined(self, stage: Stage, number: int, share: float) -> Coordinates:
        """The base's numbers and a candidate's, which begin at a share of its secant."""
        candidate, coordinates = stage.found[number], stage.base.coordinates
        model = candidate.switched_on(coordinates.model, self.reduction.engine.joints)
        more = candidate.coordinates(stage.base.model, coordinates.entries, share, self.settings)
        return coordinates.extended(model, more)

    def _prior(self, stage: Stage, number: int, joined: Coordinates) -> float:
        """Log prior of a candidate's place, and of its numbers' being within their ranges."""
        return float(place_priors(stage.found)[number]) - _within(joined.entries[len(stage.base.point) :])

    def _in_wild_windows(self, stage: Stage) -> np.ndarray:
        """Candidates most of whose torque lies in windows that Student's tails weigh down, ``[candidate]``."""
        total, wild = np.zeros((2, len(stage.judge.numbers.mean)))
        for j, (at, values) in enumerate(zip(stage.judge.rows.columns, stage.judge.rows.values, strict=True)):
            energy = np.square(values[..., self.reduction.kinds < 2]).sum(2)
            total[at] += energy.sum(1)
            wild[at] += energy[:, stage.fit.state.weight[0, j] < 0.5].sum(1)
        members = [list(one) for one in stage.judge.numbers.members]
        return np.array([wild[one].sum() > 0.5 * total[one].sum() for one in members])

    def _leading(self, stage: Stage, leaders: list[tuple[float, Estimated]]) -> list[Place]:
        """The places of leaders that are refitted."""
        return list(dict.fromkeys(stage.found[one[0]].place for _, one in leaders))[:MOST]

    def _name(
        self, stage: Stage, leaders: list[tuple[float, Estimated]], shared: Sequence[Estimated] = ()
    ) -> Stage | None:
        """The leaders refitted with the base, the best named; None where it is far below the alarm."""
        if not leaders and not shared:
            return None
        # how large an effect is decides by how far odds are off that are linear in it
        least = min(leaders[0][0] - 2 * self.settings.family, self.settings.alarm) if leaders else 0.0
        places = self._leading(stage, [one for one in leaders if one[0] > least])
        of_places = [one for _, one in leaders if stage.found[one[0]].place in places]
        refitted = self._refitted(stage, [*shared, *of_places])
        good = refitted[0][0] >= self.settings.alarm - self.settings.temperature
        return self._with(stage, refitted) if good else None

    def with_best(self, stage: Stage, estimates: Sequence[Estimated]) -> Stage:
        """The stage with the best of what was estimated named, whatever its odds."""
        return self._with(stage, self._refitted(stage, estimates))

    def _with(self, stage: Stage, refitted: Sequence[Refitted]) -> Stage:
        """The stage with the best of the refitted named, and those that are as good as its rivals."""
        odds, base, number, coordinates = refitted[0]
        rivals = tuple((stage.found[one[2]], one[0]) for one in refitted[1:] if one[0] > odds - self.settings.family)
        prior = float(place_priors(stage.found)[number])
        return self._around(stage, base, (*stage.named, Named(stage.found[number], coordinates, odds, prior, rivals)))

    def _refitted(self, stage: Stage, estimates: Sequence[Estimated]) -> list[Refitted]:
        """Log odds of candidates refitted with the base against the base without, and what the refit gave, the best of
        each place, best first.

        Sizes are linear in the judge's rows and too small, as the base gives way only once the effect is there; and the
        effect has one of a few shapes there, and any that is plausible here.
        """
        coordinates, point = stage.base.coordinates, stage.base.point
        best: dict[Place, Refitted] = {}

        def refit(joined: Coordinates, start: np.ndarray, state: State, steps: int = 2) -> Stage:
            base = settle(self.reduction, joined, start, self.settings, steps, state, stage.base.linear)
            self.reduction.forget()
            return self._stage(base, stage.named, stage.found, stage.columns, state, 2, stage.judge.rows)

        def compared(number: int, end: Stage, base: float) -> Refitted:
            gain = end.fit.evidence - base + self._prior(stage, number, end.base.coordinates)
            return gain, end.base, number, end.base.coordinates.entries[len(point) :]

        alone = stage.judge.fit(state=stage.fit.state, rounds=2)
        without = refit(coordinates, point, alone.state).fit.evidence  # the base takes as many steps without
        for number, step, share, state in estimates:
            joined = self._joined(stage, number, share)
            moved = np.clip(point + step, coordinates.low, coordinates.high)
            end = compared(number, refit(joined, np.concatenate([moved, joined.start[len(point) :]]), state), without)
            place = stage.found[number].place
            best[place] = max(end, best.get(place, end), key=lambda one: one[0])
        checked: set[Place] = set()
        while True:
            _, base, number, _ = max(best.values(), key=lambda one: one[0])
            place = stage.found[number].place
            if place in checked:
                return sorted(best.values(), key=lambda one: -one[0])
            # where joints stick the way is long; and what lets a poor base move on has no merit in what that gains
            checked.add(place)
            end = refit(base.coordinates, base.point, base.fit.state, ELSEWHERE)
            back = refit(coordinates, end.base.point[: len(point)], end.base.fit.state, ELSEWHERE)
            best[place] = compared(number, end, max(without, back.fit.evidence))

    def _around(self, stage: Stage, base: Base, named: tuple[Named, ...]) -> Stage:
        """The judge around a base with what was named, the leading candidates' columns made anew."""
        base = settle(self.reduction, base.coordinates, base.point, self.settings, state=base.fit.state)
        odds, found = stage.judge.scores(stage.fit), self._candidates(base, named)
        moved = {key for i in np.argsort(-odds)[:RELINEARISED] for key in stage.found[i].parts}
        parts = [one for one in parts_of(found) if one.key in moved or one.key not in stage.columns]
        columns = {**stage.columns, **self._columns(base, parts)}
        return self._stage(base, named, found, {one.key: columns[one.key] for one in parts_of(found)}, base.fit.state)

    def _without(self, stage: Stage, needless: Sequence[Named]) -> Stage:
        """The stage without some names."""
        named = tuple(one for one in stage.named if one not in needless)
        return self._around(stage, self._less(stage, needless, 2), named)

    def _less(self, stage: Stage, needless: Sequence[Named], steps: int) -> Base:
        """The base without some names, fitted from where it is with them."""
        whole, gone = stage.base.coordinates, [entry for one in needless for entry in one.coordinates]
        at = [i for i, entry in enumerate(whole.entries) if entry not in gone]
        coordinates = Coordinates(whole.model, whole.joints, tuple(whole.entries[i] for i in at))
        state, like = stage.base.fit.state, stage.base.linear
        return settle(self.reduction, coordinates, stage.base.point[at], self.settings, steps, state, like)

    def worth(self, stage: Stage) -> list[float]:
        """Log odds of every named effect: those when it was named, and no more than in the end, with its place's prior.

        A refit gains where it lets a poor base move on, which is not the name's merit.
        """
        in_the_end = zip(stage.named, self.backward_odds(stage), strict=True)
        return [min(one.log_odds, odds + one.place_prior) for one, odds in in_the_end]

    def backward_odds(self, stage: Stage) -> list[float]:
        """Log odds of every named effect against the base without it, fitted from where it is with it, whatever its
        place."""
        result = []
        for one in stage.named:
            rest, base = tuple(other for other in stage.named if other is not one), self._less(stage, [one], ELSEWHERE)
            without = self._stage(base, rest, stage.found, stage.columns, base.fit.state, 2, stage.judge.rows)
            result.append(stage.fit.evidence - without.fit.evidence - _within(one.coordinates))
        return result


def _within(own: Sequence[Coordinate]) -> float:
    """Log of what the priors of an effect's numbers say of their being within their ranges."""
    return sum(float(log_mass(one.low, one.high, one.prior, one.deviation)) for one in own)
