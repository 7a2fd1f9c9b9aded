"""The baseline fit from several starts, with at least one for every structure of the laws.

Stiction removes gradients, so an evolution strategy (CatCMA: Hamano et al. 2024) over the shared parameters, with long
simulation steps, finds the basins; Gauss-Newton steps with estimated noise converge within each.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from cmaes import CatCMA

from op3.diagnose.base import FEW_STEPS, Baseline, LocalOptimum, evidence_gain, gauss_newton, within_sound_spread
from op3.diagnose.coordinates import (
    BENCH,
    CHAIN,
    WIDEST,
    Coordinates,
    base_coordinates,
    other_forms,
    with_chain,
    with_robot_spread,
    with_setups,
    with_student_spread,
)
from op3.diagnose.reduction import Reduction
from op3.servo import RobotModel, Stage

GENERATIONS, FINE_GENERATIONS, SIGMA = 50, 10, 0.2
"""Budget of the search: number of generations, the last with halved steps; numerical: the initial standard deviation as
a share of every range."""

FACTORS = (0.25, 0.5, 2.0, 4.0)
"""Numerical: factors on a parameter of one servo that are compared before a fit."""

GEAR = (Stage.GEAR, Stage.LOAD)
"""Stages of the effects that describe the gear's losses."""

FINALISTS = 2
"""Budget: starts that are fitted on all windows."""


def fit_base(
    reduction: Reduction,
    model: RobotModel,
    rng: np.random.Generator,
    progress: Callable[[float], None] = lambda share: None,
) -> Baseline:
    """Fit the model's parameters, the spread between servos and the measurement chain.

    Starts of every structure (form of the gear law and of the friction law, commands before or after the next reading)
    are fitted on a third of the windows, and the best of them on all; then every other gear law is fitted again. A
    Student prior allows one servo to differ strongly. Finally, each servo is clipped to the spread of a sound robot,
    and a candidate must explain the excess.
    """
    lengths, settings = reduction.engine.lengths, reduction.settings
    full = with_chain(with_setups(model, lengths))
    priors = {**CHAIN, **BENCH} if lengths else CHAIN
    sound = base_coordinates(full, reduction.engine.joints, reduction.moving, priors)
    coordinates = with_student_spread(sound, settings.tails)
    thin = reduction.thinned()
    # each gear law has a different optimum in all parameters
    gears = [full, *other_forms(full, lambda effect: effect.stage in GEAR)]
    groups = [[gear, *other_forms(gear, lambda effect: effect.stage not in GEAR)] for gear in gears]

    def first_fits() -> Iterator[Baseline]:
        for number, forms in enumerate(groups):
            start, point = search(thin, coordinates, rng, forms)
            yield gauss_newton(thin, start, with_servo_factors(thin, start, point), FEW_STEPS)
            progress(0.5 * (number + 1) / len(groups))
        if len(groups) == 1:
            yield gauss_newton(thin, coordinates, coordinates.start, FEW_STEPS)

    best, _ = _ranked(thin, first_fits())
    forms = next(group for group in groups if _gear_forms(group[0]) == _gear_forms(best.coordinates.model))
    further = (gauss_newton(thin, *start, FEW_STEPS) for start in _further_starts(best, forms, reduction.engine.period))
    _, optima = _ranked(thin, chain([best], further))
    progress(0.6)
    finals = (gauss_newton(reduction, optimum.coordinates, optimum.point) for optimum in optima[:FINALISTS])
    best, optima = _ranked(reduction, finals)
    progress(0.75)
    best, optima = with_best_gear(reduction, thin, best, optima)
    progress(0.9)
    others = tuple(replace(optimum, gain=optimum.gain - optima[0].gain) for optimum in optima[1:])
    spread, point = with_robot_spread(best.coordinates, best.point, best.deviations, settings)
    free = gauss_newton(reduction, spread, point, variances=best.fit.variances)
    return replace(within_sound_spread(reduction, free), other_optima=others)


def _gear_forms(model: RobotModel) -> list:
    """The gear's effects that have several forms."""
    return [effect for effect in model.effects if effect.stage in GEAR and effect.written]


