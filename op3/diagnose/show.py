"""The gap before and after, in free runs over logs that no earlier stage has seen."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from op3.diagnose.free_run import settle_time
from op3.diagnose.split import LogSplit
from op3.identify.loss import TrajectoryLoss
from op3.robot import pose
from op3.robot.joints import JOINTS, whole_limbs
from op3.rollout import Rollout
from op3.servo import RobotModel
from op3.tasks import Prediction, Replay

RESAMPLES = 500
"""Bootstrap resamples of runs and seconds."""

REPEATS = 2
"""Repeats of one command that are simulated; all of them tell the floor."""

CHANNELS = {("joint", "position"): "rad", ("joint", "velocity"): "rad/s", ("joint", "current"): "A"}
"""Channels whose gap is shown, and their units."""


def with_whole_limbs(log: Rollout) -> Rollout:
    """A log of some joints on the stand as one of their limbs, whose other joints are held in the pose "stand"."""
    joints = whole_limbs(log.joints)
    if log.metadata.mount != "stand" or log.joints == joints:
        return log
    columns = [joints.index(joint) for joint in log.joints]
    standing, rows = pose("stand")[[JOINTS.index(joint) for joint in joints]], log.rows
    fill = {"position": standing, "p_gain": 6.0, "d_gain": 0.1, "torque_enable": 1.0, "temperature": 25.0}
    arrays: dict[Any, np.ndarray] = {}
    for key in log.channels:
        value = log.array(key)
        if key[0] not in ("joint", "command"):
            arrays[key] = value
            continue
        other = float(value.mean()) if key[1] == "voltage" else fill.get(key[1], 0.0)
        whole = np.tile(np.broadcast_to(other, len(joints)).astype(float), (rows, 1))
        whole[:, columns] = value
        arrays[key] = whole
    return Rollout.from_arrays(arrays, log.metadata.replace(joints=joints))


def free_runs(model: RobotModel, logs: Sequence[Rollout]) -> list[Prediction]:
    """Closed-loop predictions of whole logs, from their first rows and commands alone."""
    return _replay(logs).run(model)


def _replay(logs: Sequence[Rollout]) -> Replay:
    # a few logs keep one thread busy; handing their steps to more took three times the processor time
    return Replay([with_whole_limbs(log) for log in logs], settle=settle_time(logs), num_threads=1)


def show(
    before: RobotModel,
    after: RobotModel,
    split: LogSplit,
    progress: Callable[[float], None] | None = None,
    seed: int = 0,
    known: Sequence[Prediction] | None = None,
    faulty: Sequence[str] = (),
) -> dict[str, Any]:
    """Gaps of two models on the runs that show.

    Args:
        before: the refitted base.
        after: the model with what was named.
        split: whose ``show`` logs are simulated.
        progress: called with the share done.
        seed: of the bootstrap.
        known: free runs of the refitted base, where they have been simulated.
        faulty: joints of which each was named alone. What became better in one of them became better.

    Returns:
        ``gap`` by channel with ``before``, ``after``, ``floor``, ``ceiling`` (None, see `with_ceiling`) and
        ``systematic`` (what all repeats have in common, under the first model) as root mean squares over all joints of
        the logs; before, after, floor and ceiling with a 90 % interval over seconds; ``loss`` with ``paper_eq7`` before
        and after; ``vetoed``, see `vetoed`; and the predictions.
    """
    logs = shown_logs(split)
    replay = _replay(logs)
    first = replay.run(before) if known is None else known
    if progress is not None:
        progress(0.5)
    second = first if after is before else replay.run(after)
    joints = logs[0].joints
    loss = TrajectoryLoss(tuple(joints))
    old, new = float(loss(first)[0]), float(loss(second)[0])
    gap = {}
    rng = np.random.default_rng([seed, 13])
    improved, worsened = False, False
    for key, unit in CHANNELS.items():
        if not all(key in log for log in logs):
            continue
        blocks = [_blocks(split, predictions, logs, key) for predictions in (first, second)]
        low, high = _difference(blocks[0], blocks[1], rng)
        improved |= low > 0 or any(_better_in(joint, split, first, second, logs, key, seed) for joint in faulty)
        worsened |= high < 0
        floor = _floor(split, key)
        entry: dict[str, Any] = {
            "before": _root(blocks[0]),
            "after": _root(blocks[1]),
            "floor": None if floor is None else _root(floor),
            "ceiling": None,
            "systematic": _systematic(split, first, logs, key),
            "unit": unit,
            "before_interval": _interval(blocks[0], rng),
            "after_interval": _interval(blocks[1], rng),
            "floor_interval": None if floor is None else _interval(floor, rng),
            "ceiling_interval": None,
        }
        entry["closure"] = _closure(entry)
        gap["/".join(key)] = entry
    return {
        "gap": gap,
        "loss": {"name": "paper_eq7", "before": old, "after": new},
        "vetoed": vetoed(improved, worsened, old, new),
        "before": first,
        "after": second,
    }


def with_ceiling(
    gap: Mapping[str, Mapping[str, Any]], split: LogSplit, base: RobotModel, push: Sequence[np.ndarray], seed: int = 0
) -> dict[str, dict[str, Any]]:
    """A gap with what a black box leaves of it: free runs of the base with the torque that it finds lacking.

    Args:
        gap: of `show`.
        split: whose ``show`` logs are simulated.
        base: the refitted base.
        push: torque [N m] along each of `shown_logs`, ``[row, joint]``; none where the black box has found nothing, and
            the ceiling is what the base leaves.
        seed: of the bootstrap.
    """
    result = {name: dict(entry) for name, entry in gap.items()}
    logs, rng = shown_logs(split), np.random.default_rng([seed, 31])
    predictions: Sequence[Prediction] = ()
    if push:
        columns = [with_whole_limbs(log).joints for log in logs]
        whole = [np.zeros((len(one), len(joints))) for one, joints in zip(push, columns, strict=True)]
        for one, torque, log, joints in zip(whole, push, logs, columns, strict=True):
            one[:, [joints.index(joint) for joint in log.joints]] = torque
        predictions = _replay(logs).run(base, push=whole)
    for name, entry in result.items():
        if predictions:
            group, channel = name.split("/")
            blocks = _blocks(split, predictions, logs, (group, channel))
            entry["ceiling"], entry["ceiling_interval"] = _root(blocks), _interval(blocks, rng)
        else:
            entry["ceiling"], entry["ceiling_interval"] = entry["before"], entry["before_interval"]
    return result


def vetoed(improved: bool, worsened: bool, before: float, after: float) -> bool:
    """Whether free runs speak against a change that windows speak for.

    Where the loss falls, a channel that has become worse needs one that has become better. The loss hardly feels a
    small fault of one joint: where it does not fall, a channel must have become better, if only in that joint, and none
    worse.

    Args:
        improved: whether a channel became better, beyond its interval.
        worsened: whether one became worse.
        before: loss without the change.
        after: with it.
    """
    return worsened and not improved if after < before else worsened or not improved


def shown_logs(split: LogSplit) -> tuple[Rollout, ...]:
    """Logs that are simulated: no more than `REPEATS` of one command, as their free runs are nearly the same."""
    left_out = {i for group in split.repeats for i in group[REPEATS:]}
    return tuple(log for i, log in enumerate(split.show) if i not in left_out)


def _better_in(
    joint: str,
    split: LogSplit,
    before: Sequence[Prediction],
    after: Sequence[Prediction],
    logs: Sequence[Rollout],
    key: tuple[str, str],
    seed: int,
) -> bool:
    """Whether a joint by itself became better, beyond its interval; all others hide it."""
    blocks = [_blocks(split, predictions, logs, key, (joint,)) for predictions in (before, after)]
    return _difference(blocks[0], blocks[1], np.random.default_rng([seed, 23]))[0] > 0


def _blocks(
    split: LogSplit,
    predictions: Sequence[Prediction],
    logs: Sequence[Rollout],
    key: tuple[str, str],
    joints: Sequence[str] | None = None,
) -> np.ndarray:
    """Mean square by second of every command, ``[block]``: its repeats, which miss alike, are one piece of evidence."""
    by_log = _squares(predictions, logs, key, joints)
    places = {id(log): i for i, log in enumerate(logs)}
    groups = [[places[id(split.show[i])] for i in group if id(split.show[i]) in places] for group in split.repeats]
    groups += [[i] for i in range(len(logs)) if not any(i in group for group in groups)]
    blocks = []
    for group in groups:
        seconds = min((len(by_log[i]) for i in group), default=0)
        blocks += [np.mean([by_log[i][:seconds] for i in group], axis=0)] if seconds else []
    return np.concatenate(blocks)


def _squares(
    predictions: Sequence[Prediction],
    logs: Sequence[Rollout],
    key: tuple[str, str],
    joints: Sequence[str] | None = None,
) -> list[np.ndarray]:
    """Mean square by second of every run, of some joints or all, ``[second]`` each."""
    values = []
    for prediction, log in zip(predictions, logs, strict=True):
        picked = joints or log.joints
        columns = [prediction.log.joints.index(joint) for joint in picked]
        simulated = prediction.channels[key][0].numpy()[:, columns]
        measured = log.array(key)[: len(simulated), [log.joints.index(joint) for joint in picked]]
        error = np.square(simulated - measured).mean(1)
        values.append(_by_second(np.nan_to_num(error, nan=1e6, posinf=1e6), log))
    return values


def _root(blocks: np.ndarray) -> float:
    return float(np.sqrt(blocks.mean()))


def _interval(blocks: np.ndarray, rng: np.random.Generator) -> list[float]:
    draws = blocks[rng.integers(len(blocks), size=(RESAMPLES, len(blocks)))].mean(1)
    return [float(np.sqrt(end)) for end in np.quantile(draws, [0.05, 0.95])]


def _difference(one: np.ndarray, other: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    apart = one - other
    draws = apart[rng.integers(len(apart), size=(RESAMPLES, len(apart)))].mean(1)
    low, high = np.quantile(draws, [0.05, 0.95])
    return float(low), float(high)


def _floor(split: LogSplit, key: tuple[str, str]) -> np.ndarray | None:
    """Mean squares by which repeats of one command differ from their mean, by second, ``[block]``; None without any."""
    squares = []
    for group in split.repeats:
        values = _stacked(split, group, key)
        noise = np.square(values - values.mean(0)).sum(0).mean(1) / (len(group) - 1)
        squares.append(_by_second(noise, split.show[group[0]]))
    return np.concatenate(squares) if squares else None


def _stacked(split: LogSplit, group: Sequence[int], key: tuple[str, str]) -> np.ndarray:
    """A channel of repeats, as far as the shortest goes, ``[repeat, row, joint]``."""
    rows = min(split.show[i].rows for i in group)
    return np.stack([split.show[i].array(key)[:rows] for i in group])


def _by_second(values: np.ndarray, log: Rollout) -> np.ndarray:
    """Means over the seconds of a log's first rows, ``[second]``."""
    time = log.array("time")[: len(values), 0]
    second = (time - time[0]).astype(int)
    return np.array([values[second == s].mean() for s in np.unique(second)])


