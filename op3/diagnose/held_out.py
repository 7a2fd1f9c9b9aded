"""How well a model predicts windows of runs that it was not fitted to: what decides names, and what the gap shows.

Runs are left out in turn. The numbers of a model are estimated from the other runs by one Gauss-Newton step from where
all runs put them, the windows of a run left out are simulated with these numbers and with draws from their posterior,
and what the model leaves of their torques, currents and rates has a log density: that of the judge, with Student's
noise and what each joint does that no effect explains integrated out, of sizes that the other runs say, averaged over
the draws (Geisser 1975; Vehtari, Gelman & Gabry 2017). With one set of numbers, a single joint that just sticks in one
window decides the gain of a run. Runs repeat an experiment and windows of one run do not, so that a gain of one model
on another has a standard error over runs.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg
from scipy.special import logsumexp
from scipy.stats import norm, t

from op3.diagnose.base import Baseline, base_numbers
from op3.diagnose.judge import Judge, Rows, Variances
from op3.diagnose.reduction import Reduction

FOLDS = 6
"""Groups in which runs are left out; more give nearly the same numbers."""

FEWEST_RUNS = 5
"""With fewer runs than these, blocks of their time are left out in turn, `BLOCKS` in all."""

BLOCKS = 8

DRAWS = 3
"""Sets of numbers drawn from the posterior, beside its mean."""

ROUNDS = 3
"""Rounds by which it is found how wild each window of a run left out is."""


@dataclass(frozen=True, eq=False)
class HeldOutScore:
    """Log densities of what a model leaves of runs that it was not fitted to, ``[run, joint]``."""

    density: np.ndarray


@dataclass(frozen=True)
class Gain:
    """By how much one model predicts the windows of a run better than another.

    Attributes:
        mean: over runs, in natural units of log density.
        error: standard error of it over runs.
        z: the mean in standard errors, as many of a normal as are as unlikely as Student's with that few runs.
        runs: how many.
    """

    mean: float
    error: float
    z: float
    runs: int

    @classmethod
    def of(cls, better: HeldOutScore, other: HeldOutScore) -> "Gain":
        """The gain of one model on another."""
        apart = (better.density - other.density).sum(1)
        count, mean = len(apart), float(apart.mean())
        error = float(apart.std(ddof=1) / np.sqrt(count))
        if error < 1e-12:
            return cls(mean, error, 0.0 if abs(mean) < 1e-12 else float(np.sign(mean)) * 10.0, count)
        z = float(np.clip(-norm.ppf(t.sf(abs(mean) / error, count - 1)), 0.0, 10.0)) * float(np.sign(mean))
        return cls(mean, error, z, count)


class HeldOut:
    """Cross-validation over the runs of windows.

    Args:
        reduction: of windows of all runs that are fitted.

    Attributes:
        runs: of every window the run, or block of time, that is left out with it, ``[window]``.
        in_time: whether blocks of time are left out in place of runs.
    """

    def __init__(self, reduction: Reduction):
        self.reduction = reduction
        logs = np.array([log for log, _ in reduction.engine.windows])
        self.in_time = len(np.unique(logs)) < FEWEST_RUNS
        if self.in_time:  # windows come in the order of the logs and of time
            self.runs = np.arange(len(logs)) * min(BLOCKS, len(logs)) // len(logs)
        else:
            self.runs = np.unique(logs, return_inverse=True)[1]
        self._folds = [np.isin(self.runs, runs) for runs in _dealt(int(self.runs.max()) + 1)]

    def score(self, base: Baseline, like: Rows) -> HeldOutScore:
        """The log densities of a fitted base; the sensors' and the edge of sticking's noise are those of other rows."""
        reduction, point, own = self.reduction, base.point, base.coordinates
        rows = reduction.rows(base.linear, (), like)
        numbers, state = base_numbers(own, point), base.fit.state
        whole = Judge(rows, numbers, reduction.settings).fit(state=state, rounds=0).mean
        points, rng = [], np.random.default_rng(0)
        for held in self._folds:
            judge = Judge(_some(rows, ~held), numbers, reduction.settings)
            fit = judge.fit(state=_of_some(state, ~held), rounds=0)
            draws = rng.multivariate_normal(np.zeros(len(point)), fit.covariance, DRAWS, method="cholesky")
            points += [np.clip(point + fit.mean - whole + away, own.low, own.high) for away in (0.0, *draws)]
        lacking = -reduction.reduce(base.linear.reducers, reduction.at(own, np.array(points)))
        density = np.zeros((int(self.runs.max()) + 1, len(rows.joints)))
        for drawn, held in zip(lacking.reshape(-1, DRAWS + 1, *lacking.shape[1:]), self._folds, strict=True):
            for run in np.unique(self.runs[held]):
                mine = self.runs == run
                for j in range(len(rows.joints)):
                    args = rows.variance[j, mine], rows.features[j, mine], rows.kinds, state.noise[j], state.law[j]
                    each = [log_density(left[j, mine], *args, reduction.settings.tails) for left in drawn]
                    density[run, j] = logsumexp(each) - np.log(len(each))
        return HeldOutScore(density)


def _dealt(runs: int) -> list[np.ndarray]:
    """Runs dealt out to folds."""
    folds = min(FOLDS, runs)
    return [np.arange(fold, runs, folds) for fold in range(folds)]


def _some(rows: Rows, kept: np.ndarray) -> Rows:
    """Rows of some windows."""
    values = tuple(one[:, kept] for one in rows.values)
    parts = {name: getattr(rows, name)[:, kept] for name in ("measured", "variance", "features")}
    return replace(rows, **parts, values=values)


def _of_some(state: Variances, kept: np.ndarray) -> Variances:
    return Variances(state.noise, state.law, state.weight[:, :, kept])


def log_density(
    left: np.ndarray,
    known: np.ndarray,
    features: np.ndarray,
    kinds: np.ndarray,
    noise: np.ndarray,
    law: float,
    tails: float,
) -> float:
    """Log density of what is left of a joint's rows, ``[window, row]``, but for constants.

    Args:
        left: what a model leaves.
        known: variance of the sensors and of the edge of sticking; infinite where nothing is known.
        features: of the unexplained law, ``[window, row, feature]``.
        kinds: of the rows.
        noise: standard deviations by kind.
        law: size of the unexplained law.
        tails: degrees of freedom of Student's noise.
    """
    whole = known + noise[kinds] ** 2
    seen = np.isfinite(whole)
    if not seen.any():
        return 0.0
    y, f = np.where(seen, left, 0.0).ravel().astype(np.float64), features.reshape(left.size, -1)
    group = kinds // 2
    weight = np.ones((len(left), int(group.max()) + 1))
    counts = np.stack([seen[:, group == g].sum(1) for g in range(weight.shape[1])], 1)

    def solved() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Precisions, the factor of the law's precision, and the measurement seen through it."""
        precision = np.where(seen, weight[:, group] / whole, 0.0).ravel()
        factor = np.linalg.cholesky(f.T @ (f * precision[:, None]) + np.eye(f.shape[1]) / law**2)
        half = linalg.solve_triangular(factor, f.T @ (precision * y), lower=True, check_finite=False)
        return precision, factor, half

    for _ in range(ROUNDS):
        _, factor, half = solved()
        spread = linalg.solve_triangular(factor, f.T, lower=True, check_finite=False)
        square = (np.square(y - spread.T @ half) + np.square(spread).sum(0)).reshape(left.shape)
        distance = np.where(seen, square / whole, 0.0)
        for g in range(weight.shape[1]):
            weight[:, g] = (tails + counts[:, g] - 2) / (tails + distance[:, group == g].sum(1))
    precision, factor, half = solved()
    positive = precision[precision > 0]
    density = np.log(positive).sum() - 2 * np.log(np.diag(factor)).sum() - 2 * f.shape[1] * np.log(law)
    density -= float(y @ (precision * y) - half @ half)
    density += 2 * ((tails / 2 - 1) * np.log(weight) - tails / 2 * weight)[counts > 0].sum()
    return 0.5 * float(density)
