"""Least squares on residuals with priors: the full refit of a model, and the cheap one of a hypothesis beside it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from scipy import special
from torch import Tensor

from op3.diagnose.coordinates import Coordinates
from op3.identify.box_step import box_step
from op3.servo import Estimate, RobotModel
from op3.servo.conditions import split_name
from op3.servo.effect import parameter

STEP = 1e-2
"""Step of finite differences, as a share of a coordinate's range: above the kinks of stiction."""

LADDER = (1.0, 0.6, 0.3, 0.08)
"""Shares of a Gauss-Newton step that are tried at once."""

SHARES = (0.15, 0.4, 0.8, 1.3, 2.0)
"""Shares of the way to a hypothesis that are tried first."""

ROUNDS = 3
"""Jacobians of a base at most."""

FADES = np.array([1.0, 0.7, 1.4])
"""Factors on the Stribeck velocity that are tried with every form of a law."""

FAR = 2.0
"""How many times the loss of the best form one may begin with and still be gone on with."""

LOSSLESS = 0.95
"""Efficiency beyond which a gear is taken to have no losses; all forms of these are the same there."""

LOSSES_WORTH = 0.1
"""Share of the loss by which another form, in which the gear keeps its losses, may be worse."""

WORTHWHILE = 0.05
"""Share of the loss that a Jacobian has to take off for another one to be worth its simulations."""

LEAST_GAIN = 3e-3
"""The same while a base is fitted from values that other robots had."""

INFORMATION = 0.02
"""Independent pieces of information per whitened residual. Residuals of a window, and model errors all over a run, go
together; priors weigh against this many."""


COARSE, ROUGH = 2, 4
"""By how much steps are stretched where differences of residuals only say what a window cannot tell from its start, and
where they only say where to look: of a dozen hypotheses for a refit the last few are others. Nothing is fitted so: in
steps twice as long a latency that explained 0.74 explained 0.12, a sag of the supply 0.09 for 0.33."""


