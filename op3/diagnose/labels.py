"""Whether the channels of logs belong together: names, signs and units, before anything is made of them.

Three questions need no model: does a joint follow its own command, is its velocity the rate of its position, is its
current what the gains ask for. The fourth asks a rigid body: on a stand the measured currents must carry the robot
that the names describe, better than the same robot with two names exchanged or one sign turned.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

import numpy as np
from scipy.optimize import nnls

from op3.diagnose.motion import SmoothLog, fixed_base, smooth
from op3.rollout import Rollout
from op3.servo import RobotModel

MOVES = 0.03
"""A command that moves less than this says nothing about who follows it [rad]."""

TURNS = 0.05
"""A joint that is slower than this says nothing about its velocity [rad/s]."""

FLOWS = 0.02
"""A wanted current that varies less than this says nothing about the measured one [A]."""

MODEST = 0.4
"""Wanted currents beyond this are not looked at: a bus voltage may not suffice for them [A]."""

FEWEST = 60
"""Rows that a factor is read from, at least."""

FOLLOWS = 0.5
"""Correlation that a joint has with its own command, at least, where it follows another's better."""

SPAN = 0.25
"""Velocities are compared as means over this time, which a slow filter hardly changes [s]: read row by row, one of
16 ms halved them."""

VELOCITY_RANGE = (0.6, 1.6)
"""Measured velocity over rate of the position: a filter or noise lowers it a little, a unit a lot."""

CURRENT_RANGE = (0.02, 4.0)
"""Measured over wanted current: an exhausted servo lowers it, another unit changes it by orders."""

UNITS = {
    "joint/velocity": {57.296: "degrees per second", 9.549: "rpm", 41.70: "register units of 0.229 rpm"},
    "joint/current": {1000.0: "milliamperes", 371.7: "register units of 2.69 mA"},
}
"""By channel, what a factor gives away."""

BETTER = 1.15
"""How many times more of the currents must be left unexplained under the names given than under others for the names to
be doubted. Ten legs with and without hidden effects gave at most 1.00; exchanged or turned names 1.06 to 2.5."""

TICKS = 150
"""Moments at which the rigid body is asked."""


def mislabelled(logs: Sequence[Rollout], model: RobotModel) -> tuple[str, ...]:
    """What is wrong with names, signs or units, and how to mend it; empty where nothing is.

    Args:
        logs: of one robot, with the same joints.
        model: whose limit of current is known; that its values are right is not needed.
    """
    said = [*_followers(logs), *_rates(logs), *_currents(logs, model)]
    if not said and logs[0].metadata.mount == "stand" and all("joint/current" in log for log in logs):
        said += _bodies(logs)
    return tuple(said)


def asked_current(log: Rollout) -> np.ndarray | None:
    """The current that a PD on the computer asks for, ``[time, joint]`` [A]; None where the log has no gains."""
    if not all(key in log for key in ("command/p_gain", "command/d_gain", "joint/velocity")):
        return None
    error = log.array("command/position") - log.array("joint/position")
    current = log.array("command/p_gain") * error - log.array("command/d_gain") * log.array("joint/velocity")
    return current * (log.array("command/torque_enable") if "command/torque_enable" in log else 1.0)


def _stacked(logs: Sequence[Rollout], get: Callable[[Rollout], np.ndarray]) -> np.ndarray:
    return np.concatenate([get(log) for log in logs])


