"""Numbers refitted on whole runs: windows tell laws apart, whole runs tell how large they are.

A hundredth of inertia or of friction is lost in a window among what its sensors make of noise; over the seconds of a
free swing it adds up. What whole runs do not tell stays as the windows say it.
"""

from collections.abc import Sequence

import numpy as np
import torch

from op3.diagnose.base import Baseline
from op3.identify.loss import TrajectoryLoss, position_error
from op3.identify.refine import refine
from op3.identify.sensitivity import Box
from op3.replay import Replay
from op3.replay.free_runs import settle_time
from op3.replay.setups import BENCH_CONTROL_PERIOD
from op3.replay.windows import LENGTHS
from op3.rollout import Rollout

REACH = 50.0
"""Standard deviations of the windows by which a number may move: what they model wrong is no noise."""


def on_whole_runs(base: Baseline, logs: Sequence[Rollout]) -> np.ndarray | None:
    """The point of a base at which it predicts the angles of whole runs best, by its shared numbers.

    None where that costs too much, which it does but for the closed form of a bench, or whole runs tell nothing.

    Differences beyond the median count less than their squares (pseudo-Huber), as in some runs something else happens.
    A window's length counts as one reading, the windows' numbers as a prior, as wide as the base's own.
    """
    if logs[0].metadata.mount != "pendulum":
        return None
    coordinates, at = base.coordinates, [i for i, e in enumerate(base.coordinates.entries) if e.joints is None]
    step = BENCH_CONTROL_PERIOD * (1 if coordinates.model.stiff else 2)
    replay = Replay(logs, settle=settle_time(logs), bench_timestep=step, num_threads=1)
    first = replay.run(coordinates.model, coordinates.values(base.point[None]))
    usual = float(position_error(first).nanmedian())
    if not usual > 0.0:  # all diverged, or nothing is left
        return None
    loss = TrajectoryLoss(weights={("joint", "position"): 1.0}, robust_scale=usual)
    reading = np.sqrt(float(loss(first)[0]) / sum(log.duration for log in logs) * LENGTHS["pendulum"])
    reach = REACH * np.sqrt(np.diag(np.linalg.inv(base.fit.precision)))[at]
    low = np.maximum(coordinates.low[at], base.point[at] - reach)
    high = np.minimum(coordinates.high[at], base.point[at] + reach)

    def residuals(unit: torch.Tensor) -> torch.Tensor:
        points = np.tile(base.point, (len(unit), 1))
        points[:, at] = low + unit.numpy() * (high - low)
        away = (points - base.point)[:, at] / coordinates.deviation[at] * reading
        predictions = replay.run(coordinates.model, coordinates.values(points), len(points))
        return torch.cat([loss.residuals(predictions), torch.from_numpy(away)], 1)

    box, point = Box(tuple(map(str, at)), low, high - low), base.point.copy()
    found = refine(residuals, box, [{str(i): float(point[i]) for i in at}], max_iterations=8)
    point[at] = list(found.values.values())
    return point
