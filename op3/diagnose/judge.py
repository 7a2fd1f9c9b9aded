"""The linear model of the residuals and the evidence of every candidate in it.

The rows of a joint (unmodelled torque, current, reported velocity, by window) are modelled as

``y = B b + S a + F w + e``

with ``B b`` the parameters of the baseline and of the measurement chain (wide priors), ``S a`` every effect of the
catalogue in every set of joints, ``F w`` the joint's unmodelled torque, integrated out (random features: Rahimi and
Recht 2007), and Student noise ``e`` (scale mixture: Lange, Little & Taylor 1989). No law is exact, so the prior of
every effect allows a small amplitude: the *spike*. The prior of a finding adds a large amplitude: the *slab*, truncated
to the physical range (spike and slab: Mitchell & Beauchamp 1988; George & McCulloch 1993). The score of a candidate is
the log evidence ratio of slab and spike, with all other unknowns integrated out. Variances are estimated by
expectation-maximisation without any candidate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy import linalg
from scipy.stats import norm

from op3.diagnose.judge_settings import SETTINGS, Settings

NOISE_GRID = np.exp(np.linspace(np.log(0.02), np.log(30.0), 30))
"""Numerical: standard deviations of a joint's noise that are compared [torque units]."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Residuals of torque, current and rate by joint and window, as the mean and the differences of the pieces.

    Attributes:
        joints: names.
        kinds: kind of every row of a window: 0 mean torque, 1 differences of torque, 2 mean current, 3 its differences,
            4 mean of reported velocity minus rate of the angle, 5 its differences, ``[row]``.
        residual: residual of the baseline [torque units], ``[joint, window, row]``.
        variance: variance of the sensors and of windows on the edge of sticking, ``[joint, window, row]``; infinite
            where nothing was measured.
        features: features of the unmodelled torque, ``[joint, window, row, feature]``.
        coefficients: indices of the coefficients that affect the rows of each joint, ``[coefficient]``.
        design: columns of these coefficients, ``[coefficient, window, row]``. Coefficients are the baseline's, then
            those of the elementary candidates (of one joint or of all).
    """

    joints: tuple[str, ...]
    kinds: np.ndarray
    residual: np.ndarray
    variance: np.ndarray
    features: np.ndarray
    coefficients: tuple[np.ndarray, ...]
    design: tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class CoefficientPriors:
    """Priors of the coefficients, and the candidates that are sums of them.

    Attributes:
        mean: prior means, ``[coefficient]``.
        deviation: prior standard deviations; the spike for a candidate's coefficient, ``[coefficient]``.
        members: coefficients of each candidate: one, or one per joint for a pair or a side.
        slab: standard deviation of the slab, ``[candidate]``.
        low: smallest plausible size, ``[candidate]``.
        high: largest plausible size, ``[candidate]``.
        log_prior: log prior of the candidate's hypothesis, ``[candidate]``.
        lower: lower bounds, ``[coefficient]``.
        upper: upper bounds, ``[coefficient]``.
    """

    mean: np.ndarray
    deviation: np.ndarray
    members: tuple[tuple[int, ...], ...] = ()
    slab: np.ndarray = field(default_factory=lambda: np.zeros(0))
    low: np.ndarray = field(default_factory=lambda: np.zeros(0))
    high: np.ndarray = field(default_factory=lambda: np.zeros(0))
    log_prior: np.ndarray = field(default_factory=lambda: np.zeros(0))
    lower: np.ndarray = field(default_factory=lambda: np.array(-np.inf))
    upper: np.ndarray = field(default_factory=lambda: np.array(np.inf))


@dataclass
class Variances:
    """Noise ``[joint, kind]``, scale of the unmodelled torque ``[joint]``, and weights of Student's noise ``[torque |
    current | rate, joint, window]``."""

    noise: np.ndarray
    unmodelled: np.ndarray
    weight: np.ndarray

    def copy(self) -> "Variances":
        """A copy that can be modified."""
        return Variances(self.noise.copy(), self.unmodelled.copy(), self.weight.copy())


@dataclass(frozen=True, eq=False)
class Posterior:
    """The posterior of a linear fit.

    Attributes:
        mean: posterior mean of the coefficients, followed by the slab sizes of the named candidates.
        precision: joint precision matrix of both.
        evidence: log evidence of the rows.
        feature_weights: weights of the features of the unmodelled torque of each joint, ``[feature]``.
        variances: estimated variances.
    """

    mean: np.ndarray
    precision: np.ndarray
    evidence: float
    feature_weights: tuple[np.ndarray, ...]
    variances: Variances

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the coefficients and the named candidates."""
        factor = linalg.cho_factor(self.precision, lower=True, check_finite=False)
        return linalg.cho_solve(factor, np.eye(len(self.precision)), overwrite_b=True, check_finite=False)