def _slope(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope of y over x without their means, and their correlation."""
    x, y = x - x.mean(), y - y.mean()
    product = float(x @ y)
    return product / float(x @ x), product / max(1e-12, float(np.linalg.norm(x) * np.linalg.norm(y)))


def _followers(logs: Sequence[Rollout]) -> Iterator[str]:
    """Joints that follow another's command better than their own, or theirs the wrong way round."""
    wanted = _stacked(logs, lambda log: log.array("command/position"))
    angle = _stacked(logs, lambda log: log.array("joint/position"))
    moving = [j for j in range(wanted.shape[1]) if wanted[:, j].std() > MOVES and angle[:, j].std() > 1e-6]
    joints = logs[0].joints
    if not moving:
        return
    table = np.corrcoef(wanted[:, moving].T, angle[:, moving].T)[len(moving) :, : len(moving)]  # [angle, command]
    for row, j in enumerate(moving):
        own, other = float(table[row, row]), int(np.abs(table[row]).argmax())
        if own < -FOLLOWS:
            yield (
                f"{joints[j]} moves against its own command (correlation {own:.2f}): its sign is turned in one of the"
                " two channels; correct the sign, or its calibration, and export the logs again."
            )
        elif own < FOLLOWS and other != row and abs(float(table[row, other])) > 0.9:
            yield (
                f"{joints[j]} follows the command of {joints[moving[other]]} (correlation {table[row, other]:.2f}, with"
                f" its own {own:.2f}): columns are exchanged; correct the order of `joints`."
            )


def _spans(log: Rollout) -> tuple[np.ndarray, np.ndarray]:
    """Rate of the position, and mean of the measured velocity, over every `SPAN` of a log, ``[row, joint]``."""
    time, velocity = log.array("time")[:, 0], log.array("joint/velocity")
    count = max(1, round(SPAN / float(np.median(np.diff(time)))))
    if len(time) <= count:
        return np.zeros((0, velocity.shape[1])), np.zeros((0, velocity.shape[1]))
    position = log.array("joint/position")
    between = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(time)[:, None]
    travelled = np.concatenate([np.zeros((1, velocity.shape[1])), np.cumsum(between, 0)])
    elapsed = (time[count:] - time[:-count])[:, None]
    return (position[count:] - position[:-count]) / elapsed, (travelled[count:] - travelled[:-count]) / elapsed


def _rates(logs: Sequence[Rollout]) -> Iterator[str]:
    """Joints whose measured velocity is not the rate of their position."""
    if not all("joint/velocity" in log for log in logs):
        return
    rate = _stacked(logs, lambda log: _spans(log)[0])
    measured = _stacked(logs, lambda log: _spans(log)[1])
    yield from _factors(
        rate, measured, TURNS, VELOCITY_RANGE, logs[0].joints, "joint/velocity", "the rate of its position"
    )


def _currents(logs: Sequence[Rollout], model: RobotModel) -> Iterator[str]:
    """Joints whose measured current is not what the PD asks for."""
    asked = [asked_current(log) for log in logs]
    if "current_pd" not in model.effect_names or not all("joint/current" in log for log in logs):
        return
    if any(current is None for current in asked):
        return
    wanted = np.concatenate([current for current in asked if current is not None])
    yield from _factors(
        # more than that may be beyond what the voltage drives
        np.where(np.abs(wanted) > MODEST, np.nan, wanted),
        _stacked(logs, lambda log: log.array("joint/current")),
        FLOWS,
        CURRENT_RANGE,
        logs[0].joints,
        "joint/current",
        "what its gains ask for",
    )


def _factors(
    expected: np.ndarray,
    measured: np.ndarray,
    least: float,
    allowed: tuple[float, float],
    joints: Sequence[str],
    channel: str,
    meaning: str,
) -> Iterator[str]:
    """Joints whose channel is another multiple of what it should be; `expected` and `measured` ``[time, joint]``."""
    quantity = channel.split("/")[1]
    known = np.isfinite(expected)

    def compared(wanted: int, seen: int) -> tuple[float, float]:
        rows = known[:, wanted]
        return _slope(expected[rows, wanted], measured[rows, seen])

    moving = [j for j in range(len(joints)) if known[:, j].sum() >= FEWEST and expected[known[:, j], j].std() >= least]
    for j in moving:
        joint = joints[j]
        factor, correlation = compared(j, j)
        if correlation > FOLLOWS and allowed[0] <= factor <= allowed[1]:
            continue
        if abs(correlation) <= FOLLOWS:
            alike = {k: abs(compared(k, j)[1]) for k in moving}
            best = max(alike, key=lambda k: alike[k])
            if best != j and alike[best] > 0.8:
                yield (
                    f"The {quantity} of {joint} is that of {joints[best]} (correlation {alike[best]:.2f}): columns are"
                    " exchanged; correct the order of `joints`."
                )
            continue
        guess = min(UNITS[channel], key=lambda unit: abs(np.log(abs(factor) / unit)))
        unit = f", as in {UNITS[channel][guess]}" if 0.7 < abs(factor) / guess < 1.4 else ""
        sign = "its sign is turned" if factor < 0 else "its unit is another"
        yield (
            f"The {quantity} of {joint} is {factor:.3g} times {meaning}{unit}: {sign}; convert it"
            f" to {'rad/s' if quantity == 'velocity' else 'A'} with the sign of the joint's axis, and export the logs"
            " again."
        )


def _bodies(logs: Sequence[Rollout]) -> Iterator[str]:
    """A way of naming the joints under which the robot explains the currents much better than under theirs."""
    grids = [smooth(log) for log in logs]
    joints = logs[0].joints
    moving = [j for j in range(len(joints)) if max(float(np.ptp(g.position[:, j])) for g in grids) > MOVES]
    samples = _Samples(grids, joints)
    own = samples.unexplained(range(len(joints)), np.ones(len(joints)))
    found: list[tuple[float, str]] = []
    for j in moving:
        signs = np.ones(len(joints))
        signs[j] = -1.0
        found.append((own / samples.unexplained(range(len(joints)), signs), f"the sign of {joints[j]} were turned"))
    for a, b in combinations(moving, 2):
        order = list(range(len(joints)))
        order[a], order[b] = b, a
        left = samples.unexplained(order, np.ones(len(joints)))
        found.append((own / left, f"{joints[a]} and {joints[b]} were exchanged"))
    worst, what = max(found, default=(0.0, ""))
    if worst > BETTER:
        yield (
            f"The measured currents look as if {what}: {worst:.1f} times less of them is left unexplained that way;"
            " check names, order and signs of the joints against the robot, and record a joint that is moved by hand."
        )


class _Samples:
    """Moments of smoothed logs, and how well a rigid body with other names explains the currents in them."""

    def __init__(self, grids: Sequence[SmoothLog], joints: Sequence[str]):
        every = max(1, sum(len(g.time) for g in grids) // TICKS)
        self._parts = []
        for tilt in sorted({g.tilt for g in grids}):
            chosen = [g for g in grids if g.tilt == tilt]

            def stacked(get: Callable[[SmoothLog], np.ndarray], of: Sequence[SmoothLog] = chosen) -> np.ndarray:
                return np.concatenate([get(g)[every // 2 :: every] for g in of])

            self._parts.append(
                (
                    fixed_base(tuple(joints), tilt),
                    stacked(lambda g: g.position),
                    stacked(lambda g: g.velocity),
                    stacked(lambda g: g.acceleration),
                    stacked(lambda g: g.readings["joint", "current"]),
                )
            )

    def unexplained(self, order: Sequence[int], signs: np.ndarray) -> float:
        """Sum of the currents that torque, inertia and friction leave, where column ``order[j]`` is joint j [A]."""
        columns, wanted = [], []
        for base, *channels in self._parts:
            q, v, a, current = (value[:, list(order)] * signs for value in channels)
            along = base.along(base.mj_model, q, v)
            torque = np.einsum("tij,tj->ti", along.mass, a) + along.bias
            columns.append(np.stack([torque, a, np.tanh(v / 0.02), v], -1))
            wanted.append(current)
        features, target = np.concatenate(columns), np.concatenate(wanted)  # [time, joint, feature], [time, joint]
        # servos of one make: torque per ampere, rotor and friction are shared
        shared, wanted = features.reshape(-1, features.shape[-1]), target.reshape(-1)
        solution = nnls(shared, wanted)[0]
        return float(np.abs(wanted - shared @ solution).sum())
