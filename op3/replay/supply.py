"""The supply voltage between two readings, modelled as open-circuit voltage and drop due to currents.

Servos report their voltage once per control period, and it falls by more than half a volt as soon as a command reaches
a few of them. A voltage held between readings would be wrong for a whole period in which it limits a current.
"""

from collections.abc import Sequence

import numpy as np

from op3.replay.smoothing import SmoothLog

EXPLAINED = 0.5
"""Share of the voltage's changes from tick to tick that the currents must explain."""

HIGHEST = 1.5
"""Largest plausible internal resistance of a supply [ohm]."""

STEADY = 0.25
"""Time to each side over which the open-circuit voltage, which changes slowly, is averaged [s]."""

ROUNDED = 0.1
"""Unit of an unknown servo's voltage [V], the same for all makes in `assets/servos`."""

TELLING = 0.2
"""Smaller changes of the voltage do not determine a resistance [V]."""


def open_voltages(logs: Sequence[SmoothLog]) -> tuple[float, list[np.ndarray]]:
    """Internal resistance of the supply [ohm], and its open-circuit voltage in every log ``[tick, joint]`` [V].

    If the currents do not explain the changes of the voltage, the resistance is 0 and the voltages are measured ones.

    Args:
        logs: logs of one robot with bus voltage and currents.
    """
    measured = [log.inputs["bus_voltage"] for log in logs]
    drawn = [np.abs(log.readings["joint", "current"]).sum(1) for log in logs]
    fall = np.concatenate([np.diff(voltage.mean(1)) for voltage in measured])
    rise = np.concatenate([np.diff(current) for current in drawn])
    strength = float(rise @ rise)
    if np.abs(fall).max() < TELLING or strength <= 0.0:
        return 0.0, measured
    resistance = -float(fall @ rise) / strength
    left = fall + resistance * rise
    if not 0.0 < resistance < HIGHEST or left @ left > (1.0 - EXPLAINED) * (fall @ fall):
        return 0.0, measured
    opened = [voltage + resistance * current[:, None] for voltage, current in zip(measured, drawn, strict=True)]
    steady = [_mean_around(voltage, round(STEADY / log.period)) for voltage, log in zip(opened, logs, strict=True)]
    noise = np.concatenate([a - b for a, b in zip(opened, steady, strict=True)])
    # a board, arms or another load on the same supply: the remainder is not rounding, so no resistance fits
    units = [make.counts.voltage.si for log in logs for make in log.log.servos if make is not None]
    if noise.std() > max(units, default=ROUNDED):
        return 0.0, measured
    return resistance, steady


def _mean_around(values: np.ndarray, half: int) -> np.ndarray:
    """Mean over a number of rows on each side, fewer at the ends."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, 0)])
    rows = np.arange(len(values))
    first, last = np.maximum(rows - half, 0), np.minimum(rows + half + 1, len(values))
    return (total[last] - total[first]) / (last - first)[:, None]
