"""The screen: what each hypothesis would explain if the model were linear around its base, in seconds.

Every hypothesis is one finite change (a secant) of the prediction. It is projected on what base parameters and initial
states cannot explain, fitted to the runs that fit, and credited with what it then explains of the runs that choose.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from op3.diagnose.coordinates import CHAIN
from op3.diagnose.fitting import INFORMATION, ROUGH, Engine, Fit
from op3.diagnose.hypotheses import Hypothesis, stacked
from op3.servo.conditions import split_name

FURTHEST = 5.0
"""How far beyond its secant a hypothesis is extrapolated, in secants."""


@dataclass(frozen=True, eq=False)
class Screened:
    """One secant of one hypothesis.

    Attributes:
        hypothesis: which.
        secant: number of the secant.
        share: multiple of the secant that fits best, within its signs.
        gain: share of the residual of the choosing runs that it explains beyond the base; may be negative.
        fit_gain: the same of the fitted runs.
        statistic: score test, robust to dependence within a second; roughly chi squared with one degree of freedom.
        visibility: share of the secant's length that base parameters and initial states do not imitate.
        strength: length of what is left of the secant, in whitened residuals.
        direction: that part, normalised, on the fitted runs, for cosines.
    """

    hypothesis: Hypothesis
    secant: int
    share: float
    gain: float
    fit_gain: float
    statistic: float
    visibility: float
    strength: float
    direction: np.ndarray


class Projector:
    """Least squares on a base: removes from a column what the base's parameters explain, priors included.

    Args:
        base: with its Jacobian.
        is_fit: windows by which parameters are fitted.
    """

    def __init__(self, base: Fit, is_fit: np.ndarray):
        assert base.jacobian is not None
        size = len(base.coordinates)
        self._is_fit = is_fit
        # single precision, as simulations are: a column of which a fiftieth is left still has four digits
        self._fit = base.jacobian[is_fit].reshape(-1, size).astype(np.float32)
        self._rest = base.jacobian[~is_fit].reshape(-1, size).astype(np.float32)
        deviation = np.array([entry.deviation for entry in base.coordinates.entries])
        fitted = self._fit.astype(np.float64)
        normal = fitted.T @ fitted + np.diag(1.0 / deviation**2) / INFORMATION
        scale = 1.0 / np.sqrt(np.diag(normal))
        self._scale = scale
        self._factor = linalg.cho_factor(normal * scale[:, None] * scale + 1e-9 * np.eye(size))
        self.residual = base.residual[is_fit].reshape(-1).astype(np.float64)
        self.held = base.residual[~is_fit].reshape(-1).astype(np.float64)

    def split(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is left of columns ``[column, window, residual]`` on the fitted and other windows, a row each."""
        fit, rest = (
            columns[:, where].reshape(len(columns), -1).astype(np.float32) for where in (self._is_fit, ~self._is_fit)
        )
        product = self._scale[:, None] * (self._fit.T @ fit.T)
        step = (self._scale * linalg.cho_solve(self._factor, product).T).astype(np.float32)
        return fit - step @ self._fit.T, rest - step @ self._rest.T


def screen(
    engine: Engine,
    base: Fit,
    hypotheses: Sequence[Hypothesis],
    progress: Callable[[float], None] | None = None,
) -> list[Screened]:
    """Screen hypotheses; all secants of one effect are one batch of simulations.

    Returns:
        Every secant of every hypothesis, best gain first.
    """
    projector = Projector(base, engine.is_fit)
    blocks = np.unique(engine.blocks[engine.is_fit], return_inverse=True)[1]
    result: list[Screened] = []
    models = list({id(h.model): h.model for h in hypotheses}.values())
    batches = [(m, e) for m in models for e in dict.fromkeys(h.effect for h in hypotheses if h.model is m)]
    for number, (model, effect) in enumerate(batches):
        mine = [h for h in hypotheses if h.model is model and h.effect is effect]
        start = {**_neutral(mine[0], base), **base.parameters}
        sets = [start, *(h.moved(start, secant) for h in mine for secant in h.secants)]
        output = engine.residuals(mine[0].model, stacked(sets), len(sets), stretch=ROUGH)
        columns = output[1:] - output[:1]
        fit, held = projector.split(columns)
        secants = [(hypothesis, k) for hypothesis in mine for k in range(len(hypothesis.secants))]
        for column, mine_fit, mine_held, (hypothesis, k) in zip(columns, fit, held, secants, strict=True):
            result.append(_score(projector, column, mine_fit, mine_held, hypothesis, k, blocks))
        if progress is not None:
            progress((number + 1) / len(batches))
    return sorted(result, key=lambda s: -s.gain)