class Engine(Protocol):
    """What gives residuals: `op3.diagnose.WindowResiduals` or `op3.diagnose.FreeRunResiduals`."""

    joints: tuple[str, ...]
    is_fit: np.ndarray
    blocks: np.ndarray

    def residuals(
        self,
        model: RobotModel,
        parameters: Mapping[str, Tensor] | None = None,
        candidates: int = 1,
        fit_only: bool = False,
        stretch: int = 1,
    ) -> np.ndarray:
        """Whitened residuals, ``[candidate, window, residual]``; for differences alone, in steps stretched so far.

        Those of a stiff model are not stretched.
        """
        ...

    def prepare(self, model: RobotModel) -> None:
        """Fix the whitening by this model."""
        ...

    def squares_by_joint(self, residual: np.ndarray) -> np.ndarray:
        """Sums of squares of whitened residuals ``[window, residual]``, ``[window, joint]``."""
        ...


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model.

    Attributes:
        coordinates: what was moved.
        point: where it ended, ``[coordinate]``.
        loss: mean square of the whitened residuals of the fitted windows.
        jacobian: of the residuals of all windows, ``[window, residual, coordinate]``; None unless asked for.
        residual: of all windows, ``[window, residual]``.
        columns: Jacobian of the coordinates beyond those of the base, of the fitted windows.
    """

    coordinates: Coordinates
    point: np.ndarray
    loss: float
    residual: np.ndarray
    jacobian: np.ndarray | None = None
    columns: np.ndarray | None = None
    _known: dict[str, "Linear"] = field(default_factory=dict, init=False, repr=False)

    def linear(self, is_fit: np.ndarray) -> "Linear":
        """Least squares on the fitted windows, linear around the point; of a fit with a Jacobian."""
        if "linear" not in self._known:
            assert self.jacobian is not None
            self._known["linear"] = Linear(self.jacobian[is_fit], self.coordinates)
        return self._known["linear"]

    @property
    def parameters(self) -> dict[str, Tensor]:
        """Parameters by name, ``[1, joint]``."""
        return self.coordinates.values(self.point[None])


def fit_base(
    engine: Engine,
    coordinates: Coordinates,
    *,
    rounds: int = ROUNDS,
    start: np.ndarray | None = None,
    alternatives: Sequence[RobotModel] = (),
    worthwhile: float = LEAST_GAIN,
    progress: Callable[[float], None] | None = None,
) -> Fit:
    """Bounded Gauss-Newton over all coordinates, from the best of a grid of latencies.

    Args:
        engine: gives the residuals; it is prepared by the starting model, and again by better ones.
        coordinates: what to move.
        rounds: at most so many Jacobians.
        start: where to start, ``[coordinate]``.
        alternatives: models with the same parameters in other forms; the form that fits best is taken.
        worthwhile: share of the loss that a Jacobian has to take off for another one to follow.
        progress: called with the share done.
    """
    point = np.clip(coordinates.start if start is None else start, coordinates.low, coordinates.high)
    models = [coordinates.model, *alternatives]
    for number in range(rounds):
        engine.prepare(with_point(coordinates, point))
        evaluate = _penalised(engine, coordinates)
        linear = Linear(_jacobian(engine, coordinates, point, True, COARSE), coordinates)
        (residual,) = evaluate(point[None])
        before = float(np.square(residual).sum())
        point, after = _descend(evaluate, coordinates, linear, point, residual, 1 if number == 0 else 2)
        if progress is not None:
            progress((number + 1) / (rounds + 1))
        if start is None and number == 0:
            point = _best_latency(engine, coordinates, point)
        chosen = coordinates.model
        if alternatives:
            coordinates, point = _best_form(engine, coordinates, models, point, linear)
        gained = 1 - after / before
        if gained < worthwhile and (number or start is not None) and coordinates.model is chosen:
            break
    if alternatives:
        coordinates, point = _with_losses(engine, coordinates, models, point, worthwhile)
    return linearise(engine, coordinates, point)


def _with_losses(
    engine: Engine, coordinates: Coordinates, models: Sequence[RobotModel], point: np.ndarray, worthwhile: float
) -> tuple[Coordinates, np.ndarray]:
    """The same, or another form of the gear's losses that fits about as well, where these have vanished.

    No gear is without losses. What is missing may drive them to none in one form, where all forms are the same, and not
    in the other: beside a mass that was hidden both were needed, and a friction by load then stood for the two.
    """
    kept = [e.kind == "value" and split_name(e.parameter)[0] == "backward_efficiency" for e in coordinates.entries]
    vanished = np.array(kept) & (point >= LOSSLESS)
    if not vanished.any():
        return coordinates, point
    forms = {effect.name: effect for effect in coordinates.model.effects}
    best = coordinates, point
    start = np.where(vanished, parameter("backward_efficiency").nominal, point)
    engine.prepare(with_point(coordinates, point))
    least = (1.0 + LOSSES_WORTH) * float(np.square(_penalised(engine, coordinates)(point[None])).sum())
    for model in models:
        differ = [effect.name for effect in model.effects if effect != forms[effect.name]]
        if differ != ["dte"]:
            continue
        choice = replace(coordinates, model=model)
        other = fit_base(engine, choice, start=start, worthwhile=worthwhile)
        engine.prepare(with_point(coordinates, point))
        loss = float(np.square(_penalised(engine, choice)(other.point[None])).sum())
        if loss < least and (other.point[vanished] < LOSSLESS).all():
            best, least = (choice, other.point), loss
    return best


def linearise(engine: Engine, coordinates: Coordinates, point: np.ndarray) -> Fit:
    """Residuals and Jacobian at a point, on all windows, whitened by the model there."""
    engine.prepare(with_point(coordinates, point))
    values = coordinates.values(point[None])
    residual = engine.residuals(coordinates.model, values, 1)[0]
    jacobian = _jacobian(engine, coordinates, point, fit_only=False)
    return Fit(coordinates, point, mean_square(residual[engine.is_fit]), residual, jacobian)


def _jacobian(
    engine: Engine, coordinates: Coordinates, point: np.ndarray, fit_only: bool, stretch: int = 1
) -> np.ndarray:
    """Differences of the residuals, inwards at the bounds, ``[window, residual, coordinate]``."""
    step = _steps(coordinates, point)
    points = np.concatenate([[point], point + np.diag(step)])
    result = engine.residuals(coordinates.model, coordinates.values(points), len(points), fit_only, stretch)
    return np.moveaxis(result[1:] - result[0], 0, -1) / step.astype(np.float32)


def _steps(coordinates: Coordinates, point: np.ndarray) -> np.ndarray:
    span = coordinates.high - coordinates.low
    return np.where(point + 2 * STEP * span > coordinates.high, -STEP, STEP) * span


class Linear:
    """Least squares on residuals and priors that are linear in the coordinates.

    Args:
        jacobian: of the residuals of the fitted windows, ``[window, residual, coordinate]``; with `within` that of the
            further coordinates.
        coordinates: with their priors.
        within: least squares of the first coordinates, where they are known.
    """

    def __init__(self, jacobian: np.ndarray, coordinates: Coordinates, within: "Linear | None" = None):
        columns = [] if within is None else within.columns
        added = jacobian.reshape(np.prod(jacobian.shape[:2]), jacobian.shape[2]).astype(np.float64)
        self.columns = [*columns, added]
        size, known = len(coordinates), len(coordinates) - added.shape[1]
        products = np.zeros((size, size))
        if within is not None:
            products[:known, :known] = within.products
        products[:, known:] = np.concatenate([part.T @ added for part in self.columns])
        products[known:, :known] = products[:known, known:].T
        self.products = products
        deviation = np.array([entry.deviation for entry in coordinates.entries])
        self._priors = 1.0 / deviation / np.sqrt(INFORMATION)

    def step(self, residual: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Minimiser within bounds, ``[coordinate]``.

        Args:
            residual: of the fitted windows and behind them the priors'.
            low: ``[coordinate]``.
            high: ``[coordinate]``.
        """
        left = residual[: -len(self._priors)]
        gradient = np.concatenate([part.T @ left for part in self.columns])
        gradient += self._priors * residual[-len(self._priors) :]
        return bounded_step(self.products + np.diag(self._priors**2), gradient, low, high)


