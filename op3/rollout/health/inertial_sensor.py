"""Checks of the inertial sensor: consistency of gyroscope, orientation and accelerometer."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from op3.rollout.health.log_view import Found, View, check
from op3.rollout.health.stops import held, turned_by_gyroscope
from op3.rollout.keys import FORCE, ORIENTATION, RATE
from op3.rollout.match import WINDOW, as_if, is_unit, match
from op3.rollout.units import likely_unit

_STANDARD = 9.80665
_TILTED = 0.2  # smallest reported mean tilt [rad]; up to 0.1 in 180 sound logs
_FALLS = 0.5  # trunk rotation above which the robot may fall, so that its accelerometer reads less [rad]
_HELD = (0.02, 0.1)  # a held trunk turns by less, a standing one by more [rad]; 0.019 and 0.11 in 289 logs
_DRIFT = 0.08  # smallest reported gyroscope bias [rad/s]

_MISTAKES = {"all axes read downwards": -np.eye(3)}
_MISTAKES |= {f"{'xyz'[i]} reads downwards": np.diag(1 - 2 * np.eye(3)[i]) for i in (2, 0, 1)}
_SWAPS = {"x and y": (1, 0, 2), "x and z": (2, 1, 0), "y and z": (0, 2, 1)}
_MISTAKES |= {f"{axes} are swapped": np.eye(3)[list(order)] for axes, order in _SWAPS.items()}
"""Mistakes that change the direction of gravity, and the matrices that correct them, most likely first."""


def _rotation(angles: np.ndarray, order: Sequence[int] = (0, 1, 2), signs: Sequence[int] = (1, 1, 1)) -> Rotation:
    """Rotation of the trunk, by roll, pitch and yaw [time, 3] in this order and with these signs."""
    return Rotation.from_euler("ZYX", (angles[:, list(order)] * signs)[:, ::-1])


def _of_parts(angles: np.ndarray, shift: int) -> Rotation:
    """Rotation of a quaternion with cyclically shifted components."""
    return Rotation.from_quat(np.roll(_rotation(angles).as_quat(), shift, axis=1))


_READ: dict[str, Callable[[np.ndarray], Rotation]] = {
    "the angles were in degrees": lambda angles: _rotation(np.deg2rad(angles)),
    "it were the orientation of the world in the body's frame": lambda angles: _rotation(angles).inv(),
    "the components of its quaternion (x, y, z, w) had been written as w, x, y, z": partial(_of_parts, shift=-1),
    "the components of its quaternion (w, x, y, z) had been written as x, y, z, w": partial(_of_parts, shift=1),
}
_ANGLES = np.array(["roll", "pitch", "yaw"])
for _signs in itertools.product((1, -1), repeat=3):
    if _turned := " and ".join(_ANGLES[np.array(_signs) < 0]):
        _READ[f"the sign of {_turned} were reversed"] = partial(_rotation, signs=_signs)
for _order in _SWAPS.values():
    _READ[f"{' and '.join(_ANGLES[np.array(_order) != range(3)])} were swapped"] = partial(_rotation, order=_order)
"""Possible misinterpretations of an orientation, and the orientation for each of them."""


@check("orientation", ORIENTATION, RATE, FORCE, rows=20)
def orientation(view: View) -> Found:
    """Gyroscope and accelerometer are consistent, but the orientation fits them only in another convention."""
    angles, (first, last, _) = view.log.array(ORIENTATION), view.windows
    turned, pushed = (view.summed(view.log.array(key)) for key in (RATE, FORCE))
    if not view.long or not (turned.any() and (size := np.linalg.norm(pushed, axis=1)).all()):
        return

    def misfits(read: Callable[[np.ndarray], Rotation]) -> tuple[float, float]:
        """Relative misfit between the orientation's rotation and the gyroscope, and of its vertical to the
        accelerometer."""
        before, within, after = (read(angles[rows]) for rows in (first, (first + last) // 2, last))
        apart = (before.inv() * after).as_rotvec() - turned
        up = within.inv().apply([0, 0, 1]) - pushed / size[:, None]
        return float((apart**2).sum() / (turned**2).sum()), float(np.sqrt((up**2).sum(1).mean()))

    rest, off = misfits(_rotation)
    tried = {how: misfits(read) for how, read in _READ.items()} if rest >= 0.5 else {}
    for how in sorted(tried, key=lambda how: sum(tried[how]))[:1]:
        if tried[how][0] < 0.1 and tried[how][1] < 0.5 * off:
            problem = f"gyroscope and accelerometer agree; the orientation would agree with them if {how}"
            remedy = "write roll, pitch and yaw of the body in rad, in a frame whose z axis points up"
            yield view.found((ORIENTATION, 0), problem, remedy, error=True)


@check("gyroscope against orientation", RATE, rows=20, unless="orientation")
def gyroscope(view: View) -> Found:
    """The gyroscope and the derivative of the orientation differ in unit, sign, axes or zero. Without an orientation,
    unit and sign are checked against the direction of gravity in the trunk."""
    rate, (first, last, span), force = view.log.array(RATE), view.windows, view.get(FORCE)
    angles, axes, near, what = view.get(ORIENTATION), 3, 0.05, "derivative of the orientation"
    if angles is None and force is not None and view.long:  # gravity gives approximate roll and pitch
        down = np.median(force[:, 2]) < 0  # another check reports this
        x, y, z = (uniform_filter1d(-axis if down else axis, max(1, int(last[0] - first[0]))) for axis in force.T)
        angles = np.stack([np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z)), 0 * x], axis=1)
        axes, near, what = 2, 0.3, "rate at which gravity turns in the trunk"
    if angles is None:
        return
    read, turns = np.ptp(turned_by_gyroscope(view), axis=0), np.ptp(np.unwrap(angles, axis=0), axis=0)
    shaken = (read > _HELD[1]) & held(view) & (turns.max() < _HELD[0]) | (read > 8 * turns + 2)
    for axis in np.flatnonzero(shaken[:axes]):
        problem = f"the gyroscope swings by {read[axis]:.2g} rad, but the trunk turns by only {turns[axis]:.2g} rad"
        yield view.found((RATE, axis), problem, _unit_of_rates(None))
    if not view.long:
        return
    body = (_rotation(angles[first]).inv() * _rotation(angles[last])).as_rotvec()
    turned, world = view.summed(rate), _rotation(angles[first]).apply(body)
    of_body, of_world = (float(((turned - x) ** 2).sum() / max((x**2).sum(), 1e-12)) for x in (body, world))
    if axes == 3 and of_world < 0.1 and of_body > max(3 * of_world, 0.1):
        problem = "the gyroscope's rates are in the world frame"
        yield view.found((RATE, 0), problem, "rotate the rates into the body's frame", error=True)
        return
    fit, bias = match(turned, body), np.median(turned - body, axis=0) / span
    moving = fit.size_b > np.maximum(4 * view.steps(ORIENTATION) if axes == 3 else 0.0, 0.03 * span)
    for axis in range(axes):
        own, ratio, other = fit.own[axis], float(fit.ratio[axis, axis]), fit.correlation[:, axis]
        whose, odd, error = int(np.abs(other).argmax()), is_unit(ratio), False
        least, most = (0.5, 2.0) if abs(own) < 0.97 else (0.75, 1.35)
        swapped = whose != axis and abs(other[whose]) > 0.9 and 1 - abs(other[whose]) < 0.1 * (1 - abs(own))
        if moving[axis] and abs(own) > 0.9 and not least < ratio < most and (axes == 3 or odd):
            unit, error = as_if(("it", ratio, "rad/s"), tolerance=near), odd
            cause = " with the sign reversed" if abs(ratio + 1) < 0.3 else unit
            problem = f"the gyroscope reads {ratio:.3g} times the {what}{cause}"
            remedy = _unit_of_rates(likely_unit(ratio, "rad/s", near))
        elif axes < 3:
            continue
        elif moving[axis] and swapped and abs(fit.ratio[whose, axis]) > 0.5:
            shown, error = f"{'-' if other[whose] < 0 else ''}{'xyz'[whose]}", True
            problem = f"rotation about {'xyz'[axis]} appears as {shown} of the gyroscope: the axes are swapped"
            remedy = "rename the axes, or rotate the readings into the body's frame"
        elif moving[axis] and abs(own) < 0.5:
            problem = f"the gyroscope does not follow the change of orientation (correlation {own:.2f})"
            remedy = "check whether one of them is delayed or comes from another sensor"
        elif abs(bias[axis]) > _DRIFT and not shaken[axis]:
            problem = f"the gyroscope differs from the change of orientation by {bias[axis]:+.3g} rad/s on average"
            remedy = "check its unit, its bias, and whether yaw drifts"
        else:
            continue
        yield view.found((RATE, axis), problem, remedy, error=error)


def _unit_of_rates(unit: str | None) -> str:
    how = f"write `unit: {unit}`" if unit else "write `unit:` or `sign:`"
    return f"{how} for all affected axes under `columns:` in the YAML, including those that hardly turned"


@check("gravity", FORCE, unless="orientation")
def gravity(view: View) -> Found:
    """The accelerometer's readings do not have the size or direction of gravity."""
    force, angles = view.log.array(FORCE), view.get(ORIENTATION)
    if not np.ptp(force, axis=0).any():
        return
    size, mean = float(np.median(np.linalg.norm(force, axis=1))), np.median(force, axis=0)
    leans = np.zeros((1, 3)) if angles is None else angles
    up = _rotation(leans).inv().apply([0, 0, 1])
    expected, axis = np.median(up, axis=0), int(np.abs(mean).argmax())
    known = angles is not None and float(np.linalg.norm(expected)) > 0.9
    apart, falls = _apart(mean, expected) if known else 0.0, bool(np.ptp(leans[:, :2], axis=0).max() > _FALLS)
    # of the possible mistakes with the axes, the smallest one that explains the direction of gravity
    done, rest = min(_MISTAKES.items(), key=lambda item: _apart(item[1] @ mean, expected) // 0.1)
    problem, where, error = f"the median specific force is {size:.3g} m/s2", (FORCE, 0), False
    if size > 200 or (0.5 < size < 2 and not apart > 0.5):
        problem += f", which looks like {'g' if size < 2 else 'mg or raw counts'}"
        yield view.found(where, problem, "convert to m/s2 (a robot at rest reads 9.81)", 0, error=True)
        return
    if size <= 0.5 or (known and np.linalg.norm(mean + _STANDARD * (np.array([0, 0, 1]) - expected)) < 1):
        problem, remedy = f"{problem}: gravity was subtracted", "record the specific force, which includes gravity"
        yield from (view.found((FORCE, index), problem, remedy, aside=True) for index in range(3))
        return
    if not (7 if falls else 8.5) < size < 11.5:
        problem, remedy = f"{problem}, but gravity alone is 9.81", "check its scale and offset"
    elif angles is None and mean[2] < -8:
        problem, where = f"gravity reads {mean[2]:.3g} m/s2 upwards, as if the trunk hung upside down", (FORCE, 2)
        remedy = "if it did not, write `sign: -1` for all its axes under `columns:` in the YAML"
    elif known and mean[2] > 5 and expected[2] < -0.5:
        problem = f"the orientation says that the trunk hangs upside down, but z reads {mean[2]:.3g} m/s2, as if a "
        problem += "quaternion's components were in another order (w, x, y, z or x, y, z, w)"
        remedy, where, error = "correct the orientation", (ORIENTATION, 0), True
    elif apart > (0.4 if falls else _TILTED):
        problem = f"gravity lies along {np.round(mean / size, 2)}, but the orientation says {np.round(expected, 2)}"
        where, error = (FORCE, axis), _apart(rest @ mean, expected) < min(0.3, 0.4 * apart)
        problem += f": {done}" if error else f", {apart:.2g} rad apart: the sensor is mounted at an angle in the trunk"
        turn = "rotate the sensor's readings into the body's frame"
        remedy = "write `sign: -1` for these axes under `columns:` in the YAML, or rename the axes" if error else turn
        error &= "all" in done
    else:
        yield from _leans(view, force, up)
        return
    yield view.found(where, problem, remedy, error=error)


def _leans(view: View, force: np.ndarray, up: np.ndarray) -> Found:
    """The accelerometer contradicts the change of gravity in its axes while the trunk rocks."""
    span = view.windows[2]
    if len(up) == 1 or np.ptp(view.time) < 10 * WINDOW or not view.long:
        return
    fit = match(view.summed(force) / span, view.summed(_STANDARD * up) / span)
    across, own, leans = fit.correlation[[0, 1], [1, 0]], fit.own[:2], fit.size_b[:2] > 0.3
    if np.abs(across).min() > 0.7 and np.abs(own).max() < 0.5 and leans.all():
        problem = "x changes as gravity should change y, and y as gravity should change x: the two axes are swapped"
        yield view.found((FORCE, 0), problem, "swap them under `columns:` in the YAML")
        return
    # accelerations of the trunk may mask gravity but do not reverse it
    for axis in np.flatnonzero(leans & (own < -0.3)):
        problem = f"the reading decreases when the trunk's lean should increase it (correlation {own[axis]:.2f}): "
        problem += f"the sign of {'xy'[axis]} is reversed"
        yield view.found((FORCE, axis), problem, "write `sign: -1` for it under `columns:` in the YAML")


@check("mount", ORIENTATION, rows=20, unless="orientation")
def mount(view: View) -> Found:
    """The trunk rotates although the mount is a stand, or is as still as on a stand while on the ground."""
    angles, where = view.log.array(ORIENTATION), view.metadata.mount
    turned = float(np.ptp(np.unwrap(angles[:, :2], axis=0), axis=0).max())
    moved = float(np.quantile(np.ptp(view.position, axis=0), 0.75))
    still = np.ptp(view.time) > 5 and moved > 0.3 and turned < _HELD[0] and held(view)
    if where == "stand" and turned > _HELD[1]:
        problem = f"the trunk turns by {turned:.2g} rad, more than it could on a stand"
        yield view.found(
            "field mount", problem, "write `mount: floor`, or the name of the scene in which the robot stands"
        )
    elif where not in ("stand", "pendulum") and still:
        problem = f"the trunk turns by {turned:.2g} rad while joints move by {moved:.2g} rad, as if it were held"
        yield view.found("field mount", problem, "write `mount: stand`")


def _apart(force: np.ndarray, other: np.ndarray) -> float:
    """Angle between two directions [rad]; 0 if one is missing."""
    size = float(np.linalg.norm(force) * np.linalg.norm(other))
    return float(np.arccos(np.clip(force @ other / size, -1, 1))) if size else 0.0
