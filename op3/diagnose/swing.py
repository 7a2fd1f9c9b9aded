"""Free swings: parts of bench logs in which torque is off, where gear, bearing and arm show without the motor."""

from collections.abc import Callable, Sequence

import numpy as np

from op3.diagnose.diagnosis import Diagnosis
from op3.diagnose.split import LogSplit
from op3.diagnose.verdict import Verdict
from op3.rollout import Rollout
from op3.servo import RobotModel

SHORTEST = 1.0
"""Torque must be off for so long that a swing tells something [s]."""

STILL = 0.005
"""A pendulum that has moved less than this since torque went off has not been released yet [rad]."""

FEWEST = 4
"""Swings that a diagnosis takes: one that shows, one that chooses, the others to be fitted."""

DRIVEN = ("position_servo", "minimum_duty", "latency", "voltage_sag", "packet_drop")
"""Effects that act through the motor, which a servo without torque does not show."""


def swings(logs: Sequence[Rollout]) -> list[Rollout]:
    """What follows the release of a held pendulum, of every log that ends with torque off.

    A swing begins with the last row before the pendulum moves, since a command to switch off acts a little later.
    """
    found = []
    for log in logs:
        if log.metadata.mount != "pendulum" or "command/torque_enable" not in log:
            continue
        on = np.flatnonzero(log.array("command/torque_enable")[:, 0] > 0.5)
        time, position = log.array("time")[:, 0], log.array("joint/position")[:, 0]
        off = 0 if not len(on) else int(on[-1]) + 1
        if off >= len(time) or time[-1] - time[off] < SHORTEST:
            continue
        moved = np.abs(position[off:] - position[off]) > STILL
        begin = off + max(0, int(moved.argmax()) - 1)
        if moved.any() and time[-1] - time[begin] >= SHORTEST:
            found.append(log.between(float(time[begin]), float(time[-1]) + 1.0))
    return found


def split_swings(parts: Sequence[Rollout], seed: int = 0) -> LogSplit:
    """Swings by what they are used for: a fifth shows, a fifth chooses, the others are fitted; at least `FEWEST`."""
    order = np.random.default_rng([seed, 17]).permutation(len(parts))
    share = max(1, len(parts) // 5)
    show, select, fit = order[:share], order[share : 2 * share], order[2 * share :]
    return LogSplit(*(tuple(parts[i] for i in sorted(which.tolist())) for which in (fit, select, show)))


def diagnose_swings(
    model: RobotModel,
    logs: Sequence[Rollout],
    *,
    seed: int = 0,
    rounds: int = 2,
    without: Sequence[str] = (),
    progress: Callable[[str, float], None] | None = None,
) -> Verdict | None:
    """What a model lacks while the servo is switched off; None where there are too few free swings.

    Args:
        model: from which the refit starts.
        logs: all of a bench.
        seed: of split and resampling.
        rounds: effects that may be named.
        without: names of effects not to consider.
        progress: called with the stage and the share done.
    """
    parts = swings(logs)
    if len(parts) < FEWEST:
        return None
    split = split_swings(parts, seed)
    return Diagnosis(model, split, seed=seed, without=(*DRIVEN, *without), progress=progress).run(rounds)
