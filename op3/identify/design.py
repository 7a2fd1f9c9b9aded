"""Which motions to record: those that narrow the intervals of chosen parameters most per second of robot time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from op3.identify.loss import TrajectoryLoss
from op3.identify.sensitivity import Array, Box
from op3.motions import Motion
from op3.replay import Replay, simulate_motion
from op3.servo import RobotModel

NOISE: Mapping[tuple[str, str], float] = {
    ("imu", "orientation"): 0.01,
    ("imu", "angular_velocity"): 0.05,
    ("joint", "position"): 0.005,
    ("joint", "velocity"): 0.1,
    ("joint", "current"): 0.03,
}
"""Residuals of open-loop replays of the stand-in by channel, root mean squares [rad, rad/s, A].

The error of the model dominates; sensors are far better.
"""

STEP = 0.05
"""Parameters are moved by this share of their range.

Stiction makes predictions jump under tiny changes, which would give too narrow intervals; over a step of the size of an
interval the jumps average out.
"""

CORRELATION_TIME = 0.1
"""Rows of a log closer than this count as one sample [s]: residuals are correlated over about this time."""

PRIOR = 12.0
"""Information before any log: a uniform distribution over its range has a variance of 1/12 ranges squared."""

WIDTH = 2 * 1.6449
"""Width of a 90 % interval in standard deviations."""


@dataclass(frozen=True, eq=False)
class PlannedRecording:
    """A motion of the library on a mount, its duration [s], and its information.

    Attributes:
        information: ``[parameter, parameter]``, per range squared.
    """

    name: str
    mount: str
    duration: float
    information: Array


@dataclass(frozen=True, eq=False)
class Step:
    """One recording of a plan.

    Attributes:
        seconds: of robot time up to and with this recording [s].
        widths: of the 90 % intervals after it, as a share of the range, by parameter.
    """

    name: str
    mount: str
    seconds: float
    widths: Mapping[str, float]


def information(
    model: RobotModel,
    motion: Motion,
    mount: str,
    bounds: Mapping[str, tuple[float, float]],
    *,
    joints: Sequence[str] = (),
) -> Array:
    """Fisher information of one recording about parameters, in units of their ranges.

    The motion is simulated with the model, and the log is replayed open loop with every parameter changed in both
    directions, in one batch, as identification replays a real log.

    Args:
        model: effects that are on, and the values around which the motions are judged.
        bounds: range by parameter name.
        joints: whose traces count; all where empty.

    Returns:
        ``[parameter, parameter]``.

    Raises:
        ValueError: if the robot falls, or a simulation diverges.
    """
    log = simulate_motion(model, motion, mount)
    if log.metadata.fallen:
        raise ValueError(f"the robot falls in motion {motion.name!r} with this model; leave the motion out")
    box = Box.of(bounds)
    unit = box.unit({name: model.estimate(name).value for name in bounds})
    forward, backward = np.minimum(unit + STEP, 1.0), np.maximum(unit - STEP, 0.0)
    eye = np.eye(len(unit))
    points = box.low + box.span * np.concatenate([unit + eye * (forward - unit), unit + eye * (backward - unit)])
    values = {name: torch.from_numpy(points[:, i].copy()) for i, name in enumerate(bounds)}
    prediction = Replay([log]).run(model, values, len(points))[0]
    if bool(prediction.failed.any()):
        raise ValueError(f"a simulation of motion {motion.name!r} diverged next to this model; leave the motion out")
    count = max(1.0, CORRELATION_TIME * log.metadata.rate)
    result = np.zeros((len(unit), len(unit)))
    for key, difference in TrajectoryLoss(tuple(joints)).differences(prediction).items():
        if key in NOISE:
            moved = difference.flatten(1).numpy()
            jacobian = (moved[: len(unit)] - moved[len(unit) :]) / (forward - backward)[:, None]
            result += jacobian @ jacobian.T / (NOISE[key] ** 2 * count)
    return result


def check_choice(names: Sequence[str], wanted: Sequence[str], criterion: str) -> None:
    """Check the arguments of `choose` before its candidates are computed, which takes minutes."""
    unknown = [name for name in wanted if name not in names]
    if unknown:
        raise ValueError(f"design: unknown parameter {unknown[0]!r}; there are {', '.join(names)}")
    if not wanted:
        raise ValueError("design: there is no parameter to plan for")
    if criterion not in ("D", "A"):
        raise ValueError(f"design: criterion must be D or A, got {criterion!r}")


def choose(
    candidates: Sequence[PlannedRecording],
    names: Sequence[str],
    wanted: Sequence[str],
    *,
    criterion: str = "D",
    seconds: float = 60.0,
    overhead: float = 5.0,
    mount_change: float = 60.0,
    repeats: int = 2,
) -> list[Step]:
    """Take greedily the recording that gains most per second of robot time, until the time is used up.

    D: the logarithm of the volume of the wanted parameters' uncertainty; A: the sum of their variances. All other
    parameters count as unknown: they may trade off against the wanted ones.

    Args:
        candidates: available recordings.
        names: of the parameters of the information matrices, in order.
        wanted: those whose intervals count.
        criterion: ``D`` or ``A``.
        seconds: robot time in all [s]; at least one recording is taken.
        overhead: robot time for each recording in addition to its duration [s].
        mount_change: robot time for moving the robot to another mount [s].
        repeats: largest number of recordings of a motion.
    """
    places = [list(names).index(name) for name in wanted]
    known = np.eye(len(names)) * PRIOR
    steps: list[Step] = []
    used, mount, left = 0.0, None, [candidate for candidate in candidates for _ in range(repeats)]
    while True:
        rated: list[tuple[float, float, PlannedRecording]] = []
        for candidate in left:
            cost = candidate.duration + overhead + (mount_change if mount not in (None, candidate.mount) else 0.0)
            if steps and used + cost > seconds:
                continue
            gain = _value(known + candidate.information, places, criterion) - _value(known, places, criterion)
            rated.append((gain / cost, cost, candidate))
        if not rated:
            return steps
        _, cost, chosen = max(rated, key=lambda one: one[0])
        left.remove(chosen)
        known = known + chosen.information
        used, mount = used + cost, chosen.mount
        steps.append(Step(chosen.name, chosen.mount, used, widths(known, names)))


def widths(information_matrix: Array, names: Sequence[str]) -> dict[str, float]:
    """Width of each parameter's 90 % interval as a share of its range, at most one."""
    deviation = np.sqrt(np.diag(np.linalg.inv(information_matrix)))
    return {name: float(min(1.0, WIDTH * deviation[i])) for i, name in enumerate(names)}


def _value(information_matrix: Array, places: Sequence[int], criterion: str) -> float:
    covariance = np.linalg.inv(information_matrix)[np.ix_(places, places)]
    return -float(np.linalg.slogdet(covariance)[1]) if criterion == "D" else -float(np.trace(covariance))