def _ranked(reduction: Reduction, bases: Iterator[Baseline]) -> tuple[Baseline, list[LocalOptimum]]:
    """The best of several fits, and all optima, the best first; only the best is kept in memory (15 MB each)."""
    first = best = next(bases)
    highest, optima = 0.0, [LocalOptimum(first.coordinates, first.point, 0.0)]
    for base in bases:
        gain = evidence_gain(reduction, first, base)
        optima.append(LocalOptimum(base.coordinates, base.point, gain))
        if gain > highest:
            highest, best = gain, base
    return best, sorted(optima, key=lambda optimum: -optimum.gain)


def _further_starts(
    base: Baseline, forms: Sequence[RobotModel], period: float
) -> Iterator[tuple[Coordinates, np.ndarray]]:
    """Further starts, each in a different basin.

    Every form of the friction laws, with the fitted and with the initial friction; and command timings: commands that
    act before instead of after the next reading or vice versa, with a matching current lag, or one period earlier or
    later. A reading includes the first current of a command or none of it.
    """
    coordinates, point = base.coordinates, base.point
    initial = _with_initial(base, (Stage.FRICTION,))
    for form in forms:
        yield replace(coordinates, model=form), point
        yield replace(coordinates, model=form), initial
    index = {entry.parameter: i for i, entry in enumerate(coordinates.entries) if entry.joints is None}
    latency, lag = index.get("command_latency"), index.get("current_time_constant")
    if latency is None or lag is None:
        return
    margin = CHAIN["command_latency"].spread
    across = period - point[latency] + (-margin if point[latency] > period else margin)
    for later, less_lag in ((across, across), (period, 0.0), (-period, 0.0)):
        start = point.copy()
        start[[latency, lag]] += later, -less_lag
        if coordinates.low[latency] <= start[latency] <= coordinates.high[latency]:
            yield coordinates, np.clip(start, coordinates.low, coordinates.high)


def with_best_gear(
    reduction: Reduction, thin: Reduction, base: Baseline, optima: list[LocalOptimum]
) -> tuple[Baseline, list[LocalOptimum]]:
    """The baseline with the best gear law after fitting all other parameters, and all optima; the same if none is
    better."""
    _, gears = _ranked(thin, (gauss_newton(thin, *start, FEW_STEPS) for start in _gear_starts(base)))
    if gears[0].gain <= 0.0:
        return base, optima
    final = gauss_newton(reduction, gears[0].coordinates, gears[0].point)
    return _ranked(reduction, iter([base, final]))


def _gear_starts(base: Baseline) -> Iterator[tuple[Coordinates, np.ndarray]]:
    """Starts with other gear laws, which may be better once all other parameters are fitted.

    The starts are the fit itself; every other form with the fitted and with the initial gear parameters; and every form
    with more loss near rest, which another form may have imitated.
    """
    coordinates, point = base.coordinates, base.point
    yield coordinates, point
    near_rest = np.array([entry.parameter == "near_rest_loss" for entry in coordinates.entries])
    lossy = np.where(near_rest, CHAIN["near_rest_loss"].spread, point)
    yield coordinates, lossy
    for form in other_forms(coordinates.model, lambda effect: effect.stage in GEAR):
        yield from ((replace(coordinates, model=form), start) for start in (point, _with_initial(base, GEAR), lossy))


def _with_initial(base: Baseline, stages: Sequence[Stage]) -> np.ndarray:
    """A baseline's point with the parameters of some stages reset to their initial values."""
    effects = [effect for effect in base.coordinates.model.effects if effect.stage in stages]
    names = {parameter.name for effect in effects for parameter in effect.parameters}
    initial = np.array([entry.parameter in names for entry in base.coordinates.entries])
    return np.where(initial, base.coordinates.start, base.point)


