"""Features of joint motion, whose linear combination models the unmodelled torque of a joint."""

import numpy as np
from scipy import linalg

from op3.diagnose.judge_settings import FLOORS, PIECES, Settings
from op3.diagnose.responses import RATES, velocity_weights
from op3.replay.windows import WindowResiduals

INPUT_WEIGHTS = np.array([3, 3, 3, 3, 2, 1, 1.0])
"""Numerical: relative probability that a random feature depends on position, velocity, direction of motion, load, load
times velocity, temperature and time."""

SWAY = (0.2, 0.005)
"""Uncertainty of the torque that the stand's sway causes: a relative error for the unknown pivot of the stand, and a
time [s] for the gyro's unknown filter. Data sheet: register map of the MPU-9250, 1 to 18 ms."""

ESTIMATE = (0.01, 0.001, 1e-5)
"""Uncertainty of the servo's velocity estimate: relative, in time [s], and in squared time [s^2]. Numerical: one and
three milliseconds, because firmware runs in steps of a millisecond."""


def features(engine: WindowResiduals, joints: np.ndarray, torque_unit: float, settings: Settings) -> np.ndarray:
    """Features of the unmodelled torque and of errors of the reported velocity, ``[joint, window, row, feature]``.

    Args:
        engine: windows of logs.
        joints: columns.
        torque_unit: unit of torque features [N m].
        settings: tuned constants.
    """
    motion, by_window, ticks = engine.motion, engine.by_window, engine.ticks
    torque_features = random_features(engine, joints, settings.features)
    carried = np.einsum("tjk,tok->otj", motion.dynamics.carried, engine.sway) / torque_unit
    for share, torque in zip(SWAY, carried, strict=True):
        torque_features.append(share / settings.unmodelled * by_window(torque)[..., joints])
    of_piece = np.arange(ticks) * PIECES // ticks
    mean = np.stack([(of_piece == p) / (of_piece == p).sum() for p in range(PIECES)])
    torques = _rows(mean, np.stack(torque_features))
    velocity, acceleration = (by_window(values, end=True) for values in (motion.velocity, motion.acceleration))
    derivatives = velocity, acceleration, np.gradient(acceleration, engine.period, axis=1)
    rate_features = [
        size / settings.unmodelled * values[..., joints] for size, values in zip(ESTIMATE, derivatives, strict=True)
    ]
    rates = _rows(velocity_weights(ticks) / FLOORS["joint", "velocity"], np.stack(rate_features))
    result = np.zeros((*torques.shape[:2], 2 * PIECES + RATES, torques.shape[3] + rates.shape[3]))
    result[:, :, :PIECES, : torques.shape[3]], result[:, :, -RATES:, torques.shape[3] :] = torques, rates
    return result


def _rows(weights: np.ndarray, features: np.ndarray) -> np.ndarray:
    """Means and differences over pieces, with weights ``[piece, tick]``, of features ``[feature, window, tick,
    joint]``."""
    pieces = np.einsum("pt,fwtj->jwpf", weights, features)
    return np.einsum("rp,jwpf->jwrf", linalg.helmert(len(weights), full=True), pieces)


def random_features(engine: WindowResiduals, joints: np.ndarray, count: int) -> list[np.ndarray]:
    """Random Fourier features (Rahimi & Recht 2007), each ``[window, tick, joint]``; the first is constant."""
    rng = np.random.default_rng(0)
    motion = engine.motion
    q, v, i = (engine.by_window(a)[..., joints] for a in (motion.position, motion.velocity, motion.current))
    time = np.broadcast_to(engine.by_window(motion.time), q.shape)
    temperature = motion.inputs.get("temperature")
    temperature = np.zeros_like(q) if temperature is None else engine.by_window(temperature)[..., joints]
    target = engine.by_window(motion.inputs["position_target"])[..., joints]
    load = i if np.ptp(i) > 0 else target - q  # the torque of an internal position loop is proportional to its error
    x = np.stack([q, v, np.tanh(v / 0.05), load, load * v, temperature, time], -1)
    spread = x.std((0, 1))
    x = (x - x.mean((0, 1))) / np.where(spread < 1e-4, 1e9, spread)
    result = [np.ones(q.shape)]
    for number in range(count - 1):
        inputs = (
            rng.choice(7, 2, replace=False, p=INPUT_WEIGHTS / INPUT_WEIGHTS.sum()) if number % 2 else rng.choice(5, 1)
        )
        weight = np.zeros(7)
        weight[inputs] = rng.standard_normal(len(inputs)) / (1.5 if number % 4 < 2 else 0.6)
        result.append(np.sqrt(2) * np.cos(x @ weight + rng.uniform(0, 2 * np.pi)))
    return result