def refit(
    engine: Engine,
    base: Fit,
    coordinates: Coordinates,
    start: np.ndarray,
    *,
    anchor: Fit | None = None,
    shares: Sequence[float] = SHARES,
    iterations: int = 3,
) -> Fit:
    """Gauss-Newton over a base and a few more coordinates, the base's Jacobian kept.

    Only the columns of the new coordinates are renewed, which makes an iteration cost two small batches of simulations
    however many parameters the base has; the step is searched along its length, so that a Jacobian that is no longer
    quite right costs speed and not correctness.

    With an anchor the first step goes from it along the hypothesis, the base giving way as its Jacobian says, and
    nothing worse than the anchor is ever returned.

    Args:
        engine: gives the residuals.
        base: with its Jacobian; its coordinates are the first of `coordinates`.
        coordinates: base and hypothesis.
        start: ``[coordinate]``.
        anchor: the base's coordinates fitted without the hypothesis.
        shares: of the way from the anchor to `start` that are tried first.
        iterations: at most so many steps.
    """
    assert base.jacobian is not None
    known, is_fit = len(base.coordinates), engine.is_fit
    problem = _Problem(engine, coordinates)
    best = np.clip(start, coordinates.low, coordinates.high)
    residual = loss = columns = None
    at_anchor = False
    if anchor is not None:
        best, residual, loss = _along(problem, base.linear(is_fit), anchor, best, shares)
        at_anchor = residual is None
        residual = anchor.residual[is_fit] if residual is None else residual
    for _ in range(iterations):
        step = _steps(coordinates, best)[known:]
        if residual is None or loss is None:
            residual = problem.simulate(best[None])[0]
            loss = problem.loss(best, residual)
        further = best + np.eye(len(best))[known:] * step[:, None]
        moved = problem.simulate(further) if len(further) else residual[None][:0]
        columns = np.moveaxis(moved - residual, 0, -1) / step.astype(np.float32)
        linear = Linear(columns, coordinates, base.linear(is_fit))
        point, reached, tried = problem.step(linear, best, residual)
        if reached >= loss:
            break
        gained = 1 - reached / loss
        best, loss, residual, at_anchor = point, reached, tried, False
        if gained < 2e-3:
            break
    whole = anchor.residual if anchor is not None and at_anchor else problem.everywhere(best)
    return Fit(coordinates, best, mean_square(whole[is_fit]), whole, None, columns)