def search(
    reduction: Reduction, coordinates: Coordinates, rng: np.random.Generator, forms: Sequence[RobotModel] = ()
) -> tuple[Coordinates, np.ndarray]:
    """Evolution strategy over the shared parameters, logarithmic where they are positive, and the forms of the laws.

    It does not estimate noise and differences between servos.
    """
    options = [replace(coordinates, model=form) for form in forms] or [coordinates]
    shared = [i for i, entry in enumerate(coordinates.entries) if entry.joints is None]
    low, high, start = coordinates.low[shared], coordinates.high[shared], coordinates.start[shared]
    zero = np.array([coordinates.entries[i].zero for i in shared])
    positive = (low >= zero) & (start > zero)
    bottom = np.where(positive, np.maximum(low, zero + (start - zero) / WIDEST), low)
    with np.errstate(divide="ignore", invalid="ignore"):
        lower, upper, initial = (np.where(positive, np.log(x - zero), x) for x in (bottom, high, start))

    def costs_of(samples: Sequence, stretch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Costs, points and forms of samples."""
        x = lower + np.array([numbers for numbers, _ in samples]) * (upper - lower)
        form = np.array([choice.argmax() for _, choice in samples]) % len(options)
        points, cost = np.tile(coordinates.start, (len(x), 1)), np.zeros(len(x))
        points[:, shared] = np.clip(np.where(positive, zero + np.exp(np.where(positive, x, 0.0)), x), low, high)
        for number, option in enumerate(options):
            if (rows := form == number).any():
                cost[rows] = robust_costs(reduction.errors_at(option, points[rows], stretch), reduction.limbs).sum(0)
        return cost + coordinates.penalties(points), points, form

    strategy = CatCMA(
        np.clip((initial - lower) / (upper - lower), 0.05, 0.95),
        SIGMA,
        cat_num=np.array([max(2, len(options))]),  # a single form is listed twice, because a choice needs two options
        bounds=np.array([[0.0, 1.0]] * len(shared)),
        seed=int(rng.integers(2**31)),
    )
    best = np.inf, coordinates.start, 0
    for generation in range(GENERATIONS):
        samples = [strategy.ask() for _ in range(strategy.population_size)]
        fine = generation >= GENERATIONS - FINE_GENERATIONS
        cost, points, form = costs_of(samples, 2 if fine else 4)
        strategy.tell([(sample, float(value)) for sample, value in zip(samples, cost, strict=True)])
        if fine and cost.min() < best[0]:
            best = cost.min(), points[cost.argmin()], form[cost.argmin()]
    return options[best[2]], best[1]


def robust_costs(errors: Sequence[np.ndarray], limbs: Sequence[np.ndarray]) -> np.ndarray:
    """Robust cost of whitened errors, ``[limb, set]``: logarithmic in each joint and window, so that one faulty joint
    does not determine the shared parameters."""
    costs = []
    for error, limb in zip(errors, limbs, strict=True):
        sets, windows, _ = error.shape
        square = np.square(error.reshape(sets, windows, -1, len(limb), 3), dtype=np.float64).mean((2, 4))
        costs.append(np.log1p(square).sum((1, 2)))
    return np.array(costs)


def with_servo_factors(reduction: Reduction, coordinates: Coordinates, point: np.ndarray) -> np.ndarray:
    """A point at which one parameter of each servo is scaled by the factor that best predicts its limb, if any helps.

    A joint that sticks although it should move gives no gradient towards a parameter several times larger.
    """
    indices: dict[int, dict[str, int]] = {}
    for i, entry in enumerate(coordinates.entries):
        if entry.per_servo and entry.kind == "scale":
            indices.setdefault(entry.joints[0], {})[entry.parameter] = i  # type: ignore[index]
    trials = [(name, factor) for name in next(iter(indices.values()), {}) for factor in FACTORS]
    for slot in range(max(map(len, reduction.limbs)) if indices else 0):
        joints = [int(limb[slot]) for limb in reduction.limbs if slot < len(limb) and int(limb[slot]) in indices]
        points = np.tile(point, (len(trials) + 1, 1))  # the first unchanged
        by_joint = {joint: points.copy() for joint in joints}
        for joint in joints:
            for row, (name, factor) in enumerate(trials, 1):
                points[row, indices[joint][name]] = by_joint[joint][row, indices[joint][name]] = factor - 1.0
        costs = robust_costs(reduction.errors_at(coordinates, points), reduction.limbs)
        for joint in joints:  # limbs are not coupled
            trial_points = by_joint[joint]
            best = int((costs[reduction.limb_of[joint]] + coordinates.penalties(trial_points)).argmin())
            point = np.where(trial_points[best] != trial_points[0], trial_points[best], point)
    return point
