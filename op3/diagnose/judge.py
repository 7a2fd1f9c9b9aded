"""The statistical judge: how much more probable the logs are if one effect of the catalogue is there a lot.

A row is the torque, the current or the reported velocity that a window of a joint lacks under the base model, modelled
as

``y = B b + S a + F w + e``

with ``B b`` the base and the chain of measurement (wide priors), ``S a`` every effect of the catalogue in every place,
``F w`` what this joint does and nobody explains, integrated out (random features: Rahimi & Recht 2007), and noise ``e``
with Student's tails (scale mixture: Lange, Little & Taylor 1989). No law is exact, so every effect is always there a
little: the *spike*. A finding is one that is there a lot: the *slab*, truncated to what physics allows (spike and slab:
Mitchell & Beauchamp 1988; George & McCulloch 1993). The score of a candidate is the log evidence of its slab against
its spike, all else integrated out; variances are found by expectation-maximisation, as often for the base alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy import linalg
from scipy.stats import norm

from op3.diagnose.judge_settings import SETTINGS, Settings

GRID = np.exp(np.linspace(np.log(0.02), np.log(30.0), 30))
"""Standard deviations of a joint's noise that are tried [units]."""


@dataclass(frozen=True, eq=False)
class Rows:
    """What is judged: torques, currents and rates by joint, window and piece, the pieces as their mean and differences.

    Attributes:
        joints: names.
        kinds: of every row of a window: 0 mean torque, 1 differences of torque, 2 mean current, 3 its differences,
            4 mean of the reported velocity beyond the angle's rate, 5 its differences, ``[row]``.
        measured: what the base leaves [units], ``[joint, window, row]``.
        variance: of the sensors and of the edge of sticking, ``[joint, window, row]``; infinite where nothing is known.
        features: of the unexplained law, ``[joint, window, row, feature]``.
        columns: by joint, which numbers move it, ``[column]``.
        values: by joint, how, ``[column, window, row]``; numbers are the base's, then the candidates' that sit in one
            joint or in all.
    """

    joints: tuple[str, ...]
    kinds: np.ndarray
    measured: np.ndarray
    variance: np.ndarray
    features: np.ndarray
    columns: tuple[np.ndarray, ...]
    values: tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class Numbers:
    """Priors of the numbers, and the candidates that are made of them.

    Attributes:
        mean: prior means, ``[number]``.
        deviation: prior standard deviations; of what is no base's number, its spike, ``[number]``.
        members: numbers of which a candidate is the sum: one, or of a pair or a side one of each joint.
        slab: standard deviation of a finding, ``[candidate]``.
        low: smallest plausible size, ``[candidate]``.
        high: largest plausible size, ``[candidate]``.
        place: log prior of the candidate's place, ``[candidate]``.
        least: smallest values that numbers may have, ``[number]``.
        most: largest ones, ``[number]``.
    """

    mean: np.ndarray
    deviation: np.ndarray
    members: tuple[tuple[int, ...], ...] = ()
    slab: np.ndarray = field(default_factory=lambda: np.zeros(0))
    low: np.ndarray = field(default_factory=lambda: np.zeros(0))
    high: np.ndarray = field(default_factory=lambda: np.zeros(0))
    place: np.ndarray = field(default_factory=lambda: np.zeros(0))
    least: np.ndarray = field(default_factory=lambda: np.array(-np.inf))
    most: np.ndarray = field(default_factory=lambda: np.array(np.inf))


@dataclass
class Variances:
    """Variances: noise ``[joint, kind]``, size of the unexplained law ``[joint]``, weights ``[torque | current | rate,
    joint, window]``."""

    noise: np.ndarray
    law: np.ndarray
    weight: np.ndarray

    def copy(self) -> "Variances":
        """The same, to be changed."""
        return Variances(self.noise.copy(), self.law.copy(), self.weight.copy())


