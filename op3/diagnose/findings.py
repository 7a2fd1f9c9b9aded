"""Findings, one after another: the judge's leaders estimated anew, refitted with the base, and checked backwards."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from op3.diagnose.base import Base, base_numbers, settle
from op3.diagnose.candidates import Candidate, candidates, place_priors
from op3.diagnose.coordinates import Coordinate, Coordinates
from op3.diagnose.judge import Judge, Numbers, Posterior, Rows, State, evidence
from op3.diagnose.reduction import Reduction
from op3.diagnose.settings import SETTINGS, Settings

MOST = 3
"""Findings that are looked for, and members of a family that are refitted."""

RELINEARISED = 60
"""Candidates whose columns are made anew around a named effect; those of the others hardly matter."""

Place = tuple[str, tuple[int, ...] | None]


@dataclass(frozen=True, eq=False)
class Named:
    """An effect that was found.

    Attributes:
        candidate: what it is.
        coordinate: its number in the fit.
        log_odds: against its being there only a little.
        rivals: names that the logs tell from it by less than `Settings.family`, with their log odds.
    """

    candidate: Candidate
    coordinate: Coordinate
    log_odds: float
    rivals: tuple[tuple[Candidate, float], ...]


@dataclass(frozen=True, eq=False)
class Stage:
    """The judge around a base with some effects named.

    Attributes:
        base: the fit, the named effects' numbers the last of its own.
        named: the effects.
        found: candidates of the columns.
        columns: ``[candidate, joint, window, row]``.
        judge: of them.
        fit: with nothing else named.
    """

    base: Base
    named: tuple[Named, ...]
    found: tuple[Candidate, ...]
    columns: np.ndarray
    judge: Judge
    fit: Posterior


def numbers_of(base: Base, found: Sequence[Candidate], rows: Rows, settings: Settings = SETTINGS) -> Numbers:
    """Priors of the base's numbers and of the candidates.

    A spike is what makes so much torque, root mean square over the joints that feel it; the secants of one effect in
    one place share it.
    """
    own = base_numbers(base.coordinates, base.point)
    reach = np.array([one.reach(base.model, settings) for one in found]).reshape(-1, 3)
    square, felt = np.zeros(len(found)), np.zeros(len(found))
    torque = rows.kinds < 2
    for columns, values, variance in zip(rows.columns, rows.values, rows.variance, strict=True):
        mine, seen = columns >= len(base.point), np.isfinite(variance[:, 0])
        part = np.abs(values[mine][:, seen][..., torque]).reshape(int(mine.sum()), -1)
        if not part.size:
            continue
        part = np.minimum(part, np.quantile(part, 0.97, axis=1, keepdims=True))
        at = columns[mine] - len(base.point)
        square[at] += np.square(part).sum(1)
        felt[at] += part.shape[1]
    size, slab = np.sqrt(square / np.maximum(felt, 1)), reach[:, 2]
    secants: dict[Place, int] = {}
    for one in found:
        secants[one.place] = secants.get(one.place, 0) + 1
    share = np.array([secants[one.place] for one in found])
    ends = (settings.spike_ends[0] * slab, settings.spike_ends[1] * slab)
    spike = np.clip(settings.spike / np.maximum(size, 1e-9), *ends) / np.sqrt(share)
    dead = size < 1e-6
    return Numbers(
        np.concatenate([own.mean, np.zeros(len(found))]),
        np.concatenate([own.spike, np.where(dead, 1e-9, spike)]),
        np.concatenate([own.slab, np.where(dead, 2e-9, slab)]),
        np.concatenate([own.low, np.where(dead, -1.0, reach[:, 0])]),
        np.concatenate([own.high, np.where(dead, 1.0, reach[:, 1])]),
        np.concatenate([own.place, place_priors(found)]),
        np.concatenate([own.free, dead]),
    )


class Search:
    """Looks for effects that a base lacks.

    Args:
        reduction: of the fitted windows.
        mirror: partners of joints on the other side.
        without: names of effects not to consider.
        settings: tuned constants.
        progress: called with the share done.
    """

    def __init__(
        self,
        reduction: Reduction,
        mirror: Mapping[str, str],
        without: Sequence[str] = (),
        settings: Settings = SETTINGS,
        progress: Callable[[float], None] = lambda share: None,
    ):
        self.reduction, self.mirror, self.without, self.settings = reduction, mirror, tuple(without), settings
        self.progress = progress

    def first(self, base: Base) -> Stage:
        """The judge around a base with nothing named."""
        joints = self.reduction.engine.joints
        found = candidates(base.model, joints, self.reduction.moving, self.mirror, self.without)
        columns = self.reduction.columns(base.linear, found, lambda share: self.progress(0.4 * share))
        return self._stage(base, (), tuple(found), columns, None)

    def _stage(
        self,
        base: Base,
        named: tuple[Named, ...],
        found: tuple[Candidate, ...],
        columns: np.ndarray,
        state: State | None,
        gaussian: bool = False,
        rounds: int = 6,
        like: Rows | None = None,
    ) -> Stage:
        rows = self.reduction.rows(base.linear, columns, like)
        judge = Judge(rows, numbers_of(base, found, rows, self.settings), self.settings, gaussian)
        return Stage(base, named, found, columns, judge, judge.fit(state=state, rounds=rounds))

    def run(self, base: Base, most: int = MOST) -> list[Stage]:
        """Stages with nothing named, one effect named, two, as far as the evidence goes."""
        stages = [self.first(base)]
        while len(stages[-1].named) < most:
            further = self.further(stages[-1])
            if further is None:
                break
            further = self._backward(further)
            if len(further.named) < len(stages):
                break  # what it named made an earlier name needless, and the two do not go together
            stages.append(further)
            self.progress(0.4 + 0.6 * len(further.named) / most)
        self.progress(1.0)
        return stages

    # ---- one more -----------------------------------------------------------------------------------------------
    def further(self, stage: Stage) -> Stage | None:
        """The stage with one more effect named; None where no candidate is worth its slab."""
        tails = self.leaders(stage, stage.judge, stage.fit, self.settings.alarm)
        if tails:
            return self._name(stage, tails)
        gaussian = Judge(stage.judge.rows, stage.judge.numbers, self.settings, gaussian=True)
        fit = gaussian.fit(rounds=6)
        hidden = self._in_wild_windows(stage)
        rare = [one for one in self.leaders(stage, gaussian, fit, self.settings.rare_alarm) if hidden[one[1]]]
        less = self.settings.rare_alarm - self.settings.alarm
        return self._name(stage, [(odds - less, number) for odds, number in rare], gaussian=True) if rare else None

    def leaders(self, stage: Stage, judge: Judge, fit: Posterior, alarm: float) -> list[tuple[float, int]]:
        """Log odds and numbers of candidates of different places, estimated anew with everything else, best first.

        Empty unless the best is worth the alarm.
        """
        odds = judge.scores(fit)
        best: dict[Place, tuple[float, int]] = {}
        own = len(stage.base.point)
        for number in np.argsort(-odds):
            if not np.isfinite(odds[number]):
                break
            place = stage.found[number - own].place
            if place in best:
                so_far = best[place]
                best[place] = (float(np.logaddexp(so_far[0], odds[number])), so_far[1])
            elif len(best) < 4 * self.settings.leaders:
                best[place] = (float(odds[number]), int(number))
        ranked = sorted(best.values(), reverse=True)[: self.settings.leaders]
        if not ranked or ranked[0][0] < alarm - self.settings.family:
            return []
        control = judge.fit(state=fit.state, rounds=2)
        anew = []
        for _, number in ranked:
            with_it = judge.fit([number], fit.state, rounds=2)
            n = judge.numbers
            size = with_it.mean[number]
            if not n.low[number] <= size <= n.high[number]:
                continue
            truncated = _mass(n.low[number], n.high[number], n.slab[number])
            anew.append((with_it.evidence - control.evidence + n.place[number] - truncated, number))
        anew.sort(reverse=True)
        return anew if anew and anew[0][0] > alarm else []

    def _in_wild_windows(self, stage: Stage) -> np.ndarray:
        """Candidates most of whose torque lies in windows that Student's tails weigh down, ``[number]``."""
        total = np.full(len(stage.judge.numbers.mean), 1e-12)
        wild = np.zeros_like(total)
        for j, (at, values) in enumerate(zip(stage.judge.rows.columns, stage.judge.rows.values, strict=True)):
            energy = np.square(values[..., self.reduction.kinds < 2]).sum(2)
            total[at] += energy.sum(1)
            wild[at] += energy[:, stage.fit.state.weight[0, j] < 0.5].sum(1)
        return wild > 0.5 * total

    def _name(self, stage: Stage, leaders: list[tuple[float, int]], gaussian: bool = False) -> Stage | None:
        """The leaders refitted with the base; the best is named, those that are as good are its rivals."""
        near = [one for one in leaders if one[0] > leaders[0][0] - 2 * self.settings.family][:MOST]
        refitted = [self._refit(stage, number, gaussian) for _, number in near]
        refitted.sort(key=lambda one: -one[0])
        odds, base, candidate, coordinate = refitted[0]
        if odds < self.settings.alarm - self.settings.temperature:
            return None
        rivals = [(one[2], one[0]) for one in refitted[1:] if one[0] > odds - self.settings.family]
        named = (*stage.named, Named(candidate, coordinate, odds, tuple(rivals)))
        return self._around(stage, base, named)

    def _refit(self, stage: Stage, number: int, gaussian: bool = False) -> tuple[float, Base, Candidate, Coordinate]:
        """Log odds of a candidate refitted with the base against the base without, and what the refit gave.

        Sizes are linear in the judge's rows and too small, as the base gives way only once the effect is there.
        """
        before, s = stage.base, self.settings
        coordinates, candidate = before.coordinates, stage.found[number - len(before.point)]
        with_it = stage.judge.fit([number], stage.fit.state, rounds=2)
        model = candidate.switched_on(coordinates.model, self.reduction.engine.joints)
        coordinate = candidate.coordinate(coordinates.model, float(with_it.mean[number]), s)
        moved = np.clip(before.point + with_it.mean[: len(before.point)], coordinates.low, coordinates.high)
        start, joined = np.append(moved, coordinate.start), coordinates.extended(model, [coordinate])
        base = settle(self.reduction, joined, start, s, steps=2, state=with_it.state, like=before.linear)
        judge = Judge(stage.judge.rows, stage.judge.numbers, s, gaussian)
        after = self._stage(base, stage.named, stage.found, stage.columns, with_it.state, gaussian, 2, judge.rows)
        without = judge.fit(state=stage.fit.state, rounds=4).evidence
        truncated = _mass(coordinate.low, coordinate.high, coordinate.deviation)
        odds = after.fit.evidence - without + stage.judge.numbers.place[number] - truncated
        return float(odds), base, candidate, coordinate

    def _around(self, stage: Stage, base: Base, named: tuple[Named, ...]) -> Stage:
        """The judge around a base with what was named, the leading candidates' columns made anew."""
        base = settle(self.reduction, base.coordinates, base.point, self.settings, steps=1, state=base.fit.state)
        joints, own = self.reduction.engine.joints, len(stage.base.point)
        odds = stage.judge.scores(stage.fit)[own:]
        every = candidates(base.model, joints, self.reduction.moving, self.mirror, self.without)
        fresh = {one.key: one for one in every}
        taken = {one.candidate.place for one in named}
        kept = [i for i, one in enumerate(stage.found) if one.place not in taken and one.key in fresh]
        leading = sorted(kept, key=lambda i: -odds[i])[:RELINEARISED]
        anew = sorted((set(leading) | self._parts(stage.found, leading)) & set(kept))
        columns, found = stage.columns.copy(), list(stage.found)
        made = self.reduction.columns(base.linear, [fresh[found[i].key] for i in anew])
        for i, column in zip(anew, made, strict=True):
            columns[i], found[i] = column, fresh[found[i].key]
        return self._stage(base, named, tuple(found[i] for i in kept), columns[kept], base.fit.state)

    @staticmethod
    def _parts(found: Sequence[Candidate], leading: Sequence[int]) -> set[int]:
        """Candidates in single joints of which leading ones are the sums."""
        sums = [found[i] for i in leading if found[i].scope in ("pair", "side")]
        wanted = {(one.effect.name, (j,)) for one in sums for j in one.joints or ()}
        return {i for i, one in enumerate(found) if one.place in wanted}

    def told(self, stage: Stage, effect: str, joints: Sequence[str]) -> Stage:
        """The stage with an effect that is known to be there; as it is where the catalogue lacks it.

        Args:
            stage: to which it is added.
            effect: its name.
            joints: where; none or all for all joints alike.
        """
        names, own = self.reduction.engine.joints, len(stage.base.point)
        where = None if not joints or set(joints) >= set(names) else tuple(sorted(names.index(j) for j in joints))
        odds = stage.judge.scores(stage.fit)
        mine = [own + i for i, one in enumerate(stage.found) if one.place == (effect, where)]
        if not mine:
            return stage
        found, base, candidate, coordinate = self._refit(stage, max(mine, key=lambda i: float(odds[i])))
        return self._around(stage, base, (*stage.named, Named(candidate, coordinate, found, ())))

    # ---- backwards ----------------------------------------------------------------------------------------------
    def _backward(self, stage: Stage) -> Stage:
        """The stage without names that later ones have made needless."""
        kept = [one for one, odds in zip(stage.named, self.backward_odds(stage), strict=True) if odds > 0.0]
        if len(kept) == len(stage.named):
            return stage
        whole = stage.base.coordinates
        gone = [one.coordinate for one in stage.named if one not in kept]
        at = [i for i, entry in enumerate(whole.entries) if entry not in gone]
        coordinates = Coordinates(whole.model, whole.joints, tuple(whole.entries[i] for i in at))
        base = settle(self.reduction, coordinates, stage.base.point[at], self.settings, steps=2)
        return self._around(stage, base, tuple(kept))

    def backward_odds(self, stage: Stage) -> list[float]:
        """Log odds of every named effect against its being there only a little, around where it is now."""
        linear, curvature = stage.judge.likelihoods(stage.fit)
        result, entries = [], stage.base.coordinates.entries
        for one in stage.named:
            i = entries.index(one.coordinate)
            entry, none = entries[i], -stage.base.point[i]
            little = entry.deviation / self.settings.slab * self.settings.spike_ends[0]
            low, high = entry.low + none, entry.high + none
            much = evidence(linear[i], curvature[i], none, np.array(entry.deviation), low, high)
            result.append(float(much - evidence(linear[i], curvature[i], none, np.array(little))))
        return result


def _mass(low: float, high: float, deviation: float) -> float:
    """Log of the slab's mass within what is plausible: it is truncated there."""
    return float(np.log(max(norm.cdf(high / deviation) - norm.cdf(low / deviation), 1e-9)))