def likeliest(engine: Engine, coordinates: Coordinates, starts: Sequence[np.ndarray]) -> np.ndarray:
    """The start with the smallest loss, ``[coordinate]``."""
    return _Problem(engine, coordinates).best(np.stack(starts))[0]


def polish(engine: Engine, base: Fit, fit: Fit, steps: int = 2, jacobians: int = 3) -> Fit:
    """Go on from a refit with Jacobians of its own: far from the base, the base's is no longer right.

    Args:
        engine: gives the residuals.
        base: whose coordinates are the first of the fit's.
        fit: where to start; its columns are kept.
        steps: along each Jacobian.
        jacobians: at most so many; one more only where the last lowered the loss by `WORTHWHILE`.
    """
    problem = _Problem(engine, fit.coordinates)
    point, residual = fit.point, fit.residual[engine.is_fit]
    loss = problem.loss(point, residual)
    while True:
        jacobian = _jacobian(engine, fit.coordinates, point, fit_only=True)
        linear, before, jacobians = Linear(jacobian, fit.coordinates), loss, jacobians - 1
        for _ in range(steps):
            later, reached, tried = problem.step(linear, point, residual)
            if reached >= loss:
                break
            point, residual, loss = later, tried, reached
        if not jacobians or loss > (1 - WORTHWHILE) * before:
            break
    columns = jacobian[..., len(base.coordinates) :]
    whole = fit.residual if point is fit.point else problem.everywhere(point)
    return Fit(fit.coordinates, point, mean_square(whole[engine.is_fit]), whole, None, columns)


class _Problem:
    """Least squares of one refit: simulation, loss with priors, and a step along a Jacobian."""

    def __init__(self, engine: Engine, coordinates: Coordinates):
        self.engine, self.coordinates = engine, coordinates

    def simulate(self, points: np.ndarray) -> np.ndarray:
        """Residuals of the fitted windows, ``[point, window, residual]``."""
        return self.engine.residuals(
            self.coordinates.model, self.coordinates.values(points), len(points), fit_only=True
        )

    def everywhere(self, point: np.ndarray) -> np.ndarray:
        """Residuals of all windows, ``[window, residual]``."""
        return self.engine.residuals(self.coordinates.model, self.coordinates.values(point[None]), 1)[0]

    def loss(self, point: np.ndarray, residual: np.ndarray) -> float:
        """Squares of the fitted windows, and of the priors."""
        data = float(np.square(residual.astype(np.float64)).sum())
        return data + float(np.square(self.coordinates.penalties(point)).sum()) / INFORMATION

    def step(self, linear: Linear, point: np.ndarray, residual: np.ndarray):
        """The best of several lengths of a bounded step: point, loss and residual there."""
        low, high = self.coordinates.low - point, self.coordinates.high - point
        now = np.concatenate(
            [
                residual.reshape(-1).astype(np.float64),
                self.coordinates.penalties(point) / np.sqrt(INFORMATION),
            ]
        )
        direction = linear.step(now, low, high)
        return self.best(point + np.array(LADDER)[:, None] * direction)

    def best(self, points: np.ndarray):
        """The best of some points, its loss and its residual."""
        tried = self.simulate(points)
        reached = [self.loss(point, residual) for point, residual in zip(points, tried, strict=True)]
        winner = int(np.argmin(reached))
        return points[winner], reached[winner], tried[winner]


