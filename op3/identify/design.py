"""Chooses the motions that narrow the intervals of selected parameters most per second of robot time."""

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
"""RMS residuals of open-loop replays of the stand-in by channel [rad, rad/s, A].

The model error dominates; the sensor noise is much smaller.
"""

STEP = 0.05
"""Difference step of parameters as a share of their range.

Stiction makes predictions jump under tiny changes, which would give too narrow intervals; over a step as large as an
interval the jumps average out.
"""

CORRELATION_TIME = 0.1
"""Rows of a log within this time count as one sample [s], because residuals are correlated over about this time."""

PRIOR = 12.0
"""Prior information per parameter: a uniform distribution over the range has a variance of range^2 / 12."""

WIDTH = 2 * 1.6449
"""Width of a 90 % interval in standard deviations."""


@dataclass(frozen=True, eq=False)
class PlannedRecording:
    """A library motion on a mount, with its duration [s] and its information.

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
        seconds: robot time up to the end of this recording [s].
        widths: widths of the 90 % intervals after this recording, as shares of the range, by parameter.
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
    """Fisher information about parameters in one recording, in units of their ranges.

    The motion is simulated with the model, and the log is replayed open loop with every parameter changed in both
    directions, in one batch, just as identification replays a real log.

    Args:
        model: active effects, and the parameter values for which the motions are assessed.
        bounds: range by parameter name.
        joints: compared joints; empty: all.

    Returns:
        ``[parameter, parameter]``.

    Raises:
        ValueError: if the robot falls, or a simulation diverges.
    """
    log = simulate_motion(model, motion, mount)
    if log.metadata.fallen:
        raise ValueError(f"the robot falls in motion {motion.name!r} with this model; omit the motion")
    box = Box.of(bounds)
    unit = box.unit({name: model.estimate(name).value for name in bounds})
    forward, backward = np.minimum(unit + STEP, 1.0), np.maximum(unit - STEP, 0.0)
    eye = np.eye(len(unit))
    points = box.low + box.span * np.concatenate([unit + eye * (forward - unit), unit + eye * (backward - unit)])
    values = {name: torch.from_numpy(points[:, i].copy()) for i, name in enumerate(bounds)}
    prediction = Replay([log]).run(model, values, len(points))[0]
    if bool(prediction.failed.any()):
        raise ValueError(f"a simulation of motion {motion.name!r} diverged close to this model; omit the motion")
    count = max(1.0, CORRELATION_TIME * log.metadata.rate)
    result = np.zeros((len(unit), len(unit)))
    for key, difference in TrajectoryLoss(tuple(joints)).differences(prediction).items():
        if key in NOISE:
            moved = difference.flatten(1).numpy()
            jacobian = (moved[: len(unit)] - moved[len(unit) :]) / (forward - backward)[:, None]
            result += jacobian @ jacobian.T / (NOISE[key] ** 2 * count)
    return result


def check_choice(names: Sequence[str], wanted: Sequence[str], criterion: str) -> None:
    """Check the arguments of `choose` before computing the candidates, which takes minutes."""
    unknown = [name for name in wanted if name not in names]
    if unknown:
        raise ValueError(f"design: unknown parameter {unknown[0]!r}; choose from {', '.join(names)}")
    if not wanted:
        raise ValueError("design: there are no parameters to plan for; add groups")
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
    """Greedily add the recording with the largest gain per second of robot time until the time is used up.

    Criterion D is the log volume of the wanted parameters' uncertainty; A is the sum of their variances. All other
    parameters are treated as unknown, because they may trade off against the wanted ones.

    Args:
        candidates: available recordings.
        names: parameters of the information matrices, in order.
        wanted: parameters whose intervals count.
        criterion: ``D`` or ``A``.
        seconds: total robot time [s]; the plan has at least one recording.
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
