"""Rows of windows to first order around a point of the baseline."""

from dataclasses import dataclass

import numpy as np

from op3.diagnose.coordinates import Coordinates
from op3.diagnose.responses import Reducer

Column = dict[int, np.ndarray]
"""Change of the rows of compared joints, ``[window, row]`` by joint; other joints do not change."""


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The rows of all windows to first order around a point of the baseline.

    Attributes:
        coordinates: parameters of the baseline.
        point: expansion point, ``[coordinate]``.
        reducers: reduction of each limb.
        variance: variance of the torques of each limb [torque units^2], ``[window, joint]``.
        residual: rows at the point, measured minus predicted, ``[joint, window, row]``.
        jacobian: derivatives of the prediction, ``[coordinate, joint, window, row]``.
    """

    coordinates: Coordinates
    point: np.ndarray
    reducers: tuple[Reducer, ...]
    variance: tuple[np.ndarray, ...]
    residual: np.ndarray
    jacobian: np.ndarray
