"""Checks of the inertial sensor: gyroscope, orientation and accelerometer against each other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from op3.rollout.health.finding import ERROR, WARNING, Finding, View, check
from op3.rollout.health.match import integral, match, step, windows
from op3.rollout.units import likely_unit

_ORIENTATION, _RATE, _FORCE = ("imu", "orientation"), ("imu", "angular_velocity"), ("imu", "linear_acceleration")


@check("gyroscope against orientation")
def gyroscope(view: View) -> Iterator[Finding]:
    """The gyroscope and the derivative of the orientation differ in unit, sign or axes."""
    angles, rate = view.get(_ORIENTATION), view.get(_RATE)
    if angles is None or rate is None or len(view.time) < 20:
        return
    first, last, span = windows(view.time)
    if len(first) < 8:
        return
    roll, pitch, _ = angles[(first + last) // 2].T
    rolled, pitched, yawed = np.diff(np.unwrap(angles, axis=0)[np.stack([first, last])], axis=0)[0].T
    # body rates of R = Rz(yaw) Ry(pitch) Rx(roll)
    about_x = rolled - yawed * np.sin(pitch)
    about_y = pitched * np.cos(roll) + yawed * np.sin(roll) * np.cos(pitch)
    body = np.stack([about_x, about_y, yawed * np.cos(roll) * np.cos(pitch) - pitched * np.sin(roll)], axis=1)
    summed = integral(view.time, rate)
    found = match(summed[last] - summed[first], body)
    drift, turned_on = summed[-1] / np.ptp(view.time), np.abs(body).max(0) / span
    for axis in np.flatnonzero((np.abs(drift) > 0.25) & (turned_on < 0.05)):
        problem = f"the gyroscope turns at {drift[axis]:.3g} rad/s on average while the orientation stands still"
        yield view.found(WARNING, (_RATE, axis), problem, "look at its unit and its bias")
    for axis in np.flatnonzero(found.size_b > np.maximum(4 * step(angles), 0.08 * span)):
        own, ratio = found.correlation[axis, axis], float(found.ratio[axis, axis])
        other = int(np.abs(found.correlation[:, axis]).argmax())
        if abs(own) > 0.9 and not 0.5 < ratio < 2:
            unit = likely_unit(ratio, "rad/s")
            cause = f", as if it were in {unit}" if unit else ""
            cause = " with the sign turned round" if abs(ratio + 1) < 0.3 else cause
            problem = f"the gyroscope reads {ratio:.3g} times the change of orientation per second{cause}"
            remedy = "convert it to rad/s in the body frame, or write `scale:`"
            yield view.found(ERROR, (_RATE, axis), problem, remedy)
        elif abs(own) < 0.5 and abs(found.correlation[other, axis]) > 0.95:
            sign = "-" if found.correlation[other, axis] < 0 else ""
            problem = (
                f"turning about {'xyz'[axis]} shows as {sign}{'xyz'[other]} of the gyroscope: its axes are swapped"
            )
            remedy = "name the axes anew, or turn the sensor's frame into the body's"
            yield view.found(ERROR, (_RATE, axis), problem, remedy)


@check("gravity")
def gravity(view: View) -> Iterator[Finding]:
    """The accelerometer's size or direction is not that of gravity."""
    force, angles = view.get(_FORCE), view.get(_ORIENTATION)
    if force is None:
        return
    size = float(np.median(np.linalg.norm(force, axis=1)))
    if 0.5 < size < 2 or size > 200:
        problem = f"the median specific force is {size:.4g} m/s2, which looks like "
        problem += "g" if size < 2 else "mg or raw counts"
        yield view.found(ERROR, (_FORCE, 0), problem, "convert to m/s2 (a robot at rest reads 9.81)", 0)
    elif size <= 0.5 and np.ptp(force, axis=0).any():
        problem = f"the median specific force is {size:.3g} m/s2: gravity was taken out of it"
        for axis in range(3):
            yield view.found(
                WARNING, (_FORCE, axis), problem, "record it with gravity; until then it is not used", aside=True
            )
    elif angles is not None and 7 < size < 13:
        yield from _direction(view, force, angles)


def _direction(view: View, force: np.ndarray, angles: np.ndarray) -> Iterator[Finding]:
    """Where gravity is found, against where the orientation says that it is."""
    roll, pitch = angles[:, 0], angles[:, 1]
    up = np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)], axis=1)
    mean, expected = np.median(force, axis=0), np.median(up, axis=0)
    cosine = float(mean @ expected / max(np.linalg.norm(mean) * np.linalg.norm(expected), 1e-9))
    if np.linalg.norm(expected) < 0.9 or cosine > 0.6:
        return
    if cosine < -0.9:
        problem = "the accelerometer reads gravity downwards, where its reaction upwards belongs"
        yield view.found(ERROR, (_FORCE, 2), problem, "turn the sign of all three axes round")
    else:
        axis = "xyz"[int(np.abs(mean).argmax())]
        problem = f"gravity shows on {axis} of the accelerometer, and the orientation says {np.round(expected, 2)}"
        remedy = "name the axes anew, or turn the sensor's frame into the body's"
        yield view.found(WARNING, (_FORCE, 0), problem, remedy)
