"""Refit of a bench's shared parameters on whole runs: windows distinguish laws, but whole runs give precise sizes.

An error of one percent in inertia or friction is below the noise of a window, but accumulates over seconds of a free
swing. Parameters that whole runs do not determine keep their values from the windows.
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
"""Numerical: largest change of a parameter in posterior standard deviations, which do not include model errors."""


def on_whole_runs(base: Baseline, logs: Sequence[Rollout]) -> np.ndarray | None:
    """The baseline's point with shared parameters refitted to the angles of whole runs.

    None for robots, because this would be too slow, or if all simulations diverge. The loss is pseudo-Huber, and all
    readings within the length of a window together count as one. The prior mean is the fit of the windows, with the
    baseline's prior deviations.
    """
    if logs[0].metadata.mount != "pendulum":
        return None
    coordinates = base.coordinates
    shared = [i for i, entry in enumerate(coordinates.entries) if entry.joints is None]
    step = BENCH_CONTROL_PERIOD * (1 if coordinates.model.stiff else 2)
    replay = Replay(logs, settle=settle_time(logs), bench_timestep=step, num_threads=1)
    predicted = replay.run(coordinates.model, coordinates.values(base.point[None]))
    median = float(position_error(predicted).nanmedian())
    if not median > 0.0:  # all diverged
        return None
    loss = TrajectoryLoss(weights={("joint", "position"): 1.0}, robust_scale=median)
    reading = np.sqrt(float(loss(predicted)[0]) / sum(log.duration for log in logs) * LENGTHS["pendulum"])
    reach = REACH * np.sqrt(np.diag(np.linalg.inv(base.fit.precision)))[shared]
    low = np.maximum(coordinates.low[shared], base.point[shared] - reach)
    high = np.minimum(coordinates.high[shared], base.point[shared] + reach)

    def residuals(unit: torch.Tensor) -> torch.Tensor:
        points = np.tile(base.point, (len(unit), 1))
        points[:, shared] = low + unit.numpy() * (high - low)
        prior = (points - base.point)[:, shared] / coordinates.deviation[shared] * reading
        predictions = replay.run(coordinates.model, coordinates.values(points), len(points))
        return torch.cat([loss.residuals(predictions), torch.from_numpy(prior)], 1)

    box, point = Box(tuple(map(str, shared)), low, high - low), base.point.copy()
    refined = refine(residuals, box, [{str(i): float(point[i]) for i in shared}], max_iterations=8)
    point[shared] = list(refined.values.values())
    return point
