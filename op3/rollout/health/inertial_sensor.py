"""Checks of the inertial sensor: gyroscope, orientation and accelerometer against each other."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import detrend
from scipy.spatial.transform import Rotation

from op3.rollout.health.finding import ERROR, FORCE, ORIENTATION, RATE, WARNING, LogFinding, View, check
from op3.rollout.health.match import WINDOW, integral, match, no_sensor, windows
from op3.rollout.health.still import held, turned_by_gyroscope
from op3.rollout.units import likely_unit

_STANDARD = 9.80665

_TILTED = 0.2
"""No sensor is mounted so crookedly, and no trunk on its feet is pushed about so much, on average [rad]: 0.1 in 180
logs."""

_FALLS = 0.5
"""A trunk that turns by so much may fall, in which its accelerometer reads less [rad]."""

_HELD = (0.02, 0.1)
"""A trunk that is held turns by less than the first, and one on its feet by more than the second [rad]: 0.019 and 0.11
in 289 logs. For some seconds one on its feet may be as still."""

_DRIFT = 0.08
"""No gyroscope is so far off on average [rad/s]."""

_MISTAKES = {"all axes read downwards": -np.eye(3)}
_MISTAKES |= {f"{'xyz'[i]} reads downwards": np.diag(1 - 2 * np.eye(3)[i]) for i in (2, 0, 1)}
_MISTAKES |= {
    f"{'xyz'[i]} and {'xyz'[j]} are swapped": np.eye(3)[[j if k == i else i if k == j else k for k in range(3)]]
    for i, j in ((0, 1), (0, 2), (1, 2))
}
"""What turns gravity round, and what takes it back, the likeliest first."""


def _rotation(angles: np.ndarray) -> Rotation:
    """Of the trunk, by roll, pitch and yaw [time, 3]."""
    return Rotation.from_euler("ZYX", angles[:, ::-1])


def _by_angles(order: Sequence[int], signs: Sequence[int] = (1, 1, 1)) -> Callable[[np.ndarray], Rotation]:
    return lambda angles: _rotation(angles[:, list(order)] * np.array(signs))


def _by_parts(order: Sequence[int]) -> Callable[[np.ndarray], Rotation]:
    return lambda angles: Rotation.from_quat(_rotation(angles).as_quat()[:, list(order)])


def _where(some: Iterable[bool]) -> str:
    return " and ".join(itertools.compress(("roll", "pitch", "yaw"), some))


_READ: dict[str, Callable[[np.ndarray], Rotation]] = {
    "its angles were in degrees": lambda angles: _rotation(np.deg2rad(angles)),
    "it were the world's in the body's frame": lambda angles: _rotation(angles).inv(),
    "the parts of its quaternion (x, y, z, w) had been written as w, x, y, z": _by_parts((1, 2, 3, 0)),
    "the parts of its quaternion (w, x, y, z) had been written as x, y, z, w": _by_parts((3, 0, 1, 2)),
    **{
        f"the sign of {_where(sign < 0 for sign in signs)} were turned round": _by_angles((0, 1, 2), signs)
        for signs in itertools.product((1, -1), repeat=3)
        if min(signs) < 0
    },
    **{
        f"{_where(at != i for i, at in enumerate(order))} were swapped": _by_angles(order)
        for order in ((1, 0, 2), (2, 1, 0), (0, 2, 1))
    },
}
"""What an orientation may be that was not read as it was meant, and what it is then."""


@check("orientation")
def orientation(view: View) -> Iterator[LogFinding]:
    """Gyroscope and accelerometer agree, and the orientation with them only when it is read in another way."""
    angles, rate, force = (view.get(key) for key in (ORIENTATION, RATE, FORCE))
    if angles is None or rate is None or force is None or len(view.time) < 20:
        return
    first, last, _ = windows(view.time)
    turned, pushed = (integral(view.time, values) for values in (rate, force))
    turned, pushed = turned[last] - turned[first], pushed[last] - pushed[first]
    if len(first) < 8 or not (turned.any() and (size := np.linalg.norm(pushed, axis=1)).all()):
        return
    rows = np.stack([first, (first + last) // 2, last])

    def misfits(read: Callable[[np.ndarray], Rotation]) -> tuple[float, float]:
        """Of how it turns with the gyroscope, as a share, and of where up is with the accelerometer."""
        before, within, after = (read(angles[one]) for one in rows)
        apart = (before.inv() * after).as_rotvec() - turned
        up = within.inv().apply([0, 0, 1]) - pushed / size[:, None]
        return float((apart**2).sum() / (turned**2).sum()), float(np.sqrt((up**2).sum(1).mean()))

    rest, off = misfits(_rotation)
    if rest < 0.5:
        return
    tried = {how: misfits(read) for how, read in _READ.items()}
    how = min(tried, key=lambda how: sum(tried[how]))
    if tried[how][0] < 0.1 and tried[how][1] < 0.5 * off:
        problem = f"gyroscope and accelerometer agree, and the orientation would with both if {how}"
        remedy = "write roll, pitch and yaw of the body in rad, in a frame whose z points up"
        yield view.found(ERROR, (ORIENTATION, 0), problem, remedy)


@check("gyroscope against orientation", unless=("orientation",))
def gyroscope(view: View) -> Iterator[LogFinding]:
    """The gyroscope and the derivative of the orientation differ in unit, sign, axes or zero; without an orientation,
    unit and sign are told by how the accelerometer tilts."""
    angles, rate, force = (view.get(key) for key in (ORIENTATION, RATE, FORCE))
    if rate is None or len(view.time) < 20:
        return
    if angles is None:
        if force is not None:
            yield from _against_gravity(view, rate, force)
        return
    read = np.ptp(turned_by_gyroscope(view), axis=0)
    still = held(view) and np.ptp(np.unwrap(angles, axis=0), axis=0).max() < _HELD[0]
    shaken = (read > _HELD[1]) & still
    for axis in np.flatnonzero(shaken):
        problem = f"the gyroscope turns by {read[axis]:.2g} rad to and fro, and neither orientation nor gravity does"
        yield view.found(WARNING, (RATE, axis), problem, "look at its unit")
    first, last, span = windows(view.time)
    if len(first) < 8:
        return
    body = (_rotation(angles[first]).inv() * _rotation(angles[last])).as_rotvec()
    summed = integral(view.time, rate)
    turned, world = summed[last] - summed[first], _rotation(angles[first]).apply(body)
    of_body, of_world = (float(((turned - one) ** 2).sum() / max((one**2).sum(), 1e-12)) for one in (body, world))
    if of_world < 0.1 and of_body > max(3 * of_world, 0.1):
        problem = "the gyroscope turns as the trunk does in the frame of the world"
        yield view.found(ERROR, (RATE, 0), problem, "turn the rates into the body's frame")
        return
    found = match(turned, body)
    bias = np.median(turned - body, axis=0) / span
    moving = found.size_b > np.maximum(4 * view.steps(ORIENTATION), 0.03 * span)
    for axis in range(3):
        own, ratio = found.correlation[axis, axis], float(found.ratio[axis, axis])
        other = int(np.abs(found.correlation[:, axis]).argmax())
        fits = abs(float(found.correlation[other, axis]))
        if moving[axis] and abs(own) > 0.9 and not ((0.5 < ratio < 2) if abs(own) < 0.97 else (0.75 < ratio < 1.35)):
            unit = likely_unit(ratio, "rad/s", 0.05)
            cause = f", as if it were in {unit}" if unit else ""
            cause = " with the sign turned round" if abs(ratio + 1) < 0.3 else cause
            problem = f"the gyroscope reads {ratio:.3g} times the change of orientation per second{cause}"
            remedy = _unit_of_rates(unit)
            yield view.found(ERROR if no_sensor(ratio) else WARNING, (RATE, axis), problem, remedy)
        elif moving[axis] and fits > 0.9 and 1 - fits < 0.1 * (1 - abs(own)) and abs(found.ratio[other, axis]) > 0.5:
            sign = "-" if found.correlation[other, axis] < 0 else ""
            problem = (
                f"turning about {'xyz'[axis]} shows as {sign}{'xyz'[other]} of the gyroscope: its axes are swapped"
            )
            remedy = "rename the axes, or turn the sensor's frame into the body's"
            yield view.found(ERROR, (RATE, axis), problem, remedy)
        elif moving[axis] and abs(own) < 0.5:
            problem = f"the gyroscope does not follow the change of orientation (correlation {own:.2f})"
            yield view.found(WARNING, (RATE, axis), problem, "look which of them is late, or another sensor's")
        elif abs(bias[axis]) > _DRIFT and not shaken[axis]:
            problem = f"the gyroscope is {bias[axis]:+.3g} rad/s off the change of orientation on average"
            yield view.found(WARNING, (RATE, axis), problem, "look at its unit and its bias, and whether yaw drifts")


def _unit_of_rates(unit: str | None) -> str:
    mends = f"write `unit: {unit}`" if unit else "write `unit:` or `sign:`"
    return f"{mends} for all axes that have it under `columns:` in the YAML, also those that hardly turned"


def _against_gravity(view: View, rate: np.ndarray, force: np.ndarray) -> Iterator[LogFinding]:
    """The gyroscope turns in another unit or sense than gravity does in the trunk."""
    first, last, span = windows(view.time)
    if len(first) < 8:
        return
    size = max(1, int(last[0] - first[0]))
    down = np.median(force[:, 2]) < 0  # which another check tells
    x, y, z = np.stack([uniform_filter1d(-axis if down else axis, size) for axis in force.T])
    tilt = np.stack([np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))], axis=1)
    summed = integral(view.time, rate[:, :2])
    found = match(summed[last] - summed[first], np.unwrap(tilt, axis=0)[last] - np.unwrap(tilt, axis=0)[first])
    for axis in (0, 1):
        own, ratio = found.correlation[axis, axis], float(found.ratio[axis, axis])
        if abs(own) > 0.9 and found.size_b[axis] > 0.03 * span and no_sensor(ratio):
            unit = likely_unit(ratio, "rad/s", 0.3)
            problem = f"the gyroscope reads {ratio:.3g} times the rate at which gravity turns in the trunk"
            problem += f", as if it were in {unit}" if unit else ""
            yield view.found(ERROR, (RATE, axis), problem, _unit_of_rates(unit))
            continue
        read, turned = (float(np.ptp(detrend(values[:, axis]))) for values in (summed, tilt))
        if read > 8 * turned + 2:
            problem = f"the gyroscope turns by {read:.2g} rad to and fro, and gravity by {turned:.2g} rad"
            yield view.found(WARNING, (RATE, axis), problem, _unit_of_rates(None))


@check("gravity", unless=("orientation",))
def gravity(view: View) -> Iterator[LogFinding]:
    """The accelerometer's size or direction is not that of gravity."""
    force, angles = view.get(FORCE), view.get(ORIENTATION)
    if force is None or not np.ptp(force, axis=0).any():
        return
    size, mean = float(np.median(np.linalg.norm(force, axis=1))), np.median(force, axis=0)
    roll, pitch = (angles[:, 0], angles[:, 1]) if angles is not None else (np.zeros(1), np.zeros(1))
    up = np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)], axis=1)
    expected = np.median(up, axis=0)
    tells = angles is not None and float(np.linalg.norm(expected)) > 0.9
    falls = bool(max(np.ptp(roll), np.ptp(pitch)) > _FALLS)
    problem = f"the median specific force is {size:.3g} m/s2"
    if size > 200 or (0.5 < size < 2 and not (tells and _apart(mean, expected) > 0.5)):
        problem += f", which looks like {'g' if size < 2 else 'mg or raw counts'}"
        yield view.found(ERROR, (FORCE, 0), problem, "convert to m/s2 (a robot at rest reads 9.81)", 0)
    elif size <= 0.5 or (tells and np.linalg.norm(mean + _STANDARD * (np.array([0, 0, 1]) - expected)) < 1):
        for axis in range(3):
            remedy = "record it with gravity; until then it is not used"
            yield view.found(WARNING, (FORCE, axis), f"{problem}: gravity was taken out of it", remedy, aside=True)
    elif not (7 if falls else 8.5) < size < 11.5:
        yield view.found(WARNING, (FORCE, 0), f"{problem}, and gravity alone is 9.81", "look at its scale and offset")
    elif angles is None and mean[2] < -8:
        problem = f"gravity reads {mean[2]:.3g} m/s2 upwards, as if the trunk hung upside down"
        remedy = "write `sign: -1` for all of its axes under `columns:` in the YAML, where it does not"
        yield view.found(WARNING, (FORCE, 2), problem, remedy)
    elif tells and mean[2] > 5 and expected[2] < -0.5:
        problem = (
            f"the orientation says that the trunk hangs upside down, and the accelerometer reads {mean[2]:.3g} m/s2 "
        )
        problem += "upwards: as if the parts of a quaternion were taken in another order (w, x, y, z or x, y, z, w)"
        yield view.found(ERROR, (ORIENTATION, 0), problem, "read the orientation again")
    elif tells and _apart(mean, expected) > (0.4 if falls else _TILTED):
        # of what may have been done to its axes, the least that brings gravity where the orientation says
        done, rest = min(_MISTAKES.items(), key=lambda item: _apart(item[1] @ mean, expected) // 0.1)
        problem = f"gravity lies along {np.round(mean / size, 2)}, and the orientation says {np.round(expected, 2)}"
        remedy = "write `sign: -1` for these under `columns:` in the YAML, or rename the axes"
        if _apart(rest @ mean, expected) < min(0.3, 0.4 * _apart(mean, expected)):
            problem += f": {done}"
        else:
            done, remedy = "", "turn the sensor's readings by as much into the body's frame"
            problem += f", {_apart(mean, expected):.2g} rad apart: the sensor is tilted in the trunk"
        yield view.found(ERROR if "all" in done else WARNING, (FORCE, int(np.abs(mean).argmax())), problem, remedy)

    else:
        yield from _leans(view, force, up)


def _leans(view: View, force: np.ndarray, up: np.ndarray) -> Iterator[LogFinding]:
    """An accelerometer that reads against the change of gravity in its axes, where the trunk leans to and fro."""
    if len(up) == 1 or np.ptp(view.time) < 10 * WINDOW:
        return
    first, last, span = windows(view.time)
    if len(first) < 8:
        return
    read, expected = (integral(view.time, values) for values in (force, _STANDARD * up))
    found = match((read[last] - read[first]) / span, (expected[last] - expected[first]) / span)
    across = np.abs(found.correlation[[0, 1], [1, 0]])
    if across.min() > 0.7 and np.abs(np.diagonal(found.correlation)[:2]).max() < 0.5 and found.size_b[:2].min() > 0.3:
        problem = "x rises and falls as gravity does in y, and y as it does in x: the two axes are swapped"
        yield view.found(WARNING, (FORCE, 0), problem, "exchange them under `columns:` in the YAML")
        return
    # its own accelerations hide gravity in part, and never turn it round
    for axis in (axis for axis in (0, 1) if found.size_b[axis] > 0.3 and found.correlation[axis, axis] < -0.3):
        problem = "it falls where the trunk leans so that gravity rises in it (correlation "
        problem += f"{found.correlation[axis, axis]:.2f}): {'xy'[axis]} has its sign turned round"
        yield view.found(WARNING, (FORCE, axis), problem, "write `sign: -1` for it under `columns:` in the YAML")


@check("mount", unless=("orientation",))
def mount(view: View) -> Iterator[LogFinding]:
    """The trunk turns on a stand, or is as still as on one while the joints move and the robot stands on its feet."""
    angles, where = view.get(ORIENTATION), view.metadata.mount
    if angles is None or where == "pendulum" or len(view.time) < 20:
        return
    turned = float(np.ptp(np.unwrap(angles[:, :2], axis=0), axis=0).max())
    moved = float(np.quantile(np.ptp(view.position, axis=0), 0.75))
    if where == "stand" and turned > _HELD[1]:
        problem = f"the trunk turns by {turned:.2g} rad, which it does not where it hangs on a stand"
        yield view.found(WARNING, "field mount", problem, "write `mount: floor`, or what it stands on")
    elif where != "stand" and np.ptp(view.time) > 5 and moved > 0.3 and turned < _HELD[0] and held(view):
        problem = f"the trunk turns by {turned:.2g} rad while joints move by {moved:.2g} rad, as if it were held"
        yield view.found(WARNING, "field mount", problem, "write `mount: stand`")


def _apart(force: np.ndarray, other: np.ndarray) -> float:
    """Angle between two directions [rad]; 0 for none."""
    size = float(np.linalg.norm(force) * np.linalg.norm(other))
    return float(np.arccos(np.clip(force @ other / size, -1, 1))) if size else 0.0
