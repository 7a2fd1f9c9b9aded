"""Effect of a diagnosis on a policy: its predicted returns before and after, and its measured return."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from op3.common.sample_intervals import bootstrap_interval
from op3.policy import PolicyBundle
from op3.rollout import Rollout
from op3.servo import RobotModel
from op3.tasks.evaluation import evaluation_return
from op3.tasks.task import Task, find_task
from op3.transfer.returns import ReturnsBench


def downstream(
    policy: PolicyBundle,
    before: RobotModel,
    after: RobotModel,
    *,
    task: str | Task = "balance_eval",
    episodes: int = 10,
    actual: Sequence[Rollout] = (),
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> dict[str, Any]:
    """The return R_eval of a policy under two models and, if episodes were recorded, on the robot.

    Args:
        task: task of the episodes, the same as on the robot.
        actual: logs of single episodes of the same policy and task on the robot.
        progress: function called with the stage and the completed share.

    Returns:
        ``task``, ``episodes``, and under ``before``, ``after`` and, if given, ``actual``: ``mean``, its 90 %
        ``interval`` over episodes, ``fallen``, the share of falls. With ``actual`` also ``error_before`` and
        ``error_after``, the differences between predictions and measurement.
    """
    result: dict[str, Any] = {"task": find_task(task).name, "episodes": episodes}
    for number, (label, model) in enumerate((("before", before), ("after", after))):
        if label == "after" and after is before:
            result["after"] = dict(result["before"])
            continue
        returns = ReturnsBench(policy, model, task, episodes, seed, num_threads=1).run()
        values = returns.returns[0].numpy()
        result[label] = _summary(values[np.isfinite(values)], float(returns.fallen[0].double().mean()))
        if progress is not None:
            progress("returns", 0.5 * (number + 1))
    if actual:
        values = np.array([evaluation_return(log, task) for log in actual])
        fallen = float(np.mean([bool(log.metadata.fallen) for log in actual]))
        result["actual"] = _summary(values, fallen)
        for label in ("before", "after"):
            mean = result[label]["mean"]
            result[f"error_{label}"] = None if mean is None else abs(mean - result["actual"]["mean"])
    return result


def _summary(values: np.ndarray, fallen: float) -> dict[str, Any]:
    """Mean and interval of returns; None if every simulation failed."""
    if not len(values):
        return {"mean": None, "interval": None, "fallen": fallen}
    return {"mean": float(values.mean()), "interval": list(bootstrap_interval(values)), "fallen": fallen}
