"""What makes rows of residuals: how a window answers to errors of its start and to torques, and the inverse."""

from typing import NamedTuple

import numpy as np

from op3.diagnose.judge_settings import FLOORS, PIECES
from op3.diagnose.rates import moved
from op3.replay.windows import WindowResiduals

INITIAL = (0.0015, 0.06)
"""Standard deviations of a window's initial angle [rad] and velocity [rad/s]: what smoothing leaves."""

WIDE_TORQUE = 15.0
"""Prior standard deviation of a piece's torque [units]; sets what a joint at rest tells, and little else."""


class Reducer(NamedTuple):
    """What makes rows of a limb's residuals.

    Attributes:
        torque: residual to torque, ``[window, torque, residual]``.
        moved: weights of positions for their rate as a servo's filter tells it, ``[joint, piece, tick]``.
    """

    torque: np.ndarray
    moved: np.ndarray


def reducer(nuisances: np.ndarray, filters: np.ndarray, period: float) -> tuple[Reducer, np.ndarray]:
    """What makes rows of a limb's residuals, and the variance of their torques, ``[window, joint]``.

    Args:
        nuisances: responses to initial states and to torques, ``[window, residual, nuisance]``.
        filters: of the servos' velocities, ``[joint, tick, tick]``.
        period: of a tick [s].
    """
    windows, n = len(nuisances), len(filters)
    prior = np.ones(nuisances.shape[2])
    prior[2 * n :] = WIDE_TORQUE**2
    inner = np.einsum("wra,wrb->wab", nuisances, nuisances, optimize=True).astype(np.float64)
    covariance = np.linalg.inv(inner + np.diag(1 / prior))
    gain = np.einsum("wab,wrb->war", covariance[:, 2 * n :], nuisances, optimize=True).astype(np.float32)
    spread = np.diagonal(covariance, axis1=1, axis2=2)[:, 2 * n :].reshape(windows, n, PIECES).mean(2)
    return Reducer(gain, np.stack([moved(matrix, period) for matrix in filters]).astype(np.float32)), spread


def torque_responses(
    engine: WindowResiduals,
    limb: np.ndarray,
    armature: np.ndarray,
    loop: bool,
    initial: np.ndarray,
    left: np.ndarray,
    filters: np.ndarray,
    unit: float,
    floor: np.ndarray,
) -> np.ndarray:
    """What a unit of torque in one joint and piece would do, ``[nuisance, window, residual]``.

    A joint answers where it moves, measured or simulated, and its servo's own loop pulls it back as it does after an
    error of the initial angle.

    Args:
        engine: windows of logs.
        limb: columns of its joints.
        armature: of all joints [kg m^2], ``[joint]``.
        loop: whether servos close the position loop themselves.
        initial: responses to initial states, whitened, ``[nuisance, window, residual]``.
        left: what the base leaves, whitened, ``[window, residual]``.
        filters: of the servos' velocities, ``[joint, tick, tick]``.
        unit: of torque [N m].
        floor: of all sensors, ``[joint, channel]``.
    """
    windows, n, ticks = len(left), len(limb), filters.shape[1] - 1
    shape = (windows, ticks + 1, n, 3)
    mass = engine.by_window(engine.motion.dynamics.mass, end=True)[:, :, limb][:, :, :, limb] + np.diag(armature[limb])
    mobility = np.linalg.inv(mass)
    measured = engine.by_window(engine.motion.velocity, end=True)[:, :, limb]
    moves, read = np.abs(measured) > 0.02, engine.known[limb, 1]
    moves |= read & (np.abs(measured + left.reshape(shape)[..., 1] * np.where(read, floor[limb, 1], 0.0)) > 0.04)
    stiffness = np.zeros((*mass.shape[:2], n))
    if loop:  # else commands are those of the log, and nothing pulls back
        stiffness = _stiffness(engine, limb, initial[:n].reshape(n, *shape), mass)
    piece = np.arange(ticks) * PIECES // ticks
    response = np.zeros((n, PIECES, *shape), np.float32)
    for j in range(n):
        for p in range(PIECES):
            q, v = np.zeros((windows, n)), np.zeros((windows, n))
            for t in range(ticks):
                pull = (unit if piece[t] == p else 0.0) * mobility[:, t, :, j]
                pull = pull - np.einsum("wij,wj->wi", mobility[:, t], stiffness[:, t] * q)
                v = (v + engine.period * pull) * moves[:, t]
                q = q + engine.period * v
                response[j, p, :, t + 1, :, 0], response[j, p, :, t + 1, :, 1] = q, v
    response[..., 1] = np.einsum("jst,apwtj->apwsj", filters, response[..., 1], optimize=True)
    response /= floor[limb].astype(np.float32)
    return response.reshape(n * PIECES, windows, -1)


def _stiffness(engine: WindowResiduals, limb: np.ndarray, initial: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Stiffness of servos that close the position loop themselves [N m/rad], ``[window, tick, joint]``.

    From how far an error of the initial angle has come back after two ticks: ``q(t) = q0 (1 - K t^2 / 2 J)``.
    """
    time, result = 2 * engine.period, np.zeros((*mass.shape[:2], len(initial)))
    enabled = engine.motion.inputs.get("torque_enable")
    for j, one in enumerate(initial):
        kept = np.median(one[:, 2, j, 0]) * FLOORS["joint", "position"] / INITIAL[0]
        result[..., j] = max(0.0, 2 * (1 - kept) / time**2) * float(np.median(mass[:, 0, j, j]))
    return result if enabled is None else result * engine.by_window(enabled, end=True)[..., limb]
