"""Held-out log density: how well a model predicts windows of runs to which it was not fitted.

Runs are left out in turn. The parameters are estimated from the other runs by one Gauss-Newton step, the windows of the
left-out run are simulated at the posterior mean and at posterior draws, and the density of their residuals is averaged
over the draws (Geisser 1975; Vehtari, Gelman & Gabry 2017); with the mean alone, one joint that barely sticks in one
window would dominate the result of a run. The density is that of the linear model, with Student noise, unmodelled
torque integrated out, and variances from the other runs. Runs are independent but windows of one run are not, so the
standard error of the difference between two models is computed over runs.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg
from scipy.special import logsumexp
from scipy.stats import norm, t

from op3.diagnose.base import Baseline, step_priors
from op3.diagnose.judge import Judge, Rows, Variances
from op3.diagnose.reduction import Reduction
from op3.diagnose.split import FEWEST_RUNS

FOLDS, BLOCKS = 6, 8
"""Budget: groups in which runs are left out, and blocks of time left out if there are fewer than `FEWEST_RUNS` runs."""

DRAWS, ROUNDS = 3, 3
"""Budget: posterior draws in addition to the mean, and rounds that estimate the Student weights of left-out windows."""


@dataclass(frozen=True)
class Gain:
    """Difference between the held-out log densities of two models, per run.

    Attributes:
        mean: mean over runs [nat].
        error: standard error of the mean.
        z: mean in standard errors, converted from Student's distribution to the normal one with the same probability.
        runs: number of runs.
    """

    mean: float
    error: float
    z: float
    runs: int

    @classmethod
    def of(cls, density: np.ndarray, reference: np.ndarray) -> "Gain":
        """The gain of one model over another, from log densities ``[run, joint]``."""
        difference = (density - reference).sum(1)
        count, mean = len(difference), float(difference.mean())
        error = float(difference.std(ddof=1) / np.sqrt(count))
        if error < 1e-12:
            return cls(mean, error, 0.0 if abs(mean) < 1e-12 else float(np.sign(mean)) * 10.0, count)
        z = float(np.clip(-norm.ppf(t.sf(abs(mean) / error, count - 1)), 0.0, 10.0)) * float(np.sign(mean))
        return cls(mean, error, z, count)


class HeldOut:
    """Cross-validation over runs.

    Args:
        reduction: windows of all fitted runs.

    Attributes:
        runs: run, or block of time, of each window, ``[window]``.
        in_time: whether blocks of time are left out instead of runs.
    """

    def __init__(self, reduction: Reduction):
        self.reduction = reduction
        logs = np.array([log for log, _ in reduction.engine.windows])
        self.in_time = len(np.unique(logs)) < FEWEST_RUNS
        if self.in_time:  # windows are ordered by log and time
            self.runs = np.arange(len(logs)) * min(BLOCKS, len(logs)) // len(logs)
        else:
            self.runs = np.unique(logs, return_inverse=True)[1]
        self.count = int(self.runs.max()) + 1
        folds = min(FOLDS, self.count)
        self._folds = [np.isin(self.runs, np.arange(fold, self.count, folds)) for fold in range(folds)]

    def density(self, base: Baseline, reference: Rows) -> np.ndarray:
        """Held-out log densities of a fitted model, ``[run, joint]``, with the reference's sensor and edge
        variances."""
        reduction, point, coordinates = self.reduction, base.point, base.coordinates
        rows = reduction.rows(base.linear, (), reference)
        priors, variances = step_priors(coordinates, point), base.fit.variances
        step = Judge(rows, priors, reduction.settings).fit(variances=variances, rounds=0).mean
        points, rng = [], np.random.default_rng(0)
        for left_out in self._folds:
            judge = Judge(_select(rows, ~left_out), priors, reduction.settings)
            weight = variances.weight[:, :, ~left_out]
            fit = judge.fit(variances=Variances(variances.noise, variances.unmodelled, weight), rounds=0)
            draws = rng.multivariate_normal(np.zeros(len(point)), fit.covariance, DRAWS, method="cholesky")
            points += [
                np.clip(point + fit.mean - step + draw, coordinates.low, coordinates.high) for draw in (0.0, *draws)
            ]
        residuals = -reduction.rows_at(base.linear.reducers, coordinates, np.array(points))
        density = np.zeros((self.count, len(rows.joints)))
        residuals = residuals.reshape(-1, DRAWS + 1, *residuals.shape[1:])
        for of_fold, left_out in zip(residuals, self._folds, strict=True):
            for run in np.unique(self.runs[left_out]):
                windows = self.runs == run
                for j in range(len(rows.joints)):
                    noise, unmodelled = variances.noise[j], variances.unmodelled[j]
                    of_joint = rows.variance[j, windows], rows.features[j, windows], rows.kinds, noise, unmodelled
                    tails = reduction.settings.tails
                    draws = [log_density(residual[j, windows], *of_joint, tails) for residual in of_fold]
                    density[run, j] = logsumexp(draws) - np.log(len(draws))
        return density


def _select(rows: Rows, windows: np.ndarray) -> Rows:
    """Rows of some windows."""
    design = tuple(columns[:, windows] for columns in rows.design)
    parts = {name: getattr(rows, name)[:, windows] for name in ("residual", "variance", "features")}
    return replace(rows, **parts, design=design)


def log_density(
    residual: np.ndarray,
    variance: np.ndarray,
    features: np.ndarray,
    kinds: np.ndarray,
    noise: np.ndarray,
    unmodelled: float,
    tails: float,
) -> float:
    """Log density, without constants, of a joint's residuals.

    Args:
        residual: ``[window, row]``.
        variance: variance of sensors and of sticking, ``[window, row]``; infinite where not measured.
        features: features of the unmodelled torque, ``[window, row, feature]``.
        kinds: kinds of the rows, as in `Rows`.
        noise: standard deviations by kind.
        unmodelled: scale of the unmodelled torque.
        tails: degrees of freedom of Student's noise.
    """
    total = variance + noise[kinds] ** 2
    valid = np.isfinite(total)
    if not valid.any():
        return 0.0
    y, f = np.where(valid, residual, 0.0).ravel().astype(np.float64), features.reshape(residual.size, -1)
    group = kinds // 2
    weight = np.ones((len(residual), int(group.max()) + 1))
    counts = np.stack([valid[:, group == g].sum(1) for g in range(weight.shape[1])], 1)

    def factorised() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Precisions, Cholesky factor of the feature weights' precision, and whitened right-hand side."""
        precision = np.where(valid, weight[:, group] / total, 0.0).ravel()
        factor = np.linalg.cholesky(f.T @ (f * precision[:, None]) + np.eye(f.shape[1]) / unmodelled**2)
        half = linalg.solve_triangular(factor, f.T @ (precision * y), lower=True, check_finite=False)
        return precision, factor, half

    for _ in range(ROUNDS):
        _, factor, half = factorised()
        spread = linalg.solve_triangular(factor, f.T, lower=True, check_finite=False)
        square = (np.square(y - spread.T @ half) + np.square(spread).sum(0)).reshape(residual.shape)
        distance = np.where(valid, square / total, 0.0)
        for g in range(weight.shape[1]):
            weight[:, g] = (tails + counts[:, g] - 2) / (tails + distance[:, group == g].sum(1))
    precision, factor, half = factorised()
    positive = precision[precision > 0]
    density = np.log(positive).sum() - 2 * np.log(np.diag(factor)).sum() - 2 * f.shape[1] * np.log(unmodelled)
    density -= float(y @ (precision * y) - half @ half)
    density += 2 * ((tails / 2 - 1) * np.log(weight) - tails / 2 * weight)[counts > 0].sum()
    return 0.5 * float(density)
