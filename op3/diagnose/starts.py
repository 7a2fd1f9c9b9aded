"""Where a baseline fit begins: a start for every structure of its laws.

Stiction kills gradients, so an evolution strategy (CatCMA: Hamano et al. 2024) over the shared numbers finds the
basins, in long steps; Gauss-Newton steps with the judge's noise then settle in each.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from cmaes import CatCMA

from op3.diagnose.base import ELSEWHERE, Baseline, End, as_usual, gap_of, settle
from op3.diagnose.coordinates import (
    BENCH,
    CHAIN,
    WIDEST,
    Coordinates,
    any_spread,
    base_coordinates,
    other_forms,
    with_chain,
    with_own_spread,
    with_setups,
)
from op3.diagnose.judge_settings import SETTINGS, Settings
from op3.diagnose.reduction import Reduction
from op3.servo import RobotModel, Stage

GENERATIONS, FINE, SIGMA = 50, 10, 0.2
"""Of the search: generations, the last of them in steps half as long, and the first one's standard deviation as a share
of every range."""

FACTORS = (0.25, 0.5, 2.0, 4.0)
"""Of a servo's number on what all share, from which a fit begins where they predict better than 1."""

GEAR = (Stage.GEAR, Stage.LOAD)
"""Stages of the effects that say where the gear's losses go."""

FEWEST_WINDOWS, FINALISTS = 24, 2
"""Windows on which starts settle first, at least, and starts that settle on all."""


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
    best of these on all; from there every other law of the gear is tried once more.
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
    forms = next(group for group in groups if _gear(group[0]) == _gear(first.coordinates.model))
    anew = (settle(thin, *at, settings, ELSEWHERE) for at in _elsewhere(first, forms, reduction.engine.period))
    _, best = _ranked(thin, chain([first], anew), settings)
    progress(0.6)
    finals = (settle(reduction, end.coordinates, end.point, settings) for end in best[:FINALISTS])
    first, ranked = _ranked(reduction, finals, settings)
    progress(0.75)
    first, ranked = with_best_gear(reduction, thin, first, ranked, settings)
    progress(0.9)
    others = tuple(replace(end, gain=end.gain - ranked[0].gain) for end in ranked[1:])
    own, point = with_own_spread(first.coordinates, first.point, first.deviations, settings)
    free = settle(reduction, own, point, settings, state=first.fit.state)
    return replace(as_usual(reduction, free, settings), others=others)


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


def _elsewhere(base: Baseline, forms: Sequence[RobotModel], period: float) -> Iterator[tuple[Coordinates, np.ndarray]]:
    """Where else a base may begin, as each has a basin of its own.

    In every form of friction's laws, from where the base is and with friction as at first; and with commands before the
    next reading where they come after it, and the other way round, whose currents lag the more or the less, or a whole
    reading earlier or later: a reading shows the first of a command's current, or nothing of it yet.
    """
    own, point = base.coordinates, base.point
    as_at_first = _at_first(base, (Stage.FRICTION,))
    for form in forms:
        yield replace(own, model=form), point
        yield replace(own, model=form), as_at_first
    at = {entry.parameter: i for i, entry in enumerate(own.entries) if entry.joints is None}
    late, lag = at.get("command_latency"), at.get("current_time_constant")
    if late is None or lag is None:
        return
    margin = CHAIN["command_latency"].spread
    across = period - point[late] + (-margin if point[late] > period else margin)
    for later, less in ((across, across), (period, 0.0), (-period, 0.0)):
        moved = point.copy()
        moved[[late, lag]] += later, -less
        if own.low[late] <= moved[late] <= own.high[late]:
            yield own, np.clip(moved, own.low, own.high)


def with_best_gear(
    reduction: Reduction, thin: Reduction, base: Baseline, ends: list[End], settings: Settings
) -> tuple[Baseline, list[End]]:
    """The base with the law of the gear that explains the logs best once all else is fitted, and where other starts
    ended; the same base where no other law is better."""
    anew = (settle(thin, *at, settings, ELSEWHERE) for at in _other_gears(base))
    _, best = _ranked(thin, anew, settings)
    if best[0].gain <= 0.0:
        return base, ends
    final = settle(reduction, best[0].coordinates, best[0].point, settings)
    return _ranked(reduction, iter([base, final]), settings)


def _other_gears(base: Baseline) -> Iterator[tuple[Coordinates, np.ndarray]]:
    """Where a base may begin with another law of the gear, once all else is about right: a law that was left behind
    with worse numbers may be the better one.

    As it is; in every other form, from where the base is and with the gear's numbers as at first; and in every form
    with a gear that loses more near rest, which another form may have taken the place of.
    """
    own, point = base.coordinates, base.point
    yield own, point
    near = np.array([entry.parameter == "near_rest_loss" for entry in own.entries])
    more = np.where(near, CHAIN["near_rest_loss"].spread, point)
    yield own, more
    for form in other_forms(own.model, lambda effect: effect.stage in GEAR):
        yield from ((replace(own, model=form), at) for at in (point, _at_first(base, GEAR), more))


def _at_first(base: Baseline, stages: Sequence[Stage]) -> np.ndarray:
    """A base's point with the numbers of some stages' effects where the fit began."""
    effects = [effect for effect in base.coordinates.model.effects if effect.stage in stages]
    names = {known.name for effect in effects for known in effect.parameters}
    mine = np.array([entry.parameter in names for entry in base.coordinates.entries])
    return np.where(mine, base.coordinates.start, base.point)


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
        if entry.of_servo and entry.kind == "scale":
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
