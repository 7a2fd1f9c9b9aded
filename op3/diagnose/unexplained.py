"""Residual torque of joints before and after the findings, and dependence of the unmodelled torque on the motion."""

import numpy as np

from op3.diagnose.judge_settings import PIECES
from op3.diagnose.naming import NamingStage
from op3.diagnose.reduction import Reduction
from op3.diagnose.verdict import JointGap

BINS = 8
"""Numerical: number of bins, with equally many windows each, over which the unmodelled torque is averaged."""


def residual_torques(reduction: Reduction, stage: NamingStage) -> np.ndarray:
    """RMS residual torque of each joint over windows, weighted by Student weights [torque units], ``[joint]``."""
    x = np.concatenate([stage.fit.mean[: len(stage.base.point)], np.zeros(len(stage.candidates))])
    mean, result = reduction.kinds == 0, []
    for j in range(len(stage.judge.rows.joints)):
        residual = stage.judge.residual(j, x, np.zeros_like(stage.fit.feature_weights[j]))[:, mean]
        valid = np.isfinite(stage.judge.rows.variance[j][:, mean])
        weight = np.minimum(stage.fit.variances.weight[0, j], 1.0)[:, None] * valid
        result.append(np.sqrt((weight * residual**2).sum() / max(weight.sum(), 1e-9)))
    return np.array(result) / np.sqrt(PIECES)


def joint_gaps(reduction: Reduction, first: NamingStage, last: NamingStage) -> dict[str, JointGap]:
    """Residual torque of each moving joint under the baseline and with all findings.

    A joint is flagged if its unmodelled torque is two standard deviations above that of sound joints.
    """
    s, unit = reduction.settings, reduction.torque_unit
    before, after = residual_torques(reduction, first), residual_torques(reduction, last)
    mean = reduction.kinds == 0
    result = {}
    for j, joint in enumerate(last.judge.rows.joints):
        if not reduction.moving[reduction.joint_indices[j]]:
            continue
        variance = last.judge.rows.variance[j][:, mean]
        valid = np.isfinite(variance)
        floor = float(np.sqrt(np.median(variance[valid]) / PIECES)) if valid.any() else 0.0
        torque = last.judge.rows.features[j][:, mean][:, 0] @ last.fit.feature_weights[j] / np.sqrt(PIECES)
        result[joint] = JointGap(
            float(before[j] * unit),
            float(after[j] * unit),
            floor * unit,
            float(np.sqrt(np.square(torque).mean()) * unit),
            bool(last.fit.variances.unmodelled[j] > s.unmodelled * np.exp(2 * s.unmodelled_spread)),
            _dependence(reduction, int(reduction.joint_indices[j]), torque),
        )
    return result


def _dependence(reduction: Reduction, joint: int, torque: np.ndarray) -> dict[str, float]:
    """Share of the variance of an unmodelled torque that position, velocity, load and time explain."""
    engine = reduction.engine
    motion = engine.motion
    inputs = {"position": motion.position, "velocity": motion.velocity, "load": motion.dynamics.bias}
    means = {name: engine.by_window(values)[..., joint].mean(1) for name, values in inputs.items()}
    means["time"] = engine.by_window(motion.time)[..., 0].mean(1)
    return {name: _explained_share(values, torque) for name, values in means.items()}


def _explained_share(x: np.ndarray, y: np.ndarray) -> float:
    """Share of the variance of y explained by its means over bins of x, minus the share expected by chance."""
    bins = np.argsort(np.argsort(x)) * BINS // len(x)
    means = np.array([y[bins == b].mean() if (bins == b).any() else 0.0 for b in range(BINS)])
    total = y.var()
    if total <= 0:
        return 0.0
    share = means[bins].var() / total
    chance = (BINS - 1) / max(len(y) - 1, 1)
    return float(np.clip((share - chance) / (1 - chance), 0.0, 1.0))
