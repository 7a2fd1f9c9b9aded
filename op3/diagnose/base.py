"""The baseline fit that findings are held against: a start for every structure, and Gauss-Newton with the judge's
weights.

Stiction kills gradients, so an evolution strategy (CatCMA: Hamano et al. 2024) over the shared numbers finds the
basins, in long steps; Gauss-Newton steps with the judge's noise then settle in each.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from cmaes import CatCMA

from op3.diagnose.coordinates import (
    BENCH,
    CHAIN,
    WIDEST,
    Coordinates,
    any_spread,
    base_coordinates,
    other_forms,
    usual_spread,
    with_chain,
    with_own_spread,
    with_setups,
)
from op3.diagnose.judge import Judge, Numbers, Posterior, Variances
from op3.diagnose.judge_settings import SETTINGS, Settings
from op3.diagnose.reduction import Linear, Reduction
from op3.servo import Estimate, RobotModel, Stage
from op3.servo.conditions import split_name

GENERATIONS, FINE, SIGMA = 50, 10, 0.2
"""Of the search: generations, the last of them in steps half as long, and the first one's standard deviation as a share
of every range."""

FACTORS = (0.25, 0.5, 2.0, 4.0)
"""Of a servo's number on what all share, from which a fit begins where they predict better than 1."""

STEPS, ELSEWHERE = 12, 4
"""Gauss-Newton steps at most of the best start, and of every start before they are compared."""

GEAR = (Stage.GEAR, Stage.LOAD)
"""Stages of the effects that say where the gear's losses go."""

DAMPING = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Dampings of a step that are tried at once, as shares of each number's curvature."""

HELD_AT_END = 1e-3
"""Share of a number's standard deviation that is left to it at the end of its range."""

FEWEST_WINDOWS, FINALISTS = 24, 2
"""Windows on which starts settle first, at least, and starts that settle on all."""

SETTLED = 8.0
"""Gain in minus two log posterior below which a base no longer moves."""


@dataclass(frozen=True, eq=False)
class Baseline:
    """A fitted base.

    Attributes:
        linear: the windows around it.
        fit: of the judge, its numbers alone.
        others: ends of other starts, and by how much better they are in minus two log evidence.
    """

    linear: Linear
    fit: Posterior
    others: tuple["End", ...] = ()

    @property
    def coordinates(self) -> Coordinates:
        """Its numbers."""
        return self.linear.coordinates

    @property
    def point(self) -> np.ndarray:
        """Where they are: within their ranges, though the windows may be linear about a point outside."""
        return np.clip(self.linear.point, self.coordinates.low, self.coordinates.high)

    @property
    def taken_back(self) -> np.ndarray:
        """Which of them were outside their ranges, ``[coordinate]``."""
        return self.point != self.linear.point

    @property
    def numbers(self) -> Numbers:
        """Priors of steps from there; what was taken back to the end of its range stays there."""
        numbers, held = base_numbers(self.coordinates, self.point), self.taken_back
        deviation = np.where(held, HELD_AT_END, 1.0) * numbers.deviation
        return replace(numbers, mean=np.where(held, 0.0, numbers.mean), deviation=deviation)

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations of its numbers, ``[coordinate]``."""
        return np.sqrt(np.diag(self.fit.covariance))

    @property
    def model(self) -> RobotModel:
        """The model that it is."""
        return at_point(self.coordinates, self.point)


def base_numbers(coordinates: Coordinates, point: np.ndarray) -> Numbers:
    """Priors of the base's numbers as steps from a point."""
    least, most = coordinates.low - point, coordinates.high - point
    return Numbers(coordinates.prior - point, coordinates.deviation_at(point), least=least, most=most)


