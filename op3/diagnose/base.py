"""The baseline fit: Gauss-Newton steps in the nonlinear simulation with the noise estimates of the linear model."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from op3.diagnose.coordinates import Coordinates, base_coordinates, with_chain, with_sound_spread
from op3.diagnose.judge import CoefficientPriors, Judge, Posterior, Variances
from op3.diagnose.linearisation import Linearisation
from op3.diagnose.reduction import Reduction
from op3.servo import Estimate, RobotModel
from op3.servo.conditions import split_name

STEPS, FEW_STEPS = 12, 4
"""Budget: Gauss-Newton steps of the best start, and of every start before the comparison."""

DAMPING = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Numerical: damping factors compared in each step, relative to the curvature of each coordinate."""

SIZE_STEPS = (-1 / 2, -1 / 4, -1 / 8, 1 / 8, 1 / 4, 1 / 2)
"""Numerical: steps in the size of an effect alone, in standard deviations of its prior."""

HELD_DEVIATION = 1e-3
"""Numerical: factor on the prior standard deviation of a clipped coordinate, which keeps it at its bound."""

QUANTILE = 1.645
"""Numerical: half width of a 90 % interval in standard deviations."""

CONVERGED = 8.0
"""Numerical: decrease of -2 log posterior in one step below which a fit has converged."""


@dataclass(frozen=True, eq=False)
class LocalOptimum:
    """Result of the baseline fit from one start.

    Attributes:
        coordinates: fitted parameters, with the forms of the laws.
        point: fitted values, ``[coordinate]``.
        gain: -2 log evidence of the first start minus that of this start.
    """

    coordinates: Coordinates
    point: np.ndarray
    gain: float


@dataclass(frozen=True, eq=False)
class Baseline:
    """A fitted baseline.

    Attributes:
        linear: linearisation about the fitted point, or about the point before clipping.
        fit: posterior of the linear model without candidates.
        other_optima: results of the other starts.
    """

    linear: Linearisation
    fit: Posterior
    other_optima: tuple[LocalOptimum, ...] = ()

    @property
    def coordinates(self) -> Coordinates:
        """The fitted parameters."""
        return self.linear.coordinates

    @property
    def point(self) -> np.ndarray:
        """Fitted values, clipped to their bounds, ``[coordinate]``."""
        return np.clip(self.linear.point, self.coordinates.low, self.coordinates.high)

    @property
    def clipped(self) -> np.ndarray:
        """Which coordinates were clipped to their bounds, ``[coordinate]``."""
        return self.point != self.linear.point

    @property
    def priors(self) -> CoefficientPriors:
        """Priors of further steps; clipped coordinates stay at their bounds."""
        priors, clipped = step_priors(self.coordinates, self.point), self.clipped
        deviation = np.where(clipped, HELD_DEVIATION, 1.0) * priors.deviation
        return replace(priors, mean=np.where(clipped, 0.0, priors.mean), deviation=deviation)

    @property
    def deviations(self) -> np.ndarray:
        """Posterior standard deviations, ``[coordinate]``."""
        return np.sqrt(np.diag(self.fit.covariance))

    @property
    def model(self) -> RobotModel:
        """The fitted model."""
        return model_at(self.coordinates, self.point)


def step_priors(coordinates: Coordinates, point: np.ndarray) -> CoefficientPriors:
    """Priors of the coordinates, expressed as steps from a point."""
    lower, upper = coordinates.low - point, coordinates.high - point
    return CoefficientPriors(coordinates.prior - point, coordinates.deviation_at(point), lower=lower, upper=upper)


def within_sound_spread(reduction: Reduction, base: Baseline) -> Baseline:
    """The baseline with the deviations of every servo clipped to the spread of a sound robot.

    The residual is updated to first order and the variances are kept: near a sticking joint no linearisation predicts
    the effect of the clipped difference, and new variances would treat all of it as noise.
    """
    coordinates = with_sound_spread(base.coordinates, reduction.settings)
    step = np.clip(base.point, coordinates.low, coordinates.high) - base.point
    columns = np.moveaxis(base.linear.jacobian, 0, 1)
    change = np.stack([np.tensordot(step, reduction.clipped(of_joint), 1) for of_joint in columns])
    linear = replace(base.linear, coordinates=coordinates, residual=base.linear.residual - change.astype(np.float32))
    priors = Baseline(linear, base.fit).priors
    judge = Judge(reduction.rows(linear), priors, reduction.settings)
    return Baseline(linear, judge.fit(variances=base.fit.variances, rounds=0 if step.any() else 4))


def evidence_gain(reduction: Reduction, base: Baseline, other: Baseline) -> float:
    """-2 log evidence of one baseline minus that of another, averaged over both baselines' reductions.

    Each baseline keeps its own variances, because the weights of the other would hide its misfit. It also keeps the
    Jacobian of the reduction, which has little influence at an optimum.
    """
    gain = 0.0
    for reference in (base, other):
        rows = reduction.rows(reference.linear)
        for fitted, sign in ((base, -1.0), (other, 1.0)):
            linear = fitted.linear
            if fitted is not reference:
                linear = reduction.linearise(fitted.coordinates, fitted.point, reference.linear, reference.linear)
            priors = step_priors(fitted.coordinates, fitted.point)
            judge = Judge(reduction.rows(linear, (), rows), priors, reduction.settings)
            gain += sign * judge.fit(variances=fitted.fit.variances).evidence
    return gain


