"""The linear map from a window's residuals to its rows: unmodelled torques, and residuals of the reported velocity.

The response of a window to initial-state errors and to torques is inverted for the torques; the initial-state errors
are nuisance parameters. The reported velocity is compared with the rate of the measured angle after the servo's own
filter, so that the difference does not depend on the mechanics.
"""

from collections.abc import Mapping
from functools import cache
from itertools import pairwise
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from scipy import linalg
from torch import Tensor

from op3.diagnose.judge_settings import FLOORS, PIECES
from op3.replay.windows import WindowResiduals
from op3.servo.effects import VelocityFilter

INITIAL = (0.0015, 0.06)
"""Standard deviations of a window's initial angle [rad] and velocity [rad/s]: errors of the smoothed measurement.
Numerical, from the encoder's floor."""

WIDE_TORQUE = 15.0
"""Numerical: prior standard deviation of the torque of a piece [torque units]; it matters only for joints at rest."""

RATES = PIECES - 1
"""Numerical: pieces whose rates are compared. The first depends on filter inputs before the window."""


class Reducer(NamedTuple):
    """The map from the residuals of a limb to its rows.

    Attributes:
        torque: weights of the residuals, ``[window, torque, residual]``.
        rate: weights of positions for their filtered rate, ``[joint, piece, tick]``.
    """

    torque: np.ndarray
    rate: np.ndarray


def reducer(nuisances: np.ndarray, filters: np.ndarray, period: float) -> tuple[Reducer, np.ndarray]:
    """The map from the residuals of a limb to its rows, and the variance of its torques, ``[window, joint]``.

    Args:
        nuisances: responses to initial states and to torques, ``[window, residual, nuisance]``.
        filters: matrices of the servos' velocity filters, ``[joint, tick, tick]``.
        period: length of a tick [s].
    """
    windows, n = len(nuisances), len(filters)
    prior = np.ones(nuisances.shape[2])
    prior[2 * n :] = WIDE_TORQUE**2
    gram = np.einsum("wra,wrb->wab", nuisances, nuisances, optimize=True).astype(np.float64)
    covariance = np.linalg.inv(gram + np.diag(1 / prior))
    gain = np.einsum("wab,wrb->war", covariance[:, 2 * n :], nuisances, optimize=True).astype(np.float32)
    variance = np.diagonal(covariance, axis1=1, axis2=2)[:, 2 * n :].reshape(windows, n, PIECES).mean(2)
    rate = np.stack([filtered_rate_weights(matrix, period) for matrix in filters]).astype(np.float32)
    return Reducer(gain, rate), variance


def torque_responses(
    engine: WindowResiduals,
    limb: np.ndarray,
    armature: np.ndarray,
    internal_loop: bool,
    initial: np.ndarray,
    residual: np.ndarray,
    filters: np.ndarray,
    torque_unit: float,
    floor: np.ndarray,
) -> np.ndarray:
    """Whitened response to a unit of torque in one joint and piece, ``[nuisance, window, residual]``.

    A joint responds in ticks in which it moves in the log or the simulation. A servo with an internal position loop
    pulls it back as it does after an error of the initial angle.

    Args:
        engine: windows of logs.
        limb: columns of its joints.
        armature: armature of all joints [kg m^2], ``[joint]``.
        internal_loop: whether servos close the position loop themselves.
        initial: whitened responses to initial states, ``[nuisance, window, residual]``.
        residual: whitened residual of the baseline, ``[window, residual]``.
        filters: matrices of the servos' velocity filters, ``[joint, tick, tick]``.
        torque_unit: torque of the response [N m].
        floor: floors of all sensors, ``[joint, channel]``.
    """
    windows, n, ticks = len(residual), len(limb), filters.shape[1] - 1
    shape = (windows, ticks + 1, n, 3)
    mass = engine.by_window(engine.motion.dynamics.mass, end=True)[:, :, limb][:, :, :, limb] + np.diag(armature[limb])
    mobility = np.linalg.inv(mass)
    velocity = engine.by_window(engine.motion.velocity, end=True)[:, :, limb]
    moving, recorded = np.abs(velocity) > 0.02, engine.known[limb, 1]
    simulated = velocity + residual.reshape(shape)[..., 1] * np.where(recorded, floor[limb, 1], 0.0)
    moving |= recorded & (np.abs(simulated) > 0.04)
    stiffness = np.zeros((*mass.shape[:2], n))
    if internal_loop:  # otherwise the commands come from the log, without feedback
        stiffness = _loop_stiffness(engine, limb, initial[:n].reshape(n, *shape), mass)
    piece = np.arange(ticks) * PIECES // ticks
    response = np.zeros((n, PIECES, *shape), np.float32)
    for j in range(n):
        for p in range(PIECES):
            q, v = np.zeros((windows, n)), np.zeros((windows, n))
            for t in range(ticks):
                acceleration = (torque_unit if piece[t] == p else 0.0) * mobility[:, t, :, j]
                acceleration = acceleration - np.einsum("wij,wj->wi", mobility[:, t], stiffness[:, t] * q)
                v = (v + engine.period * acceleration) * moving[:, t]
                q = q + engine.period * v
                response[j, p, :, t + 1, :, 0], response[j, p, :, t + 1, :, 1] = q, v
    response[..., 1] = np.einsum("jst,apwtj->apwsj", filters, response[..., 1], optimize=True)
    response /= floor[limb].astype(np.float32)
    return response.reshape(n * PIECES, windows, -1)