class Judge:
    """Linear fits of rows and the evidence of candidates.

    Args:
        rows: residuals and design.
        priors: priors of the coefficients.
        settings: tuned constants.
        gaussian: whether the noise is Gaussian, so that outliers have full weight.
    """

    def __init__(self, rows: Rows, priors: CoefficientPriors, settings: Settings = SETTINGS, gaussian: bool = False):
        self.rows, self.priors, self.settings, self.gaussian = rows, priors, settings, gaussian
        joints, windows, _ = rows.residual.shape
        self.tails = np.inf if gaussian else settings.tails
        self.group = rows.kinds // 2
        self.counts = np.bincount(self.group)
        groups = len(self.counts)
        self.start = Variances(
            np.full((joints, 2 * groups), 0.5), np.full(joints, 0.2), np.ones((groups, joints, windows))
        )
        self._features = rows.features.reshape(joints, -1, rows.features.shape[-1])
        self._start_gram: tuple[Variances, tuple] | None = None
        lower, upper = (np.broadcast_to(bound, priors.mean.shape) for bound in (priors.lower, priors.upper))
        self._bounded = np.flatnonzero(np.isfinite(lower) | np.isfinite(upper))
        self._bounds = lower[self._bounded], upper[self._bounded]

    def variance(self, joint: int, variances: Variances) -> np.ndarray:
        """Variance of a joint's rows, ``[window, row]``."""
        total = self.rows.variance[joint] + variances.noise[joint, self.rows.kinds] ** 2
        return total / variances.weight[self.group, joint].T

    def _gram(self, variances: Variances) -> tuple[np.ndarray, float, list]:
        """Whitened products of residual and design without unmodelled torque, -2 log determinant, factors."""
        size, logdet = len(self.priors.mean) + 1, 0.0
        gram, factors = np.zeros((size, size)), []
        for j, f in enumerate(self._features):
            design = self.rows.design[j]
            x = np.concatenate([self.rows.residual[j].ravel()[None], design.reshape(len(design), f.shape[0])])
            variance = self.variance(j, variances).ravel()
            valid = np.isfinite(variance)
            root = np.sqrt(np.where(valid, 1.0 / variance, 0.0))
            whitened, features = x * root, f * root[:, None]
            factor = np.linalg.cholesky(features.T @ features + np.eye(f.shape[1]) / variances.unmodelled[j] ** 2)
            half = linalg.solve_triangular(factor, features.T @ whitened.T, lower=True, check_finite=False)
            columns = np.concatenate([[0], self.rows.coefficients[j] + 1])
            gram[np.ix_(columns, columns)] += whitened @ whitened.T - half.T @ half
            logdet += np.log(variance[valid]).sum() + 2 * np.log(np.diag(factor)).sum()
            logdet += f.shape[1] * np.log(variances.unmodelled[j] ** 2)
            factors.append((factor, half))
        return gram, logdet, factors

    def membership(self, named: Sequence[int]) -> np.ndarray:
        """Which coefficients each candidate changes, ``[coefficient, candidate]``."""
        matrix = np.zeros((len(self.priors.mean), len(named)))
        for column, candidate in enumerate(named):
            matrix[list(self.priors.members[candidate]), column] = 1.0
        return matrix

    def fit(self, named: Sequence[int] = (), variances: Variances | None = None, rounds: int = 4) -> Posterior:
        """Posterior of the coefficients and estimates of the variances by expectation-maximisation.

        Args:
            named: candidates that have a slab in addition to their spikes.
            variances: initial variances.
            rounds: number of rounds of expectation-maximisation.
        """
        priors, membership, start = self.priors, self.membership(named), variances or self.start
        variances = start.copy()
        mean = np.concatenate([priors.mean, np.zeros(len(named))])
        precision = 1.0 / np.concatenate([priors.deviation, priors.slab[list(named)]]) ** 2
        for number in range(rounds + 1):
            if number == 0:  # fits of many candidates start from the same variances
                if self._start_gram is None or self._start_gram[0] is not start:
                    self._start_gram = start, self._gram(start)
                gram, logdet, factors = self._start_gram[1]
            else:
                gram, logdet, factors = self._gram(variances)
            across = gram[:, 1:] @ membership
            products = np.block([[gram[1:, 1:], across[1:]], [across[1:].T, membership.T @ across[1:]]])
            linear = np.concatenate([gram[1:, 0], across[0]])
            products[np.diag_indices_from(products)] += precision
            factor = linalg.cho_factor(products, lower=True, check_finite=False)
            x = linalg.cho_solve(factor, linear + precision * mean, check_finite=False)
            amplitudes = x[: len(priors.mean)] + membership @ x[len(priors.mean) :]
            weights = tuple(
                linalg.solve_triangular(triangle, half[:, 0] - half[:, 1:] @ amplitudes[columns], trans=1, lower=True)
                for (triangle, half), columns in zip(factors, self.rows.coefficients, strict=True)
            )
            if number == rounds:
                break
            self._maximise(variances, amplitudes, weights, [triangle for triangle, _ in factors])
        # -2 log likelihood and prior at the maximum, where the linear term enters once
        square = gram[0, 0] + (mean**2 * precision).sum() - (linear + precision * mean) @ x
        logdet += 2 * np.log(np.diag(factor[0])).sum() - np.log(precision).sum()
        unit = np.eye(len(x))[:, self._bounded]
        deviation = np.linalg.norm(linalg.solve_triangular(factor[0], unit, lower=True, check_finite=False), axis=0)
        in_bounds = float(log_mass(*self._bounds, x[self._bounded], deviation).sum())
        evidence = -0.5 * (square + logdet) + in_bounds + self._variance_prior(variances)
        return Posterior(x, products, evidence, weights, variances)

    def _variance_prior(self, variances: Variances) -> float:
        """Log prior of the variances."""
        s = self.settings
        result = -0.5 * (((np.log(variances.noise[:, :2] / s.noise)) / s.noise_spread) ** 2).sum()
        result -= 0.5 * ((np.log(variances.unmodelled / s.unmodelled) / s.unmodelled_spread) ** 2).sum()
        if not self.gaussian:
            w = variances.weight
            result += ((self.tails / 2 - 1) * np.log(w) - self.tails / 2 * w).sum()
        return float(result)

    def residual(self, joint: int, x: np.ndarray, feature_weights: np.ndarray) -> np.ndarray:
        """Residual of a joint's rows after subtracting coefficients ``x`` and unmodelled torque, ``[window, row]``."""
        predicted = np.tensordot(x[self.rows.coefficients[joint]], self.rows.design[joint], 1)
        return self.rows.residual[joint] - predicted - self.rows.features[joint] @ feature_weights

    def _maximise(self, variances: Variances, x: np.ndarray, weights: Sequence[np.ndarray], factors: Sequence) -> None:
        """The maximisation step: noise, Student weights and scales of the unmodelled torque."""
        s = self.settings
        for j, (feature_weights, factor) in enumerate(zip(weights, factors, strict=True)):
            f, sensor_variance = self._features[j], self.rows.variance[j]
            inverse = linalg.solve_triangular(factor, np.eye(f.shape[1]), lower=True)
            square = self.residual(j, x, feature_weights) ** 2
            square = square + np.square(f @ inverse.T).sum(1).reshape(sensor_variance.shape)
            for kind in range(variances.noise.shape[1]):
                rows = self.rows.kinds == kind
                weight = variances.weight[kind // 2, j][:, None]
                valid = np.isfinite(sensor_variance[:, rows])
                if not valid.any():
                    continue
                total = sensor_variance[:, rows][valid][:, None] + NOISE_GRID**2
                cost = (np.log(total) + (square[:, rows] * weight)[valid][:, None] / total).sum(0)
                if kind < 2:
                    cost = cost + (np.log(NOISE_GRID / s.noise) / s.noise_spread) ** 2
                variances.noise[j, kind] = NOISE_GRID[cost.argmin()]
            if not self.gaussian:
                total = sensor_variance + variances.noise[j, self.rows.kinds] ** 2
                for g in range(len(self.counts)):
                    rows = self.group == g
                    distance = (square[:, rows] / total[:, rows]).sum(1)
                    variances.weight[g, j] = (self.tails + self.counts[g] - 2) / (self.tails + distance)
            size, prior = len(feature_weights), 1 / s.unmodelled_spread**2
            log_scale = 0.5 * np.log((feature_weights**2 + np.square(inverse).sum(0)).mean())
            scale = np.exp((size * log_scale + prior * np.log(s.unmodelled)) / (size + prior))
            variances.unmodelled[j] = np.clip(scale, 0.01, 30.0)

    def likelihood_terms(self, fit: Posterior) -> tuple[np.ndarray, np.ndarray]:
        """Linear term and curvature of the log likelihood in each candidate's slab amplitude, with all other unknowns
        integrated out, ``[candidate]``."""
        size, prior = len(self.priors.mean), 1.0 / self.priors.deviation**2
        covariance = fit.covariance[:size, :size]
        information = np.diag(prior) - prior[:, None] * covariance * prior
        linear = prior * (fit.mean[:size] - self.priors.mean)
        curvature = [information[np.ix_(member, member)].sum() for member in map(list, self.priors.members)]
        return np.array([linear[list(m)].sum() for m in self.priors.members]), np.maximum(curvature, 1e-12)

    def scores(self, fit: Posterior) -> np.ndarray:
        """Log odds of slab and spike against spike alone, including the prior of the hypothesis, ``[candidate]``."""
        p = self.priors
        linear, curvature = self.likelihood_terms(fit)
        slab = evidence(linear, curvature, 0.0, p.slab, p.low, p.high) + p.log_prior
        return slab + self._bounds_evidence(fit, linear, curvature)

    def _bounds_evidence(self, fit: Posterior, linear: np.ndarray, curvature: np.ndarray) -> np.ndarray:
        """Log ratio of the probabilities, with and without each candidate, that the baseline's parameters are within
        their bounds, ``[candidate]``."""
        p, bounded = self.priors, self._bounded
        mean, covariance = fit.mean[bounded, None], fit.covariance[bounded, : len(p.mean)]
        square, lower, upper = covariance[np.arange(len(bounded)), bounded, None], *(b[:, None] for b in self._bounds)
        variance = 1.0 / (curvature + 1.0 / p.slab**2)
        slope = (covariance / p.deviation**2) @ self.membership(range(len(p.members)))
        shifted = mean + slope * np.clip(linear * variance, p.low, p.high)
        with_candidate = log_mass(lower, upper, shifted, np.sqrt(square + slope**2 * variance))
        return (with_candidate - log_mass(lower, upper, mean, np.sqrt(square))).sum(0)

    def gram(self, variances: Variances) -> np.ndarray:
        """Whitened products of the design with unmodelled torque integrated out, ``[coefficient, coefficient]``."""
        return self._gram(variances)[0][1:, 1:]

    def misfit(self, residual: np.ndarray, fit: Posterior) -> float:
        """-2 log likelihood without constants of new residuals ``[joint, window, row]`` under a fit's variances."""
        total = 0.0
        for j, f in enumerate(self._features):
            variance = self.variance(j, fit.variances).ravel()
            precision = np.where(np.isfinite(variance), 1.0 / variance, 0.0)
            y = residual[j].ravel()
            inner = f.T @ (f * precision[:, None]) + np.eye(f.shape[1]) / fit.variances.unmodelled[j] ** 2
            across = f.T @ (precision * y)
            total += float(y @ (precision * y) - across @ linalg.solve(inner, across, assume_a="pos"))
        return total


def evidence(
    linear: np.ndarray,
    curvature: np.ndarray,
    mean: np.ndarray | float,
    deviation: np.ndarray,
    low: np.ndarray | float = -np.inf,
    high: np.ndarray | float = np.inf,
) -> np.ndarray:
    """Log of the mean of ``exp(linear a - curvature a^2 / 2)`` over a normal prior truncated to ``[low, high]``."""
    precision = 1.0 / deviation**2
    variance = 1.0 / (curvature + precision)
    posterior_mean = variance * (linear + precision * mean)
    result = 0.5 * (posterior_mean**2 / variance - precision * mean**2) + 0.5 * np.log(precision * variance)
    return result + log_mass(low, high, posterior_mean, np.sqrt(variance)) - log_mass(low, high, mean, deviation)


def log_mass(low, high, mean, deviation) -> np.ndarray:
    """Log probability of an interval under a normal distribution, accurate in the tails."""
    a, b = (low - mean) / deviation, (high - mean) / deviation
    a, b = np.where(a > 0, -b, a), np.where(a > 0, -a, b)
    upper, lower = norm.logcdf(b), norm.logcdf(a)
    return upper + np.log1p(-np.exp(np.minimum(lower - upper, -1e-12)))
