"""The baseline fit that findings are held against: its numbers, and Gauss-Newton steps with the judge's weights."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from op3.diagnose.coordinates import Coordinates, base_coordinates, usual_spread, with_chain
from op3.diagnose.judge import Judge, Numbers, Posterior, Variances
from op3.diagnose.judge_settings import SETTINGS, Settings
from op3.diagnose.reduction import Linear, Reduction
from op3.servo import Estimate, RobotModel
from op3.servo.conditions import split_name

STEPS, ELSEWHERE = 12, 4
"""Gauss-Newton steps at most of the best start, and of every start before they are compared."""

DAMPING = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Dampings of a step that are tried at once, as shares of each number's curvature."""

EITHER_WAY = (-1 / 2, -1 / 4, -1 / 8, 1 / 8, 1 / 4, 1 / 2)
"""Steps in the size of an effect alone that are tried behind those, in standard deviations of its prior."""

HELD_AT_END = 1e-3
"""Share of a number's standard deviation that is left to it at the end of its range."""

QUANTILE = 1.645
"""Of a 90 % interval."""

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
        costs_at = partial(cost_of, reduction, judge, fit, linear, coordinates)
        costs, tried = costs_at(point + np.vstack([np.zeros(len(point)), damped(fit, judge.numbers)]))
        least, point = costs.min(), tried[costs.argmin()]
        if len(alone := either_way(coordinates)):
            others, tried = costs_at(point + alone)
            least, point = min((least, point), (others.min(), tried[others.argmin()]), key=lambda one: one[0])
        gained = costs[0] - least
        number += 1
        done = number == steps or gained < SETTLED


def settled(reduction: Reduction, base: Baseline, settings: Settings = SETTINGS) -> Baseline:
    """A base fitted anew from where it is, within the ranges of its numbers: where one of them was taken back to its
    range, the others have not followed."""
    fitted = settle(reduction, base.coordinates, base.point, settings, state=base.fit.state)
    return replace(fitted, others=base.others)


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


def either_way(coordinates: Coordinates) -> np.ndarray:
    """Steps ``[step, number]`` that change only the size of one effect. If joints stick or play is crossed, linearised
    steps in all numbers together miss the best size."""
    sizes = [i for i, entry in enumerate(coordinates.entries) if entry.kind == "add"]
    steps = np.diag(coordinates.deviation)[sizes]
    return np.concatenate([share * steps for share in EITHER_WAY])


def cost_of(
    reduction: Reduction, judge: Judge, fit: Posterior, linear: Linear, coordinates: Coordinates, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Minus two log posterior of points (but for constants) under a fit's variances, ``[point]``, and the points within
    the ranges of their numbers."""
    points = np.clip(points, coordinates.low, coordinates.high)
    lacking = -reduction.reduce(linear.reducers, reduction.at(coordinates, points))
    known = np.isfinite(judge.rows.variance)
    misfits = np.array([judge.misfit(np.where(known, one, 0.0).astype(np.float64), fit) for one in lacking])
    return misfits + coordinates.penalties(points), points


def at_point(coordinates: Coordinates, point: np.ndarray, deviation: np.ndarray | None = None) -> RobotModel:
    """The model with its numbers at a point, intervals of 90 % from standard deviations where they are given."""
    model, joints, values = coordinates.model, coordinates.joints, {}
    spread: dict[str, float] = {}
    for i, entry in enumerate(coordinates.entries):
        if deviation is not None and entry.kind == "value" and entry.joints is None:
            spread[entry.parameter] = QUANTILE * float(deviation[i])
    for name, value in coordinates.values(point[None]).items():
        row, half = value[0].numpy(), spread.get(name)
        shared = float(np.median(row))
        low, high = (None, None) if half is None else (shared - half, shared + half)
        own = {joint: one for joint, one in zip(joints, row.tolist(), strict=False) if abs(one - shared) > 1e-12}
        kept = model.estimate(split_name(name)[0]).by if "@" not in name else {}
        values[name] = Estimate(shared, low, high, joints=own, by=kept)
    return model.with_values(values)
