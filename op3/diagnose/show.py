"""The gap of two models in free-run simulations of held-out logs."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from op3.common.sample_intervals import bootstrap_interval
from op3.diagnose.split import LogSplit, repeats
from op3.identify.loss import TrajectoryLoss
from op3.replay.free_runs import FreeRuns, by_second
from op3.rollout import Rollout
from op3.servo import RobotModel

REPEATS = 2
"""Budget: number of repeats of one command that are simulated; the noise floor uses all repeats."""

BEGINNING = 5.0
"""Display: simulated duration of a log of another mount [s]; a robot on the floor soon diverges from its log."""


def show(
    before: RobotModel, after: RobotModel, split: LogSplit, seed: int = 0, given: RobotModel | None = None
) -> dict[str, Any]:
    """Gaps of two models in free-run simulations of the held-out runs.

    Args:
        before: the baseline fit.
        after: the returned model.
        split: split of the logs.
        seed: seed of resampling.
        given: the given model, whose gap is included.

    Returns:
        ``gap`` by channel: ``given``, ``before``, ``after`` and ``floor`` (difference of repeats from their mean) as
        root mean squares with 90 % intervals over seconds, and ``change``: ``better`` or ``worse`` if significant;
        ``loss``: ``paper_eq7`` before and after; and the predictions.
    """
    logs = shown_logs(split)
    runs = FreeRuns(logs)
    of_before = runs.of(before)
    of_after = of_before if after is before else runs.of(after)
    of_given = None if given is None else runs.of(given)
    loss = TrajectoryLoss(tuple(logs[0].joints))
    gap = {}
    for key, unit in runs.channels.items():
        blocks = [np.concatenate(runs.squares(predictions, key)) for predictions in (of_before, of_after)]
        low, high = bootstrap_interval(blocks[0] - blocks[1], seed=seed)
        floor, change = _floor(split, key), "alike"
        if low is not None and high is not None:
            change = "better" if low > 0 else "worse" if high < 0 else "alike"
        entry: dict[str, Any] = {"unit": unit, "change": change}
        for name, squares in (("before", blocks[0]), ("after", blocks[1]), ("floor", floor)):
            entry[name] = None if squares is None else float(np.sqrt(squares.mean()))
            entry[f"{name}_interval"] = None if squares is None else _interval(squares, seed)
        if of_given is not None:
            entry["given"] = float(np.sqrt(np.concatenate(runs.squares(of_given, key)).mean()))
        entry["closure"] = _closure(entry)
        gap["/".join(key)] = entry
    losses = {"name": "paper_eq7", "before": float(loss(of_before)[0]), "after": float(loss(of_after)[0])}
    return {"gap": gap, "loss": losses, "given": of_given, "before": of_before, "after": of_after}


def on_other_mounts(
    before: RobotModel, after: RobotModel, others: dict[str, list[Rollout]], seed: int = 0
) -> dict[str, dict[str, Any]]:
    """Gap and loss of two models on the first `BEGINNING` seconds of logs to which neither was fitted, by mount.

    Returns:
        By mount the number of ``logs``, the ``seconds`` of the longest, and ``gap`` and ``loss`` as in a verdict.
    """
    result = {}
    for mount, logs in others.items():
        starts = [float(log.array("time")[0, 0]) for log in logs]
        parts = tuple(log.between(start, start + BEGINNING) for log, start in zip(logs, starts, strict=True))
        shown = show(before, after, LogSplit((), parts, repeats(parts)), seed=seed)
        longest = max(part.duration for part in parts)
        result[mount] = {"logs": len(parts), "seconds": longest, "gap": shown["gap"], "loss": shown["loss"]}
    return result


def shown_logs(split: LogSplit) -> tuple[Rollout, ...]:
    """The logs to simulate: at most `REPEATS` per command, because free-run simulations of repeats are nearly equal."""
    left_out = {i for group in split.repeats for i in group[REPEATS:]}
    return tuple(log for i, log in enumerate(split.show) if i not in left_out)


def _interval(blocks: np.ndarray, seed: int) -> list[float | None]:
    return [None if end is None else float(np.sqrt(max(end, 0.0))) for end in bootstrap_interval(blocks, seed=seed)]


def _floor(split: LogSplit, key: tuple[str, str]) -> np.ndarray | None:
    """Mean square difference of repeats from their mean, by second, ``[block]``; None without repeats."""
    squares = []
    for group in split.repeats:
        rows = min(split.show[i].rows for i in group)
        values = np.stack([split.show[i].array(key)[:rows] for i in group])
        noise, log = np.square(values - values.mean(0)).sum(0) / (len(group) - 1), split.show[group[0]]
        squares.append(by_second(noise[:, log.measured(key)].mean(1), log))
    return np.concatenate(squares) if squares else None


def _closure(entry: Mapping[str, Any]) -> float | None:
    """Share of the gap above the noise floor that was closed, computed from squares because these are additive."""
    floor = entry["floor"]
    if floor is None:
        return None
    before, after = (np.sqrt(max(entry[end] ** 2 - floor**2, 0.0)) for end in ("before", "after"))
    return float((before - after) / before) if before > 0 else None
