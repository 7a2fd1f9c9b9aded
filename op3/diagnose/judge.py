"""The statistical judge: how much more probable the logs are if one effect of the catalogue is there a lot.

A row is the torque, or the current, that a window of a joint lacks under the base model. It is modelled as

``y = B b + S a + F w + e``

with ``B b`` the base and the chain of measurement (wide priors), ``S a`` every effect of the catalogue in every place,
``F w`` what this joint does and nobody explains, integrated out (random features: Rahimi & Recht 2007), and noise ``e``
with Student's tails (scale mixture: Lange, Little & Taylor 1989). No law is exact, so every effect is always there a
little: the *spike*. A finding is one that is there a lot: the *slab*, truncated to what physics allows (spike and slab:
Mitchell & Beauchamp 1988; George & McCulloch 1993). The score of a candidate is the log evidence of its slab against
its spike, all else integrated out; variances are found by expectation-maximisation, as often for the base alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.stats import norm

from op3.diagnose.settings import SETTINGS, Settings

GRID = np.exp(np.linspace(np.log(0.02), np.log(30.0), 30))
"""Standard deviations of a joint's noise that are tried [units]."""

LIGHTEST, HEAVIEST = 1e-4, 3.0
"""Weights that a window may get."""


@dataclass(frozen=True, eq=False)
class Rows:
    """What is judged: torques and currents by joint, window and piece, the pieces as their mean and differences.

    Attributes:
        joints: names.
        kinds: of every row of a window: 0 mean torque, 1 differences of torque, 2 mean current, 3 its differences,
            ``[row]``.
        measured: what the base leaves [units], ``[joint, window, row]``.
        variance: of the sensors and of the edge of sticking, ``[joint, window, row]``; infinite where nothing is known.
        features: of the unexplained law, ``[joint, window, row, feature]``.
        columns: by joint, which numbers move it, ``[column]``.
        values: by joint, how, ``[column, window, row]``; numbers are the base's, then the candidates'.
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
    """Priors of the numbers: the base's first, then the candidates'.

    Attributes:
        mean: prior means, ``[number]``.
        spike: standard deviations of what is always there (the base's: of its prior), ``[number]``.
        slab: of a finding, ``[number]``.
        low: smallest plausible value.
        high: largest plausible value.
        place: log prior of the candidate's place.
        free: of the base's numbers, and laws that are nobody's finding.
    """

    mean: np.ndarray
    spike: np.ndarray
    slab: np.ndarray
    low: np.ndarray
    high: np.ndarray
    place: np.ndarray
    free: np.ndarray


@dataclass
class State:
    """Variances: noise ``[joint, kind]``, size of the unexplained law ``[joint]``, weights ``[torque | current, joint,
    window]``."""

    noise: np.ndarray
    law: np.ndarray
    weight: np.ndarray

    def copy(self) -> "State":
        """The same, to be changed."""
        return State(self.noise.copy(), self.law.copy(), self.weight.copy())


@dataclass(frozen=True, eq=False)
class Posterior:
    """What a fit has found: the numbers ``[number]``, their precision matrix, the evidence, and the joints' laws."""

    mean: np.ndarray
    precision: np.ndarray
    evidence: float
    laws: tuple[np.ndarray, ...]
    state: State


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
        self.counts = np.array([int((self.group == g).sum()) for g in (0, 1)])
        self.start = State(np.full((joints, 4), 0.5), np.full(joints, 0.2), np.ones((2, joints, windows)))
        self._x = [np.concatenate([rows.measured[j][None], rows.values[j]]).reshape(len(v) + 1, -1)
                   for j, v in enumerate(rows.values)]  # fmt: skip
        self._f = rows.features.reshape(joints, -1, rows.features.shape[-1])

    def variance(self, joint: int, state: State) -> np.ndarray:
        """Of every row, ``[window, row]``."""
        known = self.rows.variance[joint] + state.noise[joint, self.rows.kinds] ** 2
        return known / state.weight[self.group, joint].T

    def _gram(self, state: State) -> tuple[np.ndarray, float, list]:
        """Products of measurement and numbers under the noise, each joint's law integrated out; log determinant."""
        size, total = len(self.numbers.mean) + 1, 0.0
        gram, kept = np.zeros((size, size)), []
        for j, (x, f) in enumerate(zip(self._x, self._f, strict=True)):
            variance = self.variance(j, state).ravel()
            seen = np.isfinite(variance)
            precision = np.where(seen, 1.0 / variance, 0.0)
            weighted = f * precision[:, None]
            inner = f.T @ weighted + np.eye(f.shape[1]) / state.law[j] ** 2
            factor = linalg.cho_factor(inner, lower=True)
            across = weighted.T @ x.T
            solved = linalg.cho_solve(factor, across)
            at = np.concatenate([[0], self.rows.columns[j] + 1])
            gram[np.ix_(at, at)] += (x * precision) @ x.T - across.T @ solved
            total += np.log(variance[seen]).sum() + 2 * np.log(np.diag(factor[0])).sum()
            total += f.shape[1] * np.log(state.law[j] ** 2)
            kept.append((factor, solved))
        return gram, total, kept

    def _deviations(self, named: Sequence[int]) -> np.ndarray:
        deviation = self.numbers.spike.copy()
        deviation[list(named)] = self.numbers.slab[list(named)]
        return deviation

    def fit(self, named: Sequence[int] = (), state: State | None = None, rounds: int = 4) -> Posterior:
        """Numbers and variances with these candidates as findings, from a state on.

        Args:
            named: numbers that have the slab's prior.
            state: where expectation-maximisation starts.
            rounds: of it.
        """
        state = (state or self.start).copy()
        mean, precision = self.numbers.mean, 1.0 / self._deviations(named) ** 2
        for number in range(rounds + 1):
            gram, logdet, kept = self._gram(state)
            inner = gram[1:, 1:] + np.diag(precision)
            factor = linalg.cho_factor(inner, lower=True)
            x = linalg.cho_solve(factor, gram[1:, 0] + precision * mean)
            laws = tuple(
                solved[:, 0] - solved[:, 1:] @ x[at] for (_, solved), at in zip(kept, self.rows.columns, strict=True)
            )
            if number == rounds:
                break
            self._maximise(state, x, laws, [factor for factor, _ in kept])
        apart = x - mean
        square = gram[0, 0] - 2 * gram[1:, 0] @ x + x @ gram[1:, 1:] @ x + (apart**2 * precision).sum()
        logdet += 2 * np.log(np.diag(factor[0])).sum() - np.log(precision).sum()
        return Posterior(x, inner, -0.5 * (square + logdet) + self._hyper(state), laws, state)

    def _hyper(self, state: State) -> float:
        """Log prior of the variances."""
        s = self.settings
        result = -0.5 * (((np.log(state.noise[:, :2] / s.noise)) / s.noise_spread) ** 2).sum()
        result -= 0.5 * ((np.log(state.law / s.law) / s.law_spread) ** 2).sum()
        if not self.gaussian:
            w = state.weight
            result += ((self.tails / 2 - 1) * np.log(w) - self.tails / 2 * w).sum()
        return float(result)

    def residual(self, joint: int, x: np.ndarray, law: np.ndarray) -> np.ndarray:
        """What numbers and law leave of a joint's rows, ``[window, row]``."""
        rows = self._x[joint]
        left = rows[0] - rows[1:].T @ x[self.rows.columns[joint]] - self._f[joint] @ law
        return left.reshape(self.rows.measured.shape[1:])

    def _maximise(self, state: State, x: np.ndarray, laws: Sequence[np.ndarray], factors: Sequence) -> None:
        """New noise, weights and sizes of the laws."""
        s = self.settings
        for j, (law, factor) in enumerate(zip(laws, factors, strict=True)):
            f, known = self._f[j], self.rows.variance[j]
            spread = linalg.cho_solve(factor, np.eye(f.shape[1]))
            square = self.residual(j, x, law) ** 2 + ((f @ spread) * f).sum(1).reshape(known.shape)
            for kind in range(4):
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
                for g in (0, 1):
                    mine = self.group == g
                    distance = (square[:, mine] / whole[:, mine]).sum(1)
                    weight = (self.tails + self.counts[g] - 2) / (self.tails + distance)
                    state.weight[g, j] = np.clip(weight, LIGHTEST, HEAVIEST)
            size, prior = len(law), 1 / s.law_spread**2
            found = 0.5 * np.log((law**2 + np.diag(spread)).mean())
            state.law[j] = np.clip(np.exp((size * found + prior * np.log(s.law)) / (size + prior)), 0.01, 30.0)

    def likelihoods(self, fit: Posterior, named: Sequence[int] = ()) -> tuple[np.ndarray, np.ndarray]:
        """What the rows alone say of each number, all others integrated out: ``exp(linear a - curvature a^2 / 2)``."""
        prior = 1.0 / self._deviations(named) ** 2
        variance = np.diag(linalg.cho_solve(linalg.cho_factor(fit.precision, lower=True), np.eye(len(fit.mean))))
        curvature = np.maximum(1.0 / variance - prior, 1e-12)
        return fit.mean / variance - prior * self.numbers.mean, curvature

    def scores(self, fit: Posterior, named: Sequence[int] = ()) -> np.ndarray:
        """Log odds of slab against spike with the place's prior, ``[number]``; minus infinity for the base's."""
        n = self.numbers
        linear, curvature = self.likelihoods(fit, named)
        result = evidence(linear, curvature, 0.0, n.slab, n.low, n.high) - evidence(linear, curvature, 0.0, n.spike)
        result = result + n.place
        result[n.free] = -np.inf
        result[list(named)] = -np.inf
        return result

    def products(self, state: State) -> np.ndarray:
        """Products of the numbers' columns under the noise, every joint's law integrated out, ``[number, number]``."""
        return self._gram(state)[0][1:, 1:]

    def misfit(self, measured: np.ndarray, fit: Posterior) -> float:
        """Minus two log likelihood (but for constants) of other rows under a fit's variances, laws integrated out.

        Args:
            measured: ``[joint, window, row]``.
            fit: whose variances hold.
        """
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
    return result + _log_mass(low, high, at, np.sqrt(variance)) - _log_mass(low, high, mean, deviation)


def _log_mass(low, high, mean, deviation) -> np.ndarray:
    """Log of a normal's mass between two ends, accurate in the tails."""
    a, b = (low - mean) / deviation, (high - mean) / deviation
    a, b = np.where(a > 0, -b, a), np.where(a > 0, -a, b)
    upper, lower = norm.logcdf(b), norm.logcdf(a)
    return upper + np.log1p(-np.exp(np.minimum(lower - upper, -1e-12)))
