"""The step of least squares within bounds."""

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def box_step(hessian: Array, gradient: Array, low: Array, high: Array) -> Array:
    """Minimiser of ``step' H step / 2 + gradient' step`` between bounds, ``[parameter]`` (`mju_boxQP`).

    Args:
        hessian: positive definite, ``[parameter, parameter]``; pivots below 1e-15 are refused, and the step is zero.
        gradient: ``[parameter]``.
        low: ``[parameter]``; below `high`.
        high: ``[parameter]``.
    """
    size = len(gradient)
    step = np.zeros((size, 1))
    factor = np.zeros((size, size + 7))
    mujoco.mju_boxQP(step, factor, None, hessian, gradient[:, None], low[:, None], high[:, None])
    return step[:, 0]