def thin_windows(reduction: Reduction) -> int:
    """How many windows what is tried first is tried on."""
    return max(FEWEST_WINDOWS, reduction.windows // 3)


def fit_base(
    reduction: Reduction,
    model: RobotModel,
    rng: np.random.Generator,
    settings: Settings = SETTINGS,
    progress: Callable[[float], None] = lambda share: None,
) -> Baseline:
    """Fit a model's own numbers, its servos' spread and the chain of measurement.

    One servo may differ from the others as far as it likes while all is fitted. In the result it differs as servos of a
    sound robot do at most; what it differs by more is for the judge to name. Starts of every structure (form of the
    gear's law, form of friction's, commands before or after the next reading) settle on a third of the windows, the
    best of these on all.
    """
    lengths = reduction.engine.lengths
    full = with_chain(with_setups(model, lengths))
    priors = {**CHAIN, **BENCH} if lengths else CHAIN
    usual = base_coordinates(full, reduction.engine.joints, reduction.moving, priors)
    coordinates = any_spread(usual, settings.tails)
    thin = reduction.thinned(thin_windows(reduction))
    # another law of the gear does best with other numbers everywhere: each gets a start of its own
    gears = [full, *other_forms(full, lambda effect: effect.stage in GEAR)]
    groups = [[gear, *other_forms(gear, lambda effect: effect.stage not in GEAR)] for gear in gears]

    def ends() -> Iterator[Baseline]:
        for number, forms in enumerate(groups):
            at, point = search(thin, coordinates, rng, forms)
            yield settle(thin, at, apart(thin, at, point), settings, ELSEWHERE)
            progress(0.5 * (number + 1) / len(groups))
        if len(groups) == 1:
            yield settle(thin, coordinates, coordinates.start, settings, ELSEWHERE)

    first, _ = _ranked(thin, ends(), settings)
    # what sticks has a basin for every form of its law: each begins where this one is, and with friction as at first
    forms = next(group for group in groups if _gear(group[0]) == _gear(first.coordinates.model))
    same = [(replace(first.coordinates, model=form), first.point) for form in forms]
    afresh = [_afresh(first, form) for form in forms]
    begins = [*same, *afresh, *_timings(first, reduction.engine.period), *_near_rest(first)]
    anew = (settle(thin, *begin, settings, ELSEWHERE) for begin in begins)
    _, best = _ranked(thin, chain([first], anew), settings)
    progress(0.7)
    finals = (settle(reduction, end.coordinates, end.point, settings) for end in best[:FINALISTS])
    first, ranked = _ranked(reduction, finals, settings)
    progress(0.9)
    others = tuple(replace(end, gain=end.gain - ranked[0].gain) for end in ranked[1:])
    own, point = with_own_spread(first.coordinates, first.point, first.deviations, settings)
    free = settle(reduction, own, point, settings, state=first.fit.state)
    return replace(as_usual(reduction, free, settings), others=others)


def as_usual(reduction: Reduction, base: Baseline, settings: Settings = SETTINGS) -> Baseline:
    """A base as near to another as what is expected of a sound robot's servos lets it be.

    Its windows are what the other's are to first order and stay linear about the other's point, and its variances are
    the other's: near a joint that sticks nothing linear would say how far it is off, and all that is there would be
    noise. What all servos share stays as it is.
    """
    coordinates = usual_spread(base.coordinates)
    moved = np.clip(base.point, coordinates.low, coordinates.high) - base.point
    columns = np.moveaxis(base.linear.base, 0, 1)
    change = np.stack([np.tensordot(moved, reduction.tamed(of_joint), 1) for of_joint in columns])
    linear = replace(base.linear, coordinates=coordinates, lacking=base.linear.lacking - change.astype(np.float32))
    numbers = Baseline(linear, base.fit).numbers
    judge = Judge(reduction.rows(linear, ()), numbers, settings)
    return Baseline(linear, judge.fit(state=base.fit.state, rounds=0 if moved.any() else 4))


@dataclass(frozen=True, eq=False)
class End:
    """Where a start of the baseline fit has ended.

    Attributes:
        coordinates: its numbers, and the forms of its laws.
        point: where they are.
        gain: on the first start, in minus two log evidence.
    """

    coordinates: Coordinates
    point: np.ndarray
    gain: float


def _gear(model: RobotModel) -> list:
    """The forms of the gear's law."""
    return [effect for effect in model.effects if effect.stage in GEAR and effect.written]


def _ranked(reduction: Reduction, bases: Iterator[Baseline], settings: Settings) -> tuple[Baseline, list[End]]:
    """The best of bases, and where all ended, the best first; a base holds 15 MB, and the others are let go."""
    first = best = next(bases)
    most, ends = 0.0, [End(first.coordinates, first.point, 0.0)]
    for base in bases:
        gain = gap_of(reduction, first, base, settings)
        ends.append(End(base.coordinates, base.point, gain))
        if gain > most:
            most, best = gain, base
    return best, sorted(ends, key=lambda end: -end.gain)


def _afresh(base: Baseline, form: RobotModel) -> tuple[Coordinates, np.ndarray]:
    """A base with another form of its laws, and the numbers of friction where they started."""
    friction = {p.name for effect in form.effects if effect.stage == Stage.FRICTION for p in effect.parameters}
    mine = np.array([entry.parameter in friction for entry in base.coordinates.entries])
    return replace(base.coordinates, model=form), np.where(mine, base.coordinates.start, base.point)


def _near_rest(base: Baseline) -> Iterator[tuple[Coordinates, np.ndarray]]:
    """A base whose gear loses more near rest, in every form of its law: where it has ended at nothing more, the end of
    what there may be, another form may have taken the place of that loss."""
    near = np.array([entry.parameter == "near_rest_loss" for entry in base.coordinates.entries])
    for form in (base.coordinates.model, *other_forms(base.coordinates.model, lambda effect: effect.stage in GEAR)):
        yield replace(base.coordinates, model=form), np.where(near, CHAIN["near_rest_loss"].spread, base.point)


def _timings(base: Baseline, period: float) -> Iterator[tuple[Coordinates, np.ndarray]]:
    """A base with commands before the next reading where they come after it, and the other way round, whose currents
    lag the more or the less; and with commands a whole reading earlier or later.

    A reading shows the first of a command's current, or nothing of it yet: each has a basin.
    """
    coordinates = base.coordinates
    at = {entry.parameter: i for i, entry in enumerate(coordinates.entries) if entry.joints is None}
    late, lag = at.get("command_latency"), at.get("current_time_constant")
    if late is None or lag is None:
        return
    margin = CHAIN["command_latency"].spread
    across = period - base.point[late] + (-margin if base.point[late] > period else margin)
    for later, less in ((across, across), (period, 0.0), (-period, 0.0)):
        point = base.point.copy()
        point[[late, lag]] += later, -less
        if coordinates.low[late] <= point[late] <= coordinates.high[late]:
            yield coordinates, np.clip(point, coordinates.low, coordinates.high)


def gap_of(reduction: Reduction, one: Baseline, other: Baseline, settings: Settings = SETTINGS) -> float:
    """How much worse one base is than another in minus two log evidence, mean over the reductions of both.

    Variances are each one's own: weights that a base gave to windows hide what it cannot explain. What numbers do is
    that of the base whose reduction it is, which decides little where a fit has ended.
    """
    gap = 0.0
    for like in (one, other):
        rows = reduction.rows(like.linear, ())
        for base, sign in ((one, -1.0), (other, 1.0)):
            mine = base is like
            linear = (
                base.linear if mine else reduction.linearise(base.coordinates, base.point, like.linear, like.linear)
            )
            judge = Judge(reduction.rows(linear, (), rows), base_numbers(base.coordinates, base.point), settings)
            gap += sign * judge.fit(state=base.fit.state).evidence
    return gap


def unfitted(reduction: Reduction, model: RobotModel, settings: Settings = SETTINGS) -> Baseline:
    """The base as the given model says it, of logs that it simulated itself."""
    coordinates = base_coordinates(with_chain(model), reduction.engine.joints, reduction.moving)
    known = model.parameters()
    given = [
        model.value(e.parameter) if e.kind == "value" and e.parameter in known else e.start for e in coordinates.entries
    ]
    return settle(reduction, coordinates, np.array(given), settings, steps=0)


def search(
    reduction: Reduction,
    coordinates: Coordinates,
    rng: np.random.Generator,
    forms: Sequence[RobotModel] = (),
) -> tuple[Coordinates, np.ndarray]:
    """An evolution strategy over the shared numbers, in logarithms where they are positive, and the forms of laws.

    Each form does best with numbers of its own, so that it is drawn like a number. Noise of the judge is not known yet,
    and what servos differ by neither.
    """
    options = [replace(coordinates, model=form) for form in forms] or [coordinates]
    shared = [i for i, entry in enumerate(coordinates.entries) if entry.joints is None]
    low, high, start = coordinates.low[shared], coordinates.high[shared], coordinates.start[shared]
    positive = (low >= 0) & (start > 0)
    bottom = np.where(positive, np.maximum(low, start / WIDEST), low)
    with np.errstate(divide="ignore", invalid="ignore"):
        least, most, given = (np.where(positive, np.log(end), end) for end in (bottom, high, start))

    def costs_of(drawn: Sequence, stretch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Costs, points and forms of what was drawn."""
        x = least + np.array([one for one, _ in drawn]) * (most - least)
        form = np.array([one.argmax() for _, one in drawn]) % len(options)
        whole, cost = np.tile(coordinates.start, (len(x), 1)), np.zeros(len(x))
        whole[:, shared] = np.clip(np.where(positive, np.exp(np.where(positive, x, 0.0)), x), low, high)
        for number, option in enumerate(options):
            if (mine := form == number).any():
                cost[mine] = robust(reduction.at(option, whole[mine], stretch), reduction.limbs).sum(0)
        return cost + coordinates.penalties(whole), whole, form

    strategy = CatCMA(
        np.clip((given - least) / (most - least), 0.05, 0.95),
        SIGMA,
        cat_num=np.array([max(2, len(options))]),  # it asks for a choice: one form stands there twice
        bounds=np.array([[0.0, 1.0]] * len(shared)),
        seed=int(rng.integers(2**31)),
    )
    best = np.inf, coordinates.start, 0
    for generation in range(GENERATIONS):
        drawn = [strategy.ask() for _ in range(strategy.population_size)]
        fine = generation >= GENERATIONS - FINE
        cost, whole, form = costs_of(drawn, 2 if fine else 4)
        strategy.tell([(one, float(its)) for one, its in zip(drawn, cost, strict=True)])
        if fine and cost.min() < best[0]:
            best = cost.min(), whole[cost.argmin()], form[cost.argmin()]
    return options[best[2]], best[1]


def robust(errors: Sequence[np.ndarray], limbs: Sequence[np.ndarray]) -> np.ndarray:
    """Cost of whitened errors by limb, ``[limb, set]``: what a joint misses altogether in a window counts once, so that
    one bad joint does not decide what all share."""
    costs = []
    for error, limb in zip(errors, limbs, strict=True):
        sets, windows, _ = error.shape
        square = np.square(error.reshape(sets, windows, -1, len(limb), 3), dtype=np.float64).mean((2, 4))
        costs.append(np.log1p(square).sum((1, 2)))
    return np.array(costs)


def apart(reduction: Reduction, coordinates: Coordinates, point: np.ndarray) -> np.ndarray:
    """A point with the numbers of one servo after another where its limb is predicted best: as they are, or one of them
    many times larger or smaller.

    A joint that sticks where it should move has no gradient that says so, and a fit would leave it to noise.
    """
    numbers: dict[int, dict[str, int]] = {}
    for i, entry in enumerate(coordinates.entries):
        if entry.of_servo:
            numbers.setdefault(entry.joints[0], {})[entry.parameter] = i  # type: ignore[index]
    tried = [(name, factor) for name in next(iter(numbers.values()), {}) for factor in FACTORS]
    for slot in range(max(map(len, reduction.limbs)) if numbers else 0):
        joints = [int(limb[slot]) for limb in reduction.limbs if slot < len(limb) and int(limb[slot]) in numbers]
        points = np.tile(point, (len(tried) + 1, 1))  # the first as it is
        alone = {joint: points.copy() for joint in joints}
        for joint in joints:
            for row, (name, factor) in enumerate(tried, 1):
                points[row, numbers[joint][name]] = alone[joint][row, numbers[joint][name]] = factor - 1.0
        costs = robust(reduction.at(coordinates, points), reduction.limbs)
        for joint in joints:  # limbs do not feel each other
            best = int((costs[reduction.limb_of[joint]] + coordinates.penalties(alone[joint])).argmin())
            point = np.where(alone[joint][best] != alone[joint][0], alone[joint][best], point)
    return point


def settle(
    reduction: Reduction,
    coordinates: Coordinates,
    point: np.ndarray,
    settings: Settings = SETTINGS,
    steps: int = STEPS,
    state: Variances | None = None,
    like: Linear | None = None,
) -> Baseline:
    """Gauss-Newton from a point until the base no longer moves.

    With a linearisation that it is to be `like`, its reduction is kept, so that evidences compare, and its columns of
    numbers that both have, which decide little where a fit ends.
    """
    point, linear = np.clip(point, coordinates.low, coordinates.high), None
    number, done = 0, steps == 0
    while True:
        kept = linear if done else None
        linear = reduction.linearise(coordinates, point, like if done else like or linear, kept or like)
        judge = Judge(reduction.rows(linear, ()), base_numbers(coordinates, point), settings)
        fit = judge.fit(state=state, rounds=4 if number == 0 else 3)
        state = fit.state
        if done:
            return Baseline(linear, fit)
        tried = np.concatenate([point[None], point + damped(fit, judge.numbers)])
        tried = np.clip(tried, coordinates.low, coordinates.high)
        costs = cost_of(reduction, judge, fit, linear, coordinates, tried)
        gained, point = costs[0] - costs.min(), tried[int(costs.argmin())]
        number += 1
        done = number == steps or gained < SETTLED


def damped(fit: Posterior, numbers: Numbers) -> np.ndarray:
    """Gauss-Newton steps ``[damping, number]`` (Levenberg 1944, Marquardt 1963); what would leave its range stays.

    Where joints stick, the numbers that the logs tell little of are those that lead astray: a shorter step in all of
    them does not help.
    """
    pull = fit.precision @ fit.mean
    free = np.flatnonzero(~((numbers.least >= 0) & (pull < 0) | (numbers.most <= 0) & (pull > 0)))
    inner, steps = fit.precision[np.ix_(free, free)], np.zeros((len(DAMPING), len(pull)))
    for step, damping in zip(steps, DAMPING, strict=True):
        step[free] = np.linalg.solve(inner + damping * np.diag(np.diag(inner)), pull[free])
    return steps


def cost_of(
    reduction: Reduction, judge: Judge, fit: Posterior, linear: Linear, coordinates: Coordinates, points: np.ndarray
) -> np.ndarray:
    """Minus two log posterior of points (but for constants) under a fit's variances, ``[point]``."""
    lacking = -reduction.reduce(linear.reducers, reduction.at(coordinates, points))
    known = np.isfinite(judge.rows.variance)
    misfits = np.array([judge.misfit(np.where(known, one, 0.0).astype(np.float64), fit) for one in lacking])
    return misfits + coordinates.penalties(points)


def at_point(coordinates: Coordinates, point: np.ndarray, deviation: np.ndarray | None = None) -> RobotModel:
    """The model with its numbers at a point, intervals of 90 % from standard deviations where they are given."""
    model, joints, values = coordinates.model, coordinates.joints, {}
    spread: dict[str, float] = {}
    for i, entry in enumerate(coordinates.entries):
        if deviation is not None and entry.kind == "value" and entry.joints is None:
            spread[entry.parameter] = 1.645 * float(deviation[i])
    for name, value in coordinates.values(point[None]).items():
        row, half = value[0].numpy(), spread.get(name)
        shared = float(np.median(row))
        low, high = (None, None) if half is None else (shared - half, shared + half)
        own = {joint: one for joint, one in zip(joints, row.tolist(), strict=False) if abs(one - shared) > 1e-12}
        kept = model.estimate(split_name(name)[0]).by if "@" not in name else {}
        values[name] = Estimate(shared, low, high, joints=own, by=kept)
    return model.with_values(values)