def _loop_stiffness(engine: WindowResiduals, limb: np.ndarray, initial: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Stiffness of the servos' internal position loops [N m/rad], ``[window, tick, joint]``.

    Computed from the decay of an initial angle error over two ticks, ``q(t) = q0 (1 - K t^2 / 2 J)``.
    """
    time, result = 2 * engine.period, np.zeros((*mass.shape[:2], len(initial)))
    enabled = engine.motion.inputs.get("torque_enable")
    for j, response in enumerate(initial):
        remaining = np.median(response[:, 2, j, 0]) * FLOORS["joint", "position"] / INITIAL[0]
        result[..., j] = max(0.0, 2 * (1 - remaining) / time**2) * float(np.median(mass[:, 0, j, j]))
    return result if enabled is None else result * engine.by_window(enabled, end=True)[..., limb]


def filter_matrix(lag: float, shape: float, ticks: int, period: float) -> np.ndarray:
    """The servo's velocity filter as a matrix, for velocities that are linear between ticks, ``[tick, tick]``.

    Args:
        lag: `velocity_time_constant` [s].
        shape: `velocity_filter_shape`.
        ticks: length of a window.
        period: length of a tick [s]; a single step of this length is exact.
    """
    velocities, zero = np.eye(ticks + 1), np.zeros(ticks + 1)
    p = SimpleNamespace(velocity_time_constant=lag, velocity_filter_shape=shape, timestep=period)
    VelocityFilter.prepare(p)
    s = SimpleNamespace(measured_velocity=zero)
    VelocityFilter.reset(s, p)
    s.velocity_filter_velocity = velocities[0]
    filtered = [zero]
    for s.measured_velocity in velocities[1:]:
        VelocityFilter.sense(s, p)
        VelocityFilter.finish(s, p)
        filtered.append(s.measured_velocity)
    return np.stack(filtered)


def filter_matrices(parameters: Mapping[str, Tensor], joints: int, ticks: int, period: float) -> np.ndarray:
    """Matrices of the velocity filters of several servos, ``[joint, tick, tick]``; see `filter_matrix`."""
    names = ("velocity_time_constant", "velocity_filter_shape")
    rows = [np.broadcast_to(parameters[name][0].numpy() if name in parameters else 0.0, joints) for name in names]
    matrix = cache(lambda lag, shape: filter_matrix(lag, shape, ticks, period))
    return np.stack([matrix(lag, shape) for lag, shape in np.stack(rows, 1).tolist()])


def _piece_ends(ticks: int) -> list[tuple[int, int]]:
    """First and last tick of every piece whose rate is compared."""
    return list(pairwise(np.rint(np.linspace(0, ticks, PIECES + 1)).astype(int)[1:].tolist()))


def velocity_weights(ticks: int) -> np.ndarray:
    """Weights of velocities for their mean over a piece, ``[piece, tick]``."""
    weights = np.zeros((RATES, ticks + 1))
    for piece, (begin, end) in enumerate(_piece_ends(ticks)):
        weights[piece, begin : end + 1] = 1.0 / (end - begin)
        weights[piece, [begin, end]] /= 2
    return weights


def filtered_rate_weights(matrix: np.ndarray, period: float) -> np.ndarray:
    """Weights of whitened positions for their filtered rate over a piece, ``[piece, tick]``.

    Without sensor errors the result equals `velocity_weights` of whitened velocities.

    Args:
        matrix: matrix of the servo's velocity filter, ``[tick, tick]``.
        period: length of a tick [s].
    """
    scale = FLOORS["joint", "position"] / FLOORS["joint", "velocity"] / period
    weights = matrix.copy()
    weights[:, 0] -= weights.sum(1)  # the initial position does not contribute a velocity
    return np.stack(
        [scale * (weights[end] - weights[begin]) / (end - begin) for begin, end in _piece_ends(len(matrix) - 1)]
    )


def rate_variance(velocity: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Variance of the rate rows due to the sensors' floors, ``[row]``, for weights ``[piece, tick]``."""
    rotation = linalg.helmert(RATES, full=True)
    return np.square(rotation @ velocity).sum(1) + np.square(rotation @ position).sum(1)
