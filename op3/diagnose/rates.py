"""The velocity that a servo reports against the rate of its angle, as the servo's own filter would tell it.

Where the filter is the base's, both are alike whatever mechanics do, so that what is left is of the sensors.
"""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
from scipy import linalg

from op3.diagnose.judge_settings import FLOORS, PIECES
from op3.servo.effects import VelocityFilter

RATES = PIECES - 1
"""Pieces whose rates are judged: what filters remember of the time before a window is known least in the first."""

ESTIMATE = (0.01, 0.001, 1e-5)
"""How far a servo's estimate of its velocity is not known: a share of it, of its change a time [s], and of that one's
change the square of some [s^2]. Our own choice: firmware that works in steps of a millisecond, and three of these."""


def filtered(lag: float, shape: float, ticks: int, period: float) -> np.ndarray:
    """What the servo law's filter makes of velocities that are linear between ticks and none before, ``[tick, tick]``.

    Args:
        lag: `velocity_time_constant` [s].
        shape: `velocity_filter_shape`.
        ticks: length of a window.
        period: of a tick [s], in a single step of which the law is exact.
    """
    velocities, none = np.eye(ticks + 1), np.zeros(ticks + 1)
    p = SimpleNamespace(velocity_time_constant=lag, velocity_filter_shape=shape, timestep=period)
    VelocityFilter.prepare(p)
    s = SimpleNamespace(measured_velocity=none)
    VelocityFilter.reset(s, p)
    s.velocity_filter_velocity = velocities[0]
    told = [none]
    for s.measured_velocity in velocities[1:]:
        VelocityFilter.sense(s, p)
        VelocityFilter.finish(s, p)
        told.append(s.measured_velocity)
    return np.stack(told)


def _ends(ticks: int) -> list[tuple[int, int]]:
    """First and last tick of every piece of a window of which the rate is judged."""
    return list(pairwise(np.rint(np.linspace(0, ticks, PIECES + 1)).astype(int)[1:].tolist()))


def read(ticks: int) -> np.ndarray:
    """Weights of velocities for their mean over a piece of a window, ``[piece, tick]``."""
    weights = np.zeros((RATES, ticks + 1))
    for piece, (begin, end) in enumerate(_ends(ticks)):
        weights[piece, begin : end + 1] = 1.0 / (end - begin)
        weights[piece, [begin, end]] /= 2
    return weights


def moved(matrix: np.ndarray, period: float) -> np.ndarray:
    """Weights of positions for their rate over a piece, as a servo's filter tells it, ``[piece, tick]``.

    Of whitened positions they give the same as `read` of whitened velocities where nothing but mechanics acts.

    Args:
        matrix: of the servo's filter, ``[tick, tick]``.
        period: of a tick [s].
    """
    share = FLOORS["joint", "position"] / FLOORS["joint", "velocity"] / period
    told = matrix.copy()
    told[:, 0] -= told.sum(1)  # where a window begins is no speed
    return np.stack([share * (told[end] - told[begin]) / (end - begin) for begin, end in _ends(len(matrix) - 1)])


def rounding(reading: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Variance that the sensors' floors give the mean of all pieces and their differences, ``[row]``."""
    turn = linalg.helmert(RATES, full=True)
    return np.square(turn @ reading).sum(1) + np.square(turn @ moving).sum(1)