@dataclass(frozen=True, eq=False)
class Posterior:
    """What a fit has found.

    Attributes:
        mean: the numbers, and behind them the named candidates' sizes.
        precision: matrix of both.
        evidence: log probability of the rows.
        laws: what each joint does and nobody explains, by feature.
        state: the variances.
    """

    mean: np.ndarray
    precision: np.ndarray
    evidence: float
    laws: tuple[np.ndarray, ...]
    state: Variances

    @cached_property
    def covariance(self) -> np.ndarray:
        """Of numbers and named candidates."""
        factor = linalg.cho_factor(self.precision, lower=True, check_finite=False)
        return linalg.cho_solve(factor, np.eye(len(self.precision)), overwrite_b=True, check_finite=False)


class Judge:
    """Evidence for effects in rows.

    Args:
        rows: that are judged.
        numbers: priors of their columns.
        settings: tuned constants.
        gaussian: whether a wild window counts in full.
    """

    def __init__(self, rows: Rows, numbers: Numbers, settings: Settings = SETTINGS, gaussian: bool = False):
        self.rows, self.numbers, self.settings, self.gaussian = rows, numbers, settings, gaussian
        joints, windows, _ = rows.measured.shape
        self.tails = np.inf if gaussian else settings.tails
        self.group = rows.kinds // 2
        self.counts = np.bincount(self.group)
        groups = len(self.counts)
        self.start = Variances(
            np.full((joints, 2 * groups), 0.5), np.full(joints, 0.2), np.ones((groups, joints, windows))
        )
        self._f = rows.features.reshape(joints, -1, rows.features.shape[-1])
        self._kept: tuple[Variances, tuple] | None = None
        least, most = (np.broadcast_to(end, numbers.mean.shape) for end in (numbers.least, numbers.most))
        self._bounded = np.flatnonzero(np.isfinite(least) | np.isfinite(most))
        self._ends = least[self._bounded], most[self._bounded]

    def variance(self, joint: int, state: Variances) -> np.ndarray:
        """Of every row, ``[window, row]``."""
        known = self.rows.variance[joint] + state.noise[joint, self.rows.kinds] ** 2
        return known / state.weight[self.group, joint].T

    def _gram(self, state: Variances) -> tuple[np.ndarray, float, list]:
        """Products of measurement and numbers under the noise, each joint's law integrated out; log determinant."""
        size, total = len(self.numbers.mean) + 1, 0.0
        gram, kept = np.zeros((size, size)), []
        for j, f in enumerate(self._f):
            values = self.rows.values[j]
            x = np.concatenate([self.rows.measured[j].ravel()[None], values.reshape(len(values), f.shape[0])])
            variance = self.variance(j, state).ravel()
            seen = np.isfinite(variance)
            root = np.sqrt(np.where(seen, 1.0 / variance, 0.0))
            scaled, features = x * root, f * root[:, None]
            factor = np.linalg.cholesky(features.T @ features + np.eye(f.shape[1]) / state.law[j] ** 2)
            half = linalg.solve_triangular(factor, features.T @ scaled.T, lower=True, check_finite=False)
            at = np.concatenate([[0], self.rows.columns[j] + 1])
            gram[np.ix_(at, at)] += scaled @ scaled.T - half.T @ half
            total += np.log(variance[seen]).sum() + 2 * np.log(np.diag(factor)).sum()
            total += f.shape[1] * np.log(state.law[j] ** 2)
            kept.append((factor, half))
        return gram, total, kept

    def sums(self, named: Sequence[int]) -> np.ndarray:
        """Which numbers candidates move, ``[number, candidate]``."""
        sums = np.zeros((len(self.numbers.mean), len(named)))
        for column, candidate in enumerate(named):
            sums[list(self.numbers.members[candidate]), column] = 1.0
        return sums

    def fit(self, named: Sequence[int] = (), state: Variances | None = None, rounds: int = 4) -> Posterior:
        """Numbers and variances by rounds of expectation-maximisation from a state on, some candidates named: there as
        much as the slab allows, beside their spikes."""
        n, sums, given = self.numbers, self.sums(named), state or self.start
        state = given.copy()
        mean = np.concatenate([n.mean, np.zeros(len(named))])
        precision = 1.0 / np.concatenate([n.deviation, n.slab[list(named)]]) ** 2
        for number in range(rounds + 1):
            if number == 0:  # fits of many candidates start from one state
                if self._kept is None or self._kept[0] is not given:
                    self._kept = given, self._gram(given)
                gram, logdet, kept = self._kept[1]
            else:
                gram, logdet, kept = self._gram(state)
            across = gram[:, 1:] @ sums
            products = np.block([[gram[1:, 1:], across[1:]], [across[1:].T, sums.T @ across[1:]]])
            linear = np.concatenate([gram[1:, 0], across[0]])
            products[np.diag_indices_from(products)] += precision
            factor = linalg.cho_factor(products, lower=True, check_finite=False)
            x = linalg.cho_solve(factor, linear + precision * mean, check_finite=False)
            felt = x[: len(n.mean)] + sums @ x[len(n.mean) :]
            laws = tuple(
                linalg.solve_triangular(triangle, half[:, 0] - half[:, 1:] @ felt[at], trans=1, lower=True)
                for (triangle, half), at in zip(kept, self.rows.columns, strict=True)
            )
            if number == rounds:
                break
            self._maximise(state, felt, laws, [triangle for triangle, _ in kept])
        # minus two log likelihood and prior at the maximum, where half of the linear part is left
        square = gram[0, 0] + (mean**2 * precision).sum() - (linear + precision * mean) @ x
        logdet += 2 * np.log(np.diag(factor[0])).sum() - np.log(precision).sum()
        picked = np.eye(len(x))[:, self._bounded]
        deviation = np.linalg.norm(linalg.solve_triangular(factor[0], picked, lower=True, check_finite=False), axis=0)
        within = float(log_mass(*self._ends, x[self._bounded], deviation).sum())
        return Posterior(x, products, -0.5 * (square + logdet) + within + self._hyper(state), laws, state)

    def _hyper(self, state: Variances) -> float:
        """Log prior of the variances."""
        s = self.settings
        result = -0.5 * (((np.log(state.noise[:, :2] / s.noise)) / s.noise_spread) ** 2).sum()
        result -= 0.5 * ((np.log(state.law / s.law) / s.law_spread) ** 2).sum()
        if not self.gaussian:
            w = state.weight
            result += ((self.tails / 2 - 1) * np.log(w) - self.tails / 2 * w).sum()
        return float(result)

    def residual(self, joint: int, x: np.ndarray, law: np.ndarray) -> np.ndarray:
        """What numbers, named candidates added to them, and law leave of a joint's rows, ``[window, row]``."""
        made = np.tensordot(x[self.rows.columns[joint]], self.rows.values[joint], 1)
        return self.rows.measured[joint] - made - self.rows.features[joint] @ law

    def _maximise(self, state: Variances, x: np.ndarray, laws: Sequence[np.ndarray], factors: Sequence) -> None:
        """New noise, weights and sizes of the laws."""
        s = self.settings
        for j, (law, factor) in enumerate(zip(laws, factors, strict=True)):
            f, known = self._f[j], self.rows.variance[j]
            inverse = linalg.solve_triangular(factor, np.eye(f.shape[1]), lower=True)
            square = self.residual(j, x, law) ** 2 + np.square(f @ inverse.T).sum(1).reshape(known.shape)
            for kind in range(state.noise.shape[1]):
                mine = self.rows.kinds == kind
                weight = state.weight[kind // 2, j][:, None]
                seen = np.isfinite(known[:, mine])
                if not seen.any():
                    continue
                tried = known[:, mine][seen][:, None] + GRID**2
                cost = (np.log(tried) + (square[:, mine] * weight)[seen][:, None] / tried).sum(0)
                if kind < 2:
                    cost = cost + (np.log(GRID / s.noise) / s.noise_spread) ** 2
                state.noise[j, kind] = GRID[cost.argmin()]
            if not self.gaussian:
                whole = known + state.noise[j, self.rows.kinds] ** 2
                for g in range(len(self.counts)):
                    mine = self.group == g
                    distance = (square[:, mine] / whole[:, mine]).sum(1)
                    state.weight[g, j] = (self.tails + self.counts[g] - 2) / (self.tails + distance)
            size, prior = len(law), 1 / s.law_spread**2
            found = 0.5 * np.log((law**2 + np.square(inverse).sum(0)).mean())
            state.law[j] = np.clip(np.exp((size * found + prior * np.log(s.law)) / (size + prior)), 0.01, 30.0)

    def of_candidates(self, fit: Posterior) -> tuple[np.ndarray, np.ndarray]:
        """What the rows say of how much more than a little there is of each candidate: linear term and curvature."""
        size, prior = len(self.numbers.mean), 1.0 / self.numbers.deviation**2
        covariance = fit.covariance[:size, :size]
        left = np.diag(prior) - prior[:, None] * covariance * prior
        linear = prior * (fit.mean[:size] - self.numbers.mean)
        curvature = [left[np.ix_(one, one)].sum() for one in map(list, self.numbers.members)]
        return np.array([linear[list(one)].sum() for one in self.numbers.members]), np.maximum(curvature, 1e-12)

    def scores(self, fit: Posterior) -> np.ndarray:
        """Log odds of slab and spike against spike alone with the place's prior, ``[candidate]``."""
        n = self.numbers
        linear, curvature = self.of_candidates(fit)
        found = evidence(linear, curvature, 0.0, n.slab, n.low, n.high) + n.place
        return found + self._room(fit, linear, curvature)

    def _room(self, fit: Posterior, linear: np.ndarray, curvature: np.ndarray) -> np.ndarray:
        """Log probability that the base is within its ranges with each candidate against without, ``[candidate]``."""
        n, at = self.numbers, self._bounded
        mean, covariance = fit.mean[at, None], fit.covariance[at, : len(n.mean)]
        square, least, most = covariance[np.arange(len(at)), at, None], *(end[:, None] for end in self._ends)
        variance = 1.0 / (curvature + 1.0 / n.slab**2)
        pull = (covariance / n.deviation**2) @ self.sums(range(len(n.members)))
        moved = mean + pull * np.clip(linear * variance, n.low, n.high)
        with_it = log_mass(least, most, moved, np.sqrt(square + pull**2 * variance))
        return (with_it - log_mass(least, most, mean, np.sqrt(square))).sum(0)

    def products(self, state: Variances) -> np.ndarray:
        """Products of the numbers' columns under the noise, every joint's law integrated out, ``[number, number]``."""
        return self._gram(state)[0][1:, 1:]

    def misfit(self, measured: np.ndarray, fit: Posterior) -> float:
        """Minus two log likelihood (but for constants) of other rows ``[joint, window, row]``, as noisy as a fit's."""
        total = 0.0
        for j, f in enumerate(self._f):
            variance = self.variance(j, fit.state).ravel()
            precision = np.where(np.isfinite(variance), 1.0 / variance, 0.0)
            y = measured[j].ravel()
            inner = f.T @ (f * precision[:, None]) + np.eye(f.shape[1]) / fit.state.law[j] ** 2
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
    """Log of ``exp(linear a - curvature a^2 / 2)`` averaged over a normal prior, truncated to ``[low, high]``."""
    precision = 1.0 / deviation**2
    variance = 1.0 / (curvature + precision)
    at = variance * (linear + precision * mean)
    result = 0.5 * (at**2 / variance - precision * mean**2) + 0.5 * np.log(precision * variance)
    return result + log_mass(low, high, at, np.sqrt(variance)) - log_mass(low, high, mean, deviation)


def log_mass(low, high, mean, deviation) -> np.ndarray:
    """Log of a normal's mass between two ends, accurate in the tails."""
    a, b = (low - mean) / deviation, (high - mean) / deviation
    a, b = np.where(a > 0, -b, a), np.where(a > 0, -a, b)
    upper, lower = norm.logcdf(b), norm.logcdf(a)
    return upper + np.log1p(-np.exp(np.minimum(lower - upper, -1e-12)))
