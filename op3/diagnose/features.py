"""Features of the motion of joints: the unexplained torque of a joint is modelled as a sum of them."""

import numpy as np
from scipy import linalg

from op3.diagnose.judge_settings import FLOORS, PIECES, Settings
from op3.diagnose.rates import ESTIMATE, RATES, read
from op3.replay.windows import WindowResiduals

OFTEN = np.array([3, 3, 3, 3, 2, 1, 1.0])
"""How often a feature looks at position, velocity, its direction, load, load times velocity, warmth, time."""


SWAY = (0.2, 0.005)
"""How far what a swaying stand asks of joints is known: a share of it, as nobody knows the point about which the stand
bends, and a time [s], as nobody knows the gyro's filter (register map of the MPU-9250: 1 to 18 ms)."""


def features(engine: WindowResiduals, joints: np.ndarray, unit: float, settings: Settings) -> np.ndarray:
    """What some joints may do unexplained, ``[joint, window, row, feature]``.

    Of torques what they go through and what is not known of a stand's sway, of rates how servos estimate velocity.

    Args:
        engine: windows of logs.
        joints: columns.
        unit: of torque [N m].
        settings: tuned constants.
    """
    motion, by_window, ticks = engine.motion, engine.by_window, engine.ticks
    made = random_features(engine, joints, settings.features)
    carried = np.einsum("tjk,tok->otj", motion.dynamics.carried, engine.sway) / unit
    for share, torque in zip(SWAY, carried, strict=True):  # of what the gyro says of the stand
        made.append(share / settings.law * by_window(torque)[..., joints])
    of_piece = np.arange(ticks) * PIECES // ticks
    mean = np.stack([(of_piece == p) / (of_piece == p).sum() for p in range(PIECES)])
    torques = _rows(mean, np.stack(made))
    velocity, acceleration = (by_window(one, end=True) for one in (motion.velocity, motion.acceleration))
    known = velocity, acceleration, np.gradient(acceleration, engine.period, axis=1)
    made = [size / settings.law * one[..., joints] for size, one in zip(ESTIMATE, known, strict=True)]
    rates = _rows(read(ticks) / FLOORS["joint", "velocity"], np.stack(made))
    whole = np.zeros((*torques.shape[:2], 2 * PIECES + RATES, torques.shape[3] + rates.shape[3]))
    whole[:, :, :PIECES, : torques.shape[3]], whole[:, :, -RATES:, torques.shape[3] :] = torques, rates
    return whole


def _rows(weights: np.ndarray, made: np.ndarray) -> np.ndarray:
    """Mean and differences of pieces, by weights ``[piece, tick]``, of features ``[feature, window, tick, joint]``."""
    pieces = np.einsum("pt,fwtj->jwpf", weights, made)
    return np.einsum("rp,jwpf->jwrf", linalg.helmert(len(weights), full=True), pieces)


def random_features(engine: WindowResiduals, joints: np.ndarray, count: int) -> list[np.ndarray]:
    """Features along the windows, each ``[window, tick, joint]``; the first is constant.

    The unexplained torque of a joint is modelled as a sum of them (Rahimi & Recht 2007).
    """
    rng = np.random.default_rng(0)
    motion = engine.motion
    q, v, i = (engine.by_window(a)[..., joints] for a in (motion.position, motion.velocity, motion.current))
    time = np.broadcast_to(engine.by_window(motion.time), q.shape)
    warmth = motion.inputs.get("temperature")
    warm = np.zeros_like(q) if warmth is None else engine.by_window(warmth)[..., joints]
    target = engine.by_window(motion.inputs["position_target"])[..., joints]
    load = i if np.ptp(i) > 0 else target - q  # a servo with its own loop pushes in proportion to its error
    x = np.stack([q, v, np.tanh(v / 0.05), load, load * v, warm, time], -1)
    spread = x.std((0, 1))
    x = (x - x.mean((0, 1))) / np.where(spread < 1e-4, 1e9, spread)
    made = [np.ones(q.shape)]
    for number in range(count - 1):
        picked = rng.choice(7, 2, replace=False, p=OFTEN / OFTEN.sum()) if number % 2 else rng.choice(5, 1)
        weight = np.zeros(7)
        weight[picked] = rng.standard_normal(len(picked)) / (1.5 if number % 4 < 2 else 0.6)
        made.append(np.sqrt(2) * np.cos(x @ weight + rng.uniform(0, 2 * np.pi)))
    return made
