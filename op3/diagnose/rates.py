"""The velocity that a servo reports against the rate of its angle, as the servo's own filter would tell it.

Where the filter is the base's, both are alike whatever mechanics do, so that what is left is of the sensors.
"""

from itertools import pairwise

import numpy as np
from scipy import linalg, signal

from op3.diagnose.features import FLOORS, PIECES

RATES = PIECES - 1
"""Pieces whose rates are judged: what filters remember of the time before a window is known least in the first."""

ESTIMATE = (0.01, 0.001, 1e-5)
"""How far a servo's estimate of its velocity is not known: a share of it, of its change a time [s], and of that one's
change the square of some [s^2]. Our own choice: firmware that works in steps of a millisecond, and three of these."""


def filtered(lag: float, shape: float, ticks: int, period: float) -> np.ndarray:
    """What a velocity filter makes of velocities that are linear between ticks and none before, ``[tick, tick]``.

    Args:
        lag: `velocity_time_constant` [s].
        shape: `velocity_filter_shape`.
        ticks: length of a window.
        period: of a tick [s].
    """
    if lag < 1e-6:
        return np.eye(ticks + 1)
    system = signal.TransferFunction([1.0], [max(shape, 1e-6) * lag**2, lag, 1.0])
    told = np.zeros((2, ticks + 1))
    for row, hat in zip(told, np.eye(2, ticks + 1), strict=True):
        row[:] = signal.lsim(system, hat, period * np.arange(ticks + 1))[1]
    later = linalg.toeplitz(np.concatenate([[0.0], told[1, 1:]]), np.zeros(ticks + 1))
    matrix = np.zeros((ticks + 1, ticks + 1))
    matrix[:, 0] = told[0]
    matrix[1:, 1:] = later[1:, :-1]
    return matrix


def rates(matrix: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Weights ``[piece, tick]`` of velocities for their mean over a piece of a window, and of positions for their rate.

    Both are of whitened readings and alike where nothing but mechanics acts.

    Args:
        matrix: of the servo's filter, ``[tick, tick]``.
        period: of a tick [s].
    """
    ticks = len(matrix) - 1
    ends = np.rint(np.linspace(0, ticks, PIECES + 1)).astype(int)
    share = FLOORS["joint", "position"] / FLOORS["joint", "velocity"] / period
    told = matrix.copy()
    told[:, 0] -= told.sum(1)  # where a window begins is no speed
    read, moved = np.zeros((2, RATES, ticks + 1))
    for piece, (begin, end) in enumerate(pairwise(ends[1:])):
        read[piece, begin : end + 1] = 1.0 / (end - begin)
        read[piece, [begin, end]] /= 2
        moved[piece] = share * (told[end] - told[begin]) / (end - begin)
    return read, moved


def rounding(read: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Variance that the sensors' floors give the mean of all pieces and their differences, ``[row]``."""
    turn = linalg.helmert(RATES, full=True)
    return np.square(turn @ read).sum(1) + np.square(turn @ moved).sum(1)