def _systematic(
    split: LogSplit, predictions: Sequence[Prediction], logs: Sequence[Rollout], key: tuple[str, str]
) -> float | None:
    """Root of the squared gap that every repeat has, without what noise adds to it; None without repeats.

    The mean of R repeats less the prediction, squared, holds a share 1/R of the noise's variance, which is taken off.
    """
    places, squares = {id(log): i for i, log in enumerate(logs)}, []
    for group in split.repeats:
        values = _stacked(split, group, key)
        noise = np.square(values - values.mean(0)).sum(0).mean() / (len(group) - 1)
        simulated = []
        for i in group:
            at = places.get(id(split.show[i]))
            if at is not None:
                columns = [predictions[at].log.joints.index(joint) for joint in logs[at].joints]
                simulated.append(predictions[at].channels[key][0].numpy()[: len(values[0]), columns])
        gap = np.square(values.mean(0) - np.mean(simulated, 0)).mean()
        squares.append(np.nan_to_num(gap - noise / len(group), nan=1e6))
    return float(np.sqrt(max(float(np.mean(squares)), 0.0))) if squares else None


def _closure(entry: Mapping[str, Any]) -> float | None:
    """Share of the gap above the floor that was closed; squares are what adds up."""
    floor = entry["floor"]
    if floor is None:
        return None
    before = np.sqrt(max(entry["before"] ** 2 - floor**2, 0.0))
    after = np.sqrt(max(entry["after"] ** 2 - floor**2, 0.0))
    return float((before - after) / before) if before > 0 else None


def worst_joint(predictions: Sequence[Prediction], joints: Sequence[str]) -> str:
    """The joint whose position is predicted worst."""
    totals = torch.zeros(len(joints), dtype=torch.float64)
    for prediction in predictions:
        columns = [prediction.log.joints.index(joint) for joint in joints]
        simulated = prediction.channels["joint", "position"][0][:, columns]
        measured = torch.from_numpy(prediction.log.array("joint/position")[: len(simulated)])[:, columns]
        totals += (simulated - measured).square().mean(0)
    return joints[int(totals.argmax())]