def _neutral(hypothesis: Hypothesis, base: Fit) -> dict:
    """Parameters of the hypothesis' model that the base does not have, ``[1, joint]``."""
    return hypothesis.neutral(base.coordinates.joints)


def _score(
    projector: Projector,
    column: np.ndarray,
    fit: np.ndarray,
    held: np.ndarray,
    h: Hypothesis,
    secant: int,
    blocks: np.ndarray,
) -> Screened:
    length = float(np.square(column, dtype=np.float64).sum())
    strength = float(fit @ fit)
    visibility = float(np.sqrt(strength / max(1e-12, np.square(column[projector._is_fit], dtype=np.float64).sum())))
    if length < 1e-6 or strength < 1e-6:
        return Screened(h, secant, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, fit.astype(np.float32))
    product = fit * projector.residual
    share = -float(product.sum()) / strength
    name = next(iter(h.secants[secant]))
    one_sided = _one_sided(h, name)
    share = float(np.clip(share, 0.0 if one_sided else -FURTHEST, FURTHEST))
    before, after = float(projector.residual @ projector.residual), projector.residual + share * fit
    held_before, held_after = float(projector.held @ projector.held), projector.held + share * held
    per_window = product.reshape(len(blocks), -1).sum(1)
    scores = np.bincount(blocks, per_window)
    statistic = float(scores.sum() ** 2 / max(1e-12, np.square(scores).sum()))
    return Screened(
        h,
        secant,
        share,
        1.0 - float(held_after @ held_after) / held_before,
        1.0 - float(after @ after) / before,
        statistic,
        visibility,
        float(np.sqrt(strength)),
        (fit / np.sqrt(strength)).astype(np.float32),
    )


def _one_sided(h: Hypothesis, name: str) -> bool:
    """Whether the hypothesis may move only along its secant: its parameter stands at a bound of what is possible."""
    known = next(p for p in h.effect.parameters if p.name == split_name(name)[0])
    if known.neutral is None:
        return True
    if name in CHAIN and not CHAIN[name][2]:
        return True
    now = h.model.value(known.name)
    return (
        now <= max(known.least, known.low if known.low == known.neutral else known.least) + 1e-12 or now >= known.most
    )


def foreseen(screened: Sequence[Screened], residual: np.ndarray, blocks: np.ndarray) -> list[tuple[float, float]]:
    """What each secant would explain of another residual: share of its squares, and the score as in `Screened`.

    Args:
        screened: with directions beyond the base.
        residual: of the fitted windows, that the base's parameters explain nothing of, ``[window, residual]``.
        blocks: of each window, ``[window]``.
    """
    blocks = np.unique(blocks, return_inverse=True)[1]
    left, whole = residual.reshape(-1), float(np.square(residual, dtype=np.float64).sum())
    result = []
    for s in screened:
        product = s.direction * left
        scores = np.bincount(blocks, product.reshape(len(blocks), -1).sum(1, dtype=np.float64))
        total = float(scores.sum()) ** 2
        result.append((total / max(1e-12, whole), total / max(1e-12, float(np.square(scores).sum()))))
    return result


def cosines(screened: Sequence[Screened]) -> np.ndarray:
    """How alike hypotheses look once the base has had its say, ``[hypothesis, hypothesis]``."""
    directions = np.stack([s.direction for s in screened])
    return directions @ directions.T
