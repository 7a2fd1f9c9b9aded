"""What joints lack before and after the findings, and the shape of what nobody explains."""

import numpy as np

from op3.diagnose.judge_settings import PIECES
from op3.diagnose.naming import NamingStage
from op3.diagnose.reduction import Reduction
from op3.diagnose.verdict import JointGap

BINS = 8
"""Ranges of an input, each with as many windows, over which an unexplained torque is averaged."""


def lacking(reduction: Reduction, stage: NamingStage) -> np.ndarray:
    """Torque that each joint lacks at a stage, root mean square over windows by their weight [units], ``[joint]``."""
    own = np.concatenate([stage.fit.mean[: len(stage.base.point)], np.zeros(len(stage.found))])
    mean, result = reduction.kinds == 0, []
    for j in range(len(stage.judge.rows.joints)):
        left = stage.judge.residual(j, own, np.zeros_like(stage.fit.laws[j]))[:, mean]
        known = np.isfinite(stage.judge.rows.variance[j][:, mean])
        weight = np.minimum(stage.fit.state.weight[0, j], 1.0)[:, None] * known
        result.append(np.sqrt((weight * left**2).sum() / max(weight.sum(), 1e-9)))
    return np.array(result) / np.sqrt(PIECES)


def joint_gaps(reduction: Reduction, first: NamingStage, last: NamingStage) -> dict[str, JointGap]:
    """What each joint that moves lacks under the base and with everything named.

    What nobody explains is flagged where it is larger than of two standard deviations of sound joints.
    """
    s, unit = reduction.settings, reduction.unit
    before, after = lacking(reduction, first), lacking(reduction, last)
    mean = reduction.kinds == 0
    result = {}
    for j, joint in enumerate(last.judge.rows.joints):
        if not reduction.moving[reduction.judged[j]]:
            continue
        variance = last.judge.rows.variance[j][:, mean]
        seen = np.isfinite(variance)
        floor = float(np.sqrt(np.median(variance[seen]) / PIECES)) if seen.any() else 0.0
        law = last.judge.rows.features[j][:, mean][:, 0] @ last.fit.laws[j] / np.sqrt(PIECES)
        result[joint] = JointGap(
            float(before[j] * unit),
            float(after[j] * unit),
            floor * unit,
            float(np.sqrt(np.square(law).mean()) * unit),
            bool(last.fit.state.law[j] > s.law * np.exp(2 * s.law_spread)),
            _shape(reduction, int(reduction.judged[j]), law),
        )
    return result


def _shape(reduction: Reduction, joint: int, law: np.ndarray) -> dict[str, float]:
    """Share of an unexplained torque's variance that goes with each of what the joint goes through."""
    engine = reduction.engine
    inputs = {
        "position": engine.motion.position,
        "velocity": engine.motion.velocity,
        "load": engine.motion.dynamics.bias,
    }
    means = {name: engine.by_window(values)[..., joint].mean(1) for name, values in inputs.items()}
    means["time"] = engine.by_window(engine.motion.time)[..., 0].mean(1)
    return {name: _explained(values, law) for name, values in means.items()}


def _explained(x: np.ndarray, y: np.ndarray) -> float:
    """Share of the variance of y that its means over ranges of x have, less what chance gives them."""
    place = np.argsort(np.argsort(x)) * BINS // len(x)
    means = np.array([y[place == b].mean() if (place == b).any() else 0.0 for b in range(BINS)])
    total = y.var()
    if total <= 0:
        return 0.0
    share = means[place].var() / total
    chance = (BINS - 1) / max(len(y) - 1, 1)
    return float(np.clip((share - chance) / (1 - chance), 0.0, 1.0))
