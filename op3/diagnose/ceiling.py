"""What a black box could explain: a nonlinear torque per joint, learned from the fitted runs, without any catalogue.

The residual torque of every joint is a smooth random function (kernel ridge regression on random Fourier features) of
what the joint goes through: angle, velocity and its sign, current, power, load, temperature, voltage, time. Its effect
on the windows follows from the mass matrix along the measured motion, so that what it explains counts in the same unit
as what an effect of the catalogue explains: share of the residual of the choosing runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from op3.diagnose.fitting import Fit
from op3.diagnose.locate import Response
from op3.diagnose.screen import Projector
from op3.diagnose.windows import WindowResiduals

FEATURES = 72
"""Random features per joint."""

ALONE = 0.6
"""Share of the features that depend on one input alone; the others depend on two. Functions of all inputs at once learn
the fitted runs by heart."""

LENGTHS = (1.5, 0.5)
"""Length scales of the features, in standard deviations of their inputs: half of them broad, half narrow."""

RIDGES = (0.03, 0.3, 3.0, 30.0)
"""Ridge penalties that are tried, as a share of the mean squared column."""

FOLDS = 4
"""Parts of the fitted runs, each left out in turn, by which the penalty is chosen."""

ASKED = 0.03
"""Gain from which on it is asked what the black box uses."""

INPUTS = ("angle", "velocity", "direction", "current", "power", "load", "temperature", "voltage", "time")
"""What the black box is told about a joint."""


@dataclass(frozen=True, eq=False)
class Ceiling:
    """What the black box explains.

    Attributes:
        gain: share of the residual of the choosing runs.
        fit_gain: share of the residual of the fitted runs.
        by_joint: gain of each joint's torque alone, ``[joint]``.
        inputs: loss of gain when one input of the best joint is shuffled among ticks, by its name; none where the gain
            is not worth to be asked for.
    """

    gain: float
    fit_gain: float
    by_joint: np.ndarray
    inputs: dict[str, float]


def ceiling(engine: WindowResiduals, base: Fit, residual: np.ndarray, seed: int = 0) -> Ceiling:
    """Fit the black box beside the base and score it.

    Args:
        engine: whose windows.
        base: with its Jacobian; what it can imitate is taken out of the black box.
        residual: that is to be explained, ``[window, residual]``.
        seed: of the features.
    """
    rng = np.random.default_rng([seed, 17])
    inputs = _inputs(engine)
    joints, count = len(engine.joints), inputs.shape[-1]
    projector = Projector(base, engine.is_fit)
    waves = random_waves(count, rng)
    phases = rng.uniform(0, 2 * np.pi, FEATURES)
    response = Response(engine, base.parameters)

    def columns(told: np.ndarray, joint: int) -> tuple[np.ndarray, np.ndarray]:
        torque = np.cos(told[:, :, joint] @ waves + phases)  # [window, tick, feature]
        return projector.split(np.moveaxis(response(torque, joint), -1, 0))

    parts = [columns(inputs, j) for j in range(joints)]
    fitted, held = (np.concatenate([part[k] for part in parts]).T for k in (0, 1))
    windows = int(engine.is_fit.sum())
    target, other = residual[engine.is_fit].reshape(-1), residual[~engine.is_fit].reshape(-1)
    runs = np.array([log for log, _ in engine.windows[:windows]])
    ridge = _best_ridge(fitted, target, np.repeat(runs, len(target) // windows))
    if ridge is None:
        return Ceiling(0.0, 0.0, np.zeros(joints), {})
    weights = _solve(fitted, target, ridge)
    total = float(other @ other)
    alone = np.zeros(joints)
    for j in range(joints):
        own = slice(j * FEATURES, (j + 1) * FEATURES)
        alone[j] = 1 - float(np.square(other - held[:, own] @ weights[own]).sum()) / total
    gain = 1 - float(np.square(other - held @ weights).sum()) / total
    best = int(alone.argmax())
    own = slice(best * FEATURES, (best + 1) * FEATURES)
    used = {}
    for k, name in enumerate(INPUTS if gain > ASKED else ()):
        shuffled = inputs.copy()
        ticks = shuffled[~engine.is_fit][:, :, best, k]
        shuffled[~engine.is_fit, :, best, k] = rng.permutation(ticks.ravel()).reshape(ticks.shape)
        explained = weights[own] @ columns(shuffled, best)[1]
        used[name] = alone[best] - 1 + float(np.square(other - explained).sum()) / total
    return Ceiling(
        gain=gain,
        fit_gain=1 - float(np.square(target - fitted @ weights).sum()) / float(target @ target),
        by_joint=alone,
        inputs=dict(sorted(used.items(), key=lambda pair: -pair[1])),
    )


def random_waves(count: int, rng: np.random.Generator) -> np.ndarray:
    """Wave numbers of the features, ``[input, feature]``, each of one or two inputs."""
    waves = np.zeros((count, FEATURES))
    for feature in range(FEATURES):
        used = [feature % count] if feature < ALONE * FEATURES else rng.choice(count, 2, replace=False)
        waves[used, feature] = rng.normal(size=len(used)) / LENGTHS[rng.integers(len(LENGTHS))]
    return waves


def _inputs(engine: WindowResiduals) -> np.ndarray:
    """Standardised inputs of the black box, ``[window, tick, joint, input]``."""
    told = told_of_windows(engine)
    told = (told - told.mean(0)) / np.maximum(told.std(0), 1e-6)
    return engine.by_window(told)


def told_of_windows(engine: WindowResiduals) -> np.ndarray:
    """Inputs of the black box along the motion of all windows, ``[row, joint, input]``."""
    motion = engine.motion
    zeros = np.zeros(motion.position.shape)
    return told(
        motion.position,
        motion.velocity,
        motion.current,
        motion.dynamics.bias,
        motion.inputs.get("temperature", zeros),
        zeros if engine.measured_voltage is None else engine.measured_voltage,
        motion.time,
    )


def told(
    position: np.ndarray,
    velocity: np.ndarray,
    current: np.ndarray,
    load: np.ndarray,
    temperature: np.ndarray,
    voltage: np.ndarray,
    time: np.ndarray,
) -> np.ndarray:
    """`INPUTS` of what a joint goes through, ``[tick, joint, input]``; each ``[tick, joint]``, time ``[tick, 1]``."""
    direction = np.tanh(velocity / 0.05)
    channels = [position, velocity, direction, current, current * velocity, load, temperature, voltage]
    return np.stack([*channels, np.broadcast_to(time, position.shape)], -1)


def _best_ridge(fitted: np.ndarray, target: np.ndarray, runs: np.ndarray) -> float | None:
    """The penalty with the smallest error on parts of the runs left out; None if none explains anything there."""
    folds = np.array_split(np.unique(runs), min(FOLDS, len(np.unique(runs))))
    errors = np.zeros(len(RIDGES))
    gram, right = fitted.T @ fitted, fitted.T @ target
    for fold in folds:
        out = np.isin(runs, fold)
        left, told = fitted[out], target[out]
        part_gram, part_right = gram - left.T @ left, right - left.T @ told
        for k, ridge in enumerate(RIDGES):
            errors[k] += np.square(told - left @ regularised(part_gram, part_right, ridge)).sum()
    best = int(errors.argmin())
    return RIDGES[best] if errors[best] < float(target @ target) else None


def _solve(fitted: np.ndarray, target: np.ndarray, ridge: float) -> np.ndarray:
    return regularised(fitted.T @ fitted, fitted.T @ target, ridge)


def regularised(gram: np.ndarray, right: np.ndarray, ridge: float) -> np.ndarray:
    """Ridge regression from its normal equations; the penalty is a share of the mean squared column."""
    size = len(gram)
    return linalg.solve(gram + (ridge * np.trace(gram) / size + 1e-12) * np.eye(size), right, assume_a="pos")


def where(result: Ceiling, joints: Sequence[str]) -> str:
    """Where the black box finds something and what it uses, in words."""
    used = [name for name, loss in result.inputs.items() if loss > 0.2 * max(result.inputs.values(), default=0.0)][:3]
    told = f", as a function of {', '.join(used)}" if used else ""
    return f"most in {joints[int(result.by_joint.argmax())]}{told}"
