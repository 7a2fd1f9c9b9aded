"""Where a refit begins when the base stands for the effect it asks for, and no step along a Jacobian leads there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.optimize import nnls

from op3.diagnose.coordinates import Coordinates
from op3.servo.law import stribeck_fade

CURVE = ("coulomb_friction", "static_friction_excess", "viscous_friction", "stribeck_velocity")
"""Parameters of a base's friction over speed; where static friction fades comes last."""

FADES = (0.05, 0.07, 0.1, 0.14, 0.2, 0.3)
"""Speeds over which static friction may fade in a curve that is drawn anew [rad/s]."""

DRAGS = (0.006, 0.012, 0.024)
"""Drags that are tried [N m s^2/rad^2]."""

LAGS = ("current_time_constant", "velocity_time_constant")
"""Lags of a base that stand for a latency where it has none."""

LAGGING = 2.0
"""Standard deviations beyond what is expected of a lag from which it may stand for one."""

DELAYS = (0.002, 0.004, 0.006, 0.01)
"""Latencies that are tried [s]. One of 6.6 ms was 1.7 ms of current loop and 4 ms of filter in a base, four and three
standard deviations beyond what is expected; refitted from there it explained 0.02, from behind the ridge 0.12."""

SPEEDS = 80
"""Speeds at which two curves are compared, equally many of the robot's rows between any two."""


def exchanged(coordinates: Coordinates, point: np.ndarray, other: str, amounts: Sequence[float]) -> list[np.ndarray]:
    """Starts at which a hypothesis has taken over what a parameter of the base stands for.

    A lag looks like a delay of the same length: between the two lies a ridge that no step along a Jacobian crosses.

    Args:
        coordinates: base and hypothesis; none start where that is more than one number.
        point: of the base's coordinates, ``[coordinate]``.
        other: the base's parameter.
        amounts: that change from one to the other.
    """
    names = [entry.parameter for entry in coordinates.entries[: len(point)]]
    if len(coordinates) != len(point) + 1 or other not in names:
        return []
    starts = []
    for amount in amounts:
        start = np.append(point, coordinates.entries[-1].prior + amount)
        start[names.index(other)] -= amount
        starts.append(np.clip(start, coordinates.low, coordinates.high))
    return starts


def delayed(coordinates: Coordinates, point: np.ndarray, amounts: Sequence[float] = DELAYS) -> list[np.ndarray]:
    """Starts at which a latency has taken over what lags of the base stand for, which are as is expected of them again.

    Without a latency the base lags in its current loop and in its velocity filter, as far as these can stand for it:
    two numbers that have to change at once for it to come back.

    Args:
        coordinates: base and hypothesis; none start where that is more than one number, or no lag is larger than
            expected by `LAGGING`.
        point: of the base's coordinates, ``[coordinate]``.
        amounts: of latency that are tried [s].
    """
    lags = [i for i, e in enumerate(coordinates.entries[: len(point)]) if e.parameter in LAGS and e.joints is None]
    apart = [(point[i] - coordinates.entries[i].prior) / coordinates.entries[i].deviation for i in lags]
    if len(coordinates) != len(point) + 1 or max(apart, default=0.0) < LAGGING:
        return []
    starts = []
    for amount in amounts:
        start = np.append(point, amount)
        start[lags] = [coordinates.entries[i].prior for i in lags]
        starts.append(np.clip(start, coordinates.low, coordinates.high))
    return starts


def redrawn(
    coordinates: Coordinates, point: np.ndarray, speeds: np.ndarray, drags: Sequence[float] = DRAGS
) -> list[np.ndarray]:
    """Starts at which a drag over v |v| has taken its part of the base's friction, and the curve stays as it was.

    Without the drag a base bends its curve by little Coulomb friction, much static friction that fades late, and much
    viscous friction: F(v) = Fc + Fs exp(-(v / vs)^2) + b v. All four have to change at once for it to come back.

    Args:
        coordinates: base and hypothesis; none start where that is more than one number, or joints have curves of their
            own only.
        point: of the base's coordinates, ``[coordinate]``.
        speeds: that the robot had [rad/s], any shape.
        drags: how much of it [N m s^2/rad^2].
    """
    places = _shared(coordinates, len(point))
    if len(coordinates) != len(point) + 1 or any(name not in places for name in CURVE):
        return []
    v = np.quantile(np.abs(speeds), np.linspace(0.02, 0.998, SPEEDS))
    coulomb, excess, viscous, fade = (point[places[name]] for name in CURVE)
    curve = _shapes(v, fade) @ np.array([coulomb, excess, viscous])
    starts = []
    for drag in drags:
        parts, fade = _drawn(v, curve - drag * v**2)
        start = np.append(point, drag)
        start[[places[name] for name in CURVE]] = [*parts, fade]
        starts.append(np.clip(start, coordinates.low, coordinates.high))
    return starts


def _drawn(v: np.ndarray, curve: np.ndarray) -> tuple[np.ndarray, float]:
    """Coulomb, static and viscous friction, and the speed over which the static one fades, nearest to a curve."""
    fits = [nnls(_shapes(v, fade), curve) for fade in FADES]
    nearest = min(range(len(FADES)), key=lambda n: fits[n][1])
    return fits[nearest][0], FADES[nearest]


def _shapes(v: np.ndarray, fade: float) -> np.ndarray:
    """Coulomb, static and viscous friction of size one over speed, ``[speed, 3]``."""
    near_rest = stribeck_fade(torch.from_numpy(v), torch.tensor(fade, dtype=torch.float64), gaussian=True).numpy()
    return np.stack([np.ones_like(v), near_rest, v], 1)


def _shared(coordinates: Coordinates, known: int) -> dict[str, int]:
    """Where the first coordinates say what all joints have, or all but the faulty ones."""
    most = max((len(entry.joints or ()) for entry in coordinates.entries[:known]), default=0)
    return {
        entry.parameter: place
        for place, entry in enumerate(coordinates.entries[:known])
        if entry.kind == "value" and (entry.joints is None or (len(entry.joints) > 1 and 2 * len(entry.joints) > most))
    }