def unfitted(reduction: Reduction, model: RobotModel) -> Baseline:
    """The given model as an unfitted baseline, for logs that it simulated itself."""
    coordinates = base_coordinates(with_chain(model), reduction.engine.joints, reduction.moving)
    parameters = model.parameters()
    values = [
        model.value(e.parameter) if e.kind == "value" and e.parameter in parameters else e.start
        for e in coordinates.entries
    ]
    return gauss_newton(reduction, coordinates, np.array(values), steps=0)


def gauss_newton(
    reduction: Reduction,
    coordinates: Coordinates,
    point: np.ndarray,
    steps: int = STEPS,
    variances: Variances | None = None,
    reference: Linearisation | None = None,
) -> Baseline:
    """Fit coordinates from a point until convergence.

    Args:
        reduction: windows of the fitted runs.
        coordinates: the fitted parameters.
        point: initial values, ``[coordinate]``.
        steps: largest number of steps.
        variances: initial variances.
        reference: linearisation whose reduction is used, which makes evidences comparable. Its Jacobian of the shared
            coordinates is used too, with little influence at an optimum.
    """
    point, linear = np.clip(point, coordinates.low, coordinates.high), None
    number, done = 0, steps == 0
    while True:
        previous = linear if done else None
        linear = reduction.linearise(
            coordinates, point, reference if done else reference or linear, previous or reference
        )
        judge = Judge(reduction.rows(linear), step_priors(coordinates, point), reduction.settings)
        fit = judge.fit(variances=variances, rounds=4 if number == 0 else 3)
        variances = fit.variances
        if done:
            return Baseline(linear, fit)
        costs_at = partial(posterior_costs, reduction, judge, fit, linear, coordinates)
        costs, points = costs_at(point + np.vstack([np.zeros(len(point)), damped_steps(fit, judge.priors)]))
        lowest, point = costs.min(), points[costs.argmin()]
        if len(steps_of_size := size_steps(coordinates)):
            size_costs, points = costs_at(point + steps_of_size)
            if size_costs.min() < lowest:
                lowest, point = size_costs.min(), points[size_costs.argmin()]
        number += 1
        done = number == steps or costs[0] - lowest < CONVERGED


def refitted_in_bounds(reduction: Reduction, base: Baseline) -> Baseline:
    """The baseline refitted from its clipped point, to adapt the other coordinates to the clipped ones."""
    fitted = gauss_newton(reduction, base.coordinates, base.point, variances=base.fit.variances)
    return replace(fitted, other_optima=base.other_optima)


def damped_steps(fit: Posterior, priors: CoefficientPriors) -> np.ndarray:
    """Levenberg-Marquardt steps ``[damping, coordinate]``; coordinates that would leave their bounds are held.

    If joints stick, the steps of poorly identified coordinates are wrong; damping shortens these steps most.
    """
    gradient = fit.precision @ fit.mean
    free = np.flatnonzero(~((priors.lower >= 0) & (gradient < 0) | (priors.upper <= 0) & (gradient > 0)))
    inner, steps = fit.precision[np.ix_(free, free)], np.zeros((len(DAMPING), len(gradient)))
    for step, damping in zip(steps, DAMPING, strict=True):
        step[free] = np.linalg.solve(inner + damping * np.diag(np.diag(inner)), gradient[free])
    return steps


def size_steps(coordinates: Coordinates) -> np.ndarray:
    """Steps ``[step, coordinate]`` that change only the size of one effect: if joints stick or cross backlash,
    linearised steps in all coordinates miss the best size."""
    sizes = [i for i, entry in enumerate(coordinates.entries) if entry.kind == "add"]
    return np.concatenate([share * np.diag(coordinates.deviation)[sizes] for share in SIZE_STEPS])


def posterior_costs(
    reduction: Reduction,
    judge: Judge,
    fit: Posterior,
    linear: Linearisation,
    coordinates: Coordinates,
    points: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """-2 log posterior of points under a fit's variances, without constants, ``[point]``, and the clipped points."""
    points = np.clip(points, coordinates.low, coordinates.high)
    residuals = -reduction.rows_at(linear.reducers, coordinates, points)
    valid = np.isfinite(judge.rows.variance)
    misfits = [judge.misfit(np.where(valid, residual, 0.0).astype(np.float64), fit) for residual in residuals]
    return np.array(misfits) + coordinates.penalties(points), points


def model_at(coordinates: Coordinates, point: np.ndarray, deviation: np.ndarray | None = None) -> RobotModel:
    """The model at a point; standard deviations ``[coordinate]`` add 90 % intervals to shared parameters."""
    model, joints, values = coordinates.model, coordinates.joints, {}
    halves: dict[str, float] = {}
    for i, entry in enumerate(coordinates.entries):
        if deviation is not None and entry.kind == "value" and entry.joints is None:
            halves[entry.parameter] = QUANTILE * float(deviation[i])
    for name, value in coordinates.values(point[None]).items():
        row, half = value[0].numpy(), halves.get(name)
        shared = float(np.median(row))
        low, high = (None, None) if half is None else (shared - half, shared + half)
        by_joint = {joint: x for joint, x in zip(joints, row.tolist(), strict=False) if abs(x - shared) > 1e-12}
        by_condition = model.estimate(split_name(name)[0]).by if "@" not in name else {}
        values[name] = Estimate(shared, low, high, joints=by_joint, by=by_condition)
    return model.with_values(values)
