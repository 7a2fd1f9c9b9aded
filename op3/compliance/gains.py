"""Gain and stiffness of the leg joints over the gait: by the phase that the policy observes, and by foot contact."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from op3.common.sample_intervals import with_interval
from op3.common.settings import CONTROL_PERIOD
from op3.compliance.energy import torque_per_current
from op3.envs.step_traces import SKIPPED, TOUCHED, Traces, touchdowns
from op3.policy.observation import layout_slices
from op3.robot import load_robot
from op3.rollout import Rollout
from op3.servo import RobotModel
from op3.tasks.behaviour import foot_of, in_stance
from op3.tasks.task import TICKS, Task

Array = NDArray[np.float64]

BINS = 25
"""Number of bins in the gait cycle."""

AFTER_LANDING = 0.1
"""Time after a touchdown that is evaluated separately [s]."""

TICK = round(1000 * CONTROL_PERIOD)
"""Duration of a tick [ms]."""

SITUATIONS = ("support", "swing", "landed", "support_clock", "swing_clock")
"""Situations of a leg: by foot contact, in the 100 ms after touchdown, and by gait phase."""


@dataclass(frozen=True, eq=False)
class Gains:
    """P gains of the controlled joints; intervals are 95 % over episodes.

    Attributes:
        phase: centre of each bin [cycles], [bin].
        profile: gain over the phase, ``[joint, bin]`` in A/rad.
        profile_interval: ``[joint, bin, 2]``.
        loaded: share of time in which the joint's foot is loaded, ``[joint, bin]``.
        mean: mean over all joints and times, with its interval, [3] in A/rad.
        by_situation: by name of `SITUATIONS`, mean and interval ``[joint, 3]`` in A/rad.
        softening: mean over the joints of support minus swing by contact, with its interval, [3] in A/rad.
        landing: mean over the joints of the 100 ms after touchdown minus swing, with its interval, [3] in A/rad.
        stiffness: output torque per current, ``[joint]`` in N m/A, which converts gain to stiffness.
    """

    phase: Array
    profile: Array
    profile_interval: Array
    loaded: Array
    mean: Array
    by_situation: dict[str, Array]
    softening: Array
    landing: Array
    stiffness: Array
    joints: tuple[str, ...]


def measure_gains(logs: Sequence[Rollout], traces: Traces, task: Task, model: RobotModel) -> Gains:
    """The gains of episodes of walking, with the contacts of the feet in each.

    Args:
        logs: one per robot, with `command/p_gain`.
        model: model of the robots, which gives the torque per current.
    """
    known = load_robot(task.robot)
    columns, foot = known.indices(known.controlled), np.array([foot_of(joint, known) for joint in known.controlled])
    means, profiles, loads = [], [], []
    situations: dict[str, list[Array]] = {name: [] for name in SITUATIONS}
    for robot, log in enumerate(logs):
        gain = log.array("command/p_gain")[:, columns]
        begun = log.array("time")[:, 0] >= SKIPPED
        if not begun.any():
            continue
        masks = _masks(traces.force[:, robot], log, task)
        number = np.minimum((_phase(log, task) * BINS).astype(int), BINS - 1)
        inside = [begun & (number == bin_) for bin_ in range(BINS)]
        profiles.append(_means(gain, [np.repeat(rows[:, None], len(columns), 1) for rows in inside]).T)
        loads.append(np.stack([masks["support"][rows].mean(0) for rows in inside])[:, foot].T)
        means.append(gain[begun].mean())
        for name, mask in masks.items():
            situations[name].append(_means(gain, [mask[:, foot] & begun[:, None]])[0])
    by_situation = {name: np.stack(rows) for name, rows in situations.items()}
    profile = with_interval(np.stack(profiles))
    return Gains(
        phase=(np.arange(BINS) + 0.5) / BINS,
        profile=profile[..., 0],
        profile_interval=profile[..., 1:],
        loaded=np.nanmean(np.stack(loads), 0),
        mean=with_interval(np.array(means)),
        by_situation={name: with_interval(rows) for name, rows in by_situation.items()},
        softening=with_interval(np.nanmean(by_situation["support"] - by_situation["swing"], 1)),
        landing=with_interval(np.nanmean(by_situation["landed"] - by_situation["swing"], 1)),
        stiffness=torque_per_current(model, known)[columns],
        joints=known.controlled,
    )


def _masks(force: NDArray[np.float32], log: Rollout, task: Task) -> dict[str, NDArray[np.bool_]]:
    """Situation of each foot in the log's rows, ``[time, 2]``."""
    rows = np.arange(log.rows) * TICK
    support = force[rows] >= TOUCHED
    landed = np.zeros_like(support)
    for side in range(2):
        since = rows[:, None] - touchdowns(force[: log.rows * TICK, side])
        landed[:, side] = ((since >= 0) & (since < 1000 * AFTER_LANDING)).any(1)
    carries = in_stance(log, task)
    return {
        "support": support, "swing": ~support, "landed": landed, "support_clock": carries, "swing_clock": ~carries
    }  # fmt: skip


def _phase(log: Rollout, task: Task) -> Array:
    """Gait phase at a log's rows [cycles], as the policy observed it."""
    assert task.cycle is not None
    sine, cosine = log.array("policy/observation")[:, layout_slices(task.layout)["phase"]].T
    since = CONTROL_PERIOD * (np.arange(log.rows) % TICKS)
    return np.remainder(np.arctan2(sine, cosine) / (2 * np.pi) + since / task.cycle, 1.0)


def _means(values: Array, masks: Sequence[NDArray[np.bool_]]) -> Array:
    """Mean of values ``[time, joint]`` where each mask is true, ``[mask, joint]``; NaN if it never is."""
    count = np.array([mask.sum(0) for mask in masks], dtype=float)
    return np.array([np.where(mask, values, 0.0).sum(0) for mask in masks]) / np.where(count, count, np.nan)