def _along(problem: _Problem, linear: Linear, anchor: Fit, start: np.ndarray, shares: Sequence[float]):
    """From an anchor part of the way to `start`, or beyond; point, residual of the fitted windows, and loss.

    The residual is None where nothing is better than the anchor.

    Args:
        problem: of the refit.
        linear: least squares of the base.
        anchor: fit of the base alone.
        start: base and hypothesis.
        shares: of the way that are tried.
    """
    coordinates, known, is_fit = problem.coordinates, len(anchor.point), problem.engine.is_fit
    neutral = np.concatenate([anchor.point, [entry.prior for entry in coordinates.entries[known:]]])
    before = anchor.residual[is_fit]
    loss = problem.loss(neutral, before)
    secant = problem.simulate(start[None])[0] - before
    base = replace(coordinates, model=coordinates.model, entries=coordinates.entries[:known])
    low, high = base.low - anchor.point, base.high - anchor.point
    priors = base.penalties(anchor.point) / np.sqrt(INFORMATION)
    points = []
    for share in shares:
        expected = (before + share * secant).reshape(-1).astype(np.float64)
        gives = linear.step(np.concatenate([expected, priors]), low, high)
        points.append(neutral + share * (start - neutral) + np.concatenate([gives, np.zeros(len(start) - known)]))
    point, reached, tried = problem.best(np.clip(points, coordinates.low, coordinates.high))
    return (point, tried, reached) if reached < loss else (neutral, None, loss)


def intervals(engine: Engine, base: Fit, fit: Fit, level: float = 0.9) -> np.ndarray:
    """Intervals of the coordinates beyond the base's, by leaving out one second after another.

    The cluster jackknife of a Gauss-Newton step, as in `op3.identify.intervals`.

    Args:
        engine: gives the blocks.
        base: with its Jacobian.
        fit: a refit beside it.
        level: coverage.

    Returns:
        Half widths, ``[coordinate beyond the base]``.
    """
    assert base.jacobian is not None
    assert fit.columns is not None
    fitted = np.concatenate([base.jacobian[engine.is_fit], fit.columns], -1).astype(np.float64)
    scale = np.maximum(np.sqrt(np.square(fitted).sum((0, 1))), 1e-12)
    fitted = fitted / scale
    deviation = np.array([entry.deviation for entry in fit.coordinates.entries]) * scale
    residual = fit.residual[engine.is_fit].astype(np.float64)
    hessian = np.einsum("wri,wrj->ij", fitted, fitted, optimize=True) + np.diag(1 / deviation**2) / INFORMATION
    hessian += 1e-9 * np.eye(len(scale))
    names = np.unique(engine.blocks[engine.is_fit])
    moves = []
    for name in names:
        inside = engine.blocks[engine.is_fit] == name
        part = fitted[inside].reshape(-1, len(scale))
        moves.append(np.linalg.solve(hessian - part.T @ part, part.T @ residual[inside].reshape(-1)))
    count = len(names)
    spread = np.sqrt((count - 1) / count * np.square(np.array(moves)).sum(0))
    quantile = special.stdtrit(max(1, count - 1), 0.5 + level / 2)
    return (quantile * spread / scale)[len(base.coordinates) :]


