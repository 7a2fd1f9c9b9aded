"""How far a black box brings free runs: the ceiling of the gap, whatever the catalogue holds.

Windows of 50 ms over the fitted runs tell the torque that the base lacks: longer ones answer to more than a torque. A
smooth random function of what a joint goes through learns it, and is pushed into free runs of the base on logs that it
has not seen.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from op3.diagnose.ceiling import FEATURES, FOLDS, INPUTS, random_waves, regularised, told, told_of_windows
from op3.diagnose.locate import REST, residual_torque
from op3.diagnose.motion import SmoothLog, fixed_base, smooth_all
from op3.diagnose.windows import WindowResiduals, began, since
from op3.rollout import Rollout
from op3.servo import RobotModel

WINDOWS = (360, 120)
"""Windows of the fitted runs, and of those that choose; all are learned, as nothing is chosen here."""

LENGTH = 0.05
"""Length of a window [s]."""

PRIOR = 0.3
"""Standard deviation of the torque in a window that is expected [N m]: rather more than there is, as a tight one would
draw the function that is learned to nothing."""

RIDGES = (0.003, 0.03, 0.3, 3.0, 30.0)
"""Ridge penalties that are tried, as a share of the mean squared column."""

TAMED = 4.5
"""Torques beyond so many usual ones are taken for so many: in some windows a joint stuck that was thought to slip."""


class TorqueBox:
    """The torque that a base lacks as a function of what each joint goes through, learned from logs.

    Args:
        engine: whose logs are learned.
        base: model that lacks something.
        seed: of the random features.

    Attributes:
        weights: of the features and of one, ``[joint, feature + 1]``; zero where a joint's function explains nothing
            of runs left out.
    """

    def __init__(self, engine: WindowResiduals, base: RobotModel, seed: int = 0):
        rng = np.random.default_rng([seed, 29])
        self.joints = engine.joints
        self._waves = random_waves(len(INPUTS), rng)
        self._phases = rng.uniform(0, 2 * np.pi, FEATURES)
        self._origin = began(engine.smooth_logs)
        fit, select = WINDOWS
        lengths: dict[str, Any] = {
            "fit_windows": fit,
            "select_windows": select,
            "ticks": max(2, round(LENGTH / engine.period)),
        }
        tiles = WindowResiduals(engine.split, **lengths, smooth_logs=engine.smooth_logs)
        tiles.prepare(base, nuisances=False)
        parameters = base.tensors(tiles.joints)
        torque = residual_torque(tiles, parameters, tiles.residuals(base)[0], 1, PRIOR)[:, 0]  # [window, joint]
        seen = told_of_windows(tiles)
        self._mean, self._deviation = seen.mean(0), np.maximum(seen.std(0), 1e-6)
        runs = np.array([log for log, _ in tiles.windows])
        moving = _by_window(tiles, np.abs(tiles.motion.velocity)) > REST
        self.weights = np.zeros((len(self.joints), FEATURES + 1))
        for joint in range(len(self.joints)):
            at = moving[:, joint]
            columns = _by_window(tiles, self._features(seen, joint))[at]
            self.weights[joint] = _learned(columns, torque[at, joint], runs[at])

    def __bool__(self) -> bool:
        return bool(self.weights.any())

    def torques(self, logs: Sequence[Rollout]) -> list[np.ndarray]:
        """What the base lacks along other logs of the robot [N m], ``[row, joint]`` each."""
        result = []
        for log, smooth in zip(logs, smooth_all(logs), strict=True):
            inputs = self._inputs(smooth)
            torque = np.stack([self._features(inputs, j) @ w for j, w in enumerate(self.weights)], 1)
            rows = np.clip(np.searchsorted(smooth.time, log.array("time")[:, 0] - log.array("time")[0, 0]), 0, None)
            result.append(torque[np.minimum(rows, len(torque) - 1)])
        return result

    def _features(self, seen: np.ndarray, joint: int) -> np.ndarray:
        """Random features of one joint's inputs, and one, ``[row, feature + 1]``."""
        given = (seen[:, joint] - self._mean[joint]) / self._deviation[joint]
        return np.concatenate([np.cos(given @ self._waves + self._phases), np.ones((len(given), 1))], 1)

    def _inputs(self, smooth: SmoothLog) -> np.ndarray:
        zeros = np.zeros(smooth.position.shape)
        base = fixed_base(self.joints, smooth.tilt)
        return told(
            smooth.position,
            smooth.velocity,
            smooth.readings.get(("joint", "current"), zeros),
            base.along(base.mj_model, smooth.position, smooth.velocity).bias,
            smooth.inputs.get("temperature", zeros),
            smooth.inputs.get("bus_voltage", zeros),
            since(self._origin, smooth) + smooth.time[:, None],
        )


def _by_window(tiles: WindowResiduals, values: np.ndarray) -> np.ndarray:
    """Means over the ticks of all windows, ``[window, ...]``, of values ``[row, ...]``."""
    return tiles.by_window(values).mean(1)


def _learned(columns: np.ndarray, lacking: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """Ridge weights with the penalty that predicts runs left out best; zeros where none predicts anything."""
    nothing = np.zeros(columns.shape[1])
    if len(np.unique(runs)) < 2:
        return nothing
    usual = 1.4826 * float(np.median(np.abs(lacking)))
    target = np.clip(lacking, -TAMED * usual, TAMED * usual)
    gram, right = columns.T @ columns, columns.T @ target
    errors = np.zeros(len(RIDGES))
    for fold in np.array_split(np.unique(runs), min(FOLDS, len(np.unique(runs)))):
        out = np.isin(runs, fold)
        left, told_there = columns[out], target[out]
        for k, ridge in enumerate(RIDGES):
            weights = regularised(gram - left.T @ left, right - left.T @ told_there, ridge)
            errors[k] += np.square(told_there - left @ weights).sum()
    best = int(errors.argmin())
    return regularised(gram, right, RIDGES[best]) if errors[best] < float(target @ target) else nothing