def bounded_step(products: np.ndarray, gradient: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Minimiser of ``step' products step / 2 + gradient' step`` within bounds, ``[coordinate]``.

    Args:
        products: of a Jacobian's columns with each other, ``[coordinate, coordinate]``.
        gradient: ``[coordinate]``.
        low: ``[coordinate]``; what is above zero counts as zero.
        high: ``[coordinate]``; likewise from below.
    """
    scale = np.maximum(np.sqrt(np.diag(products)), 1e-12)
    hessian = products / scale / scale[:, None] + 1e-6 * np.eye(len(scale))
    low, high = np.minimum(low, 0.0) * scale, np.maximum(high, 0.0) * scale
    return box_step(hessian, gradient / scale, low, high) / scale


def with_point(coordinates: Coordinates, point: np.ndarray) -> RobotModel:
    """The model with the numbers of a point, per joint where they differ."""
    estimates, model = {}, coordinates.model
    for name, value in coordinates.values(point[None]).items():
        by = {} if "@" in name else model.estimate(name).by
        estimates[name] = replace(Estimate.of_row(value[0], coordinates.joints), by=by)
    return model.with_values(estimates)


def mean_square(residual: np.ndarray) -> float:
    """Mean of squares."""
    return float(np.square(residual.astype(np.float64)).mean())


def _penalised(engine: Engine, coordinates: Coordinates) -> Callable[[np.ndarray], np.ndarray]:
    """Residuals of the fitted windows and penalties of points ``[candidate, coordinate]``, as one vector each.

    Args:
        engine: gives the residuals.
        coordinates: of the points.
    """

    def evaluate(points: np.ndarray) -> np.ndarray:
        values = coordinates.values(points)
        result = engine.residuals(coordinates.model, values, len(points), fit_only=True)
        flat = result.reshape(len(points), -1).astype(np.float64)
        return np.concatenate([flat, coordinates.penalties(points) / np.sqrt(INFORMATION)], 1)

    return evaluate


def _best_form(
    engine: Engine, coordinates: Coordinates, models: Sequence[RobotModel], point: np.ndarray, linear: Linear
) -> tuple[Coordinates, np.ndarray]:
    """Coordinates of the model that fits best, and where.

    The same numbers mean something else in another form, so each form may first go where it fits better: in the range
    of speeds over which static friction fades, of which some are tried, then in everything, along a Jacobian of any of
    the forms.

    Args:
        engine: gives the residuals.
        coordinates: of the form that was fitted.
        models: in all forms.
        point: that was reached.
        linear: least squares about a point nearby.
    """
    names = [entry.parameter for entry in coordinates.entries]
    points = np.tile(point, (len(FADES), 1))
    if "stribeck_velocity" in names:
        points[:, names.index("stribeck_velocity")] *= FADES
    points = np.clip(points, coordinates.low, coordinates.high)
    begun = []
    for model in models:
        choice = replace(coordinates, model=model)
        evaluate = _penalised(engine, choice)
        begun.append((choice, evaluate, *_least(evaluate, points)))
    least = min(loss for _, _, _, loss, _ in begun)
    reached = [
        (*_descend(evaluate, choice, linear, start, residual, 1), choice)
        for choice, evaluate, start, loss, residual in begun
        if loss < FAR * least
    ]
    place, _, chosen = min(reached, key=lambda one: one[1])
    return chosen, place


def _descend(
    evaluate: Callable[[np.ndarray], np.ndarray],
    coordinates: Coordinates,
    linear: Linear,
    point: np.ndarray,
    residual: np.ndarray,
    steps: int,
) -> tuple[np.ndarray, float]:
    """Some steps along a Jacobian; where they end, and the loss there."""
    loss = float(np.square(residual).sum())
    for _ in range(steps):
        direction = linear.step(residual, coordinates.low - point, coordinates.high - point)
        reached, least, left = _least(evaluate, point + np.array(LADDER)[:, None] * direction)
        if least >= loss:
            break
        point, loss, residual = reached, least, left
    return point, loss


def _least(evaluate: Callable[[np.ndarray], np.ndarray], points: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """The best of some points, its loss and its residuals."""
    residuals = evaluate(points)
    losses = np.square(residuals).sum(1)
    place = int(losses.argmin())
    return points[place], float(losses[place]), residuals[place]


def _best_latency(engine: Engine, coordinates: Coordinates, point: np.ndarray) -> np.ndarray:
    """The point with the best of a grid of latencies: the loss has several valleys along it."""
    names = [entry.parameter for entry in coordinates.entries]
    if "command_latency" not in names:
        return point
    at = names.index("command_latency")
    grid = np.linspace(coordinates.low[at], coordinates.high[at], 9)
    points = np.tile(point, (len(grid), 1))
    points[:, at] = grid
    losses = np.square(_penalised(engine, coordinates)(points)).sum(1)
    return points[int(losses.argmin())]
