"""Behaviour of a policy in its log: gains in stance and swing, tilt, and the gait's profile."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from op3.robot import Robot, load_robot
from op3.rollout import Rollout
from op3.tasks.rewards import FOOT_OFFSETS, swing_of_feet, swing_probability
from op3.tasks.task import Task, find_task


def foot_of(joint: str, robot: Robot) -> int:
    """Index of the foot, in the order of the robot's file, to whose leg a joint belongs.

    Raises:
        ValueError: if the joint is not in a leg.
    """
    found = [foot for foot, leg in enumerate(robot.legs) if joint in leg]
    if not found:
        raise ValueError(f"{joint} is not in a leg; a gait needs joints of legs")
    return found[0]


@dataclass(frozen=True, eq=False)
class GaitProfile:
    """A joint over the phase of the gait, averaged over all cycles.

    Attributes:
        phase: middle of each bin in cycles, [bin].
        target: commanded angle [rad], [bin].
        target_deviation: its standard deviation [rad], [bin].
        gain: commanded P gain [A/rad], [bin].
        gain_deviation: its standard deviation [A/rad], [bin].
        stance: whether the joint's foot should be in stance, [bin].
    """

    phase: NDArray[np.float64]
    target: NDArray[np.float64]
    target_deviation: NDArray[np.float64]
    gain: NDArray[np.float64]
    gain_deviation: NDArray[np.float64]
    stance: NDArray[np.bool_]


def in_stance(log: Rollout, task: str | Task) -> NDArray[np.bool_]:
    """Whether each foot of the task's robot should be in stance, [time, foot]; always in a task without a gait."""
    task = find_task(task)
    feet = len(load_robot(task.robot).legs)
    if task.cycle is None:
        return np.ones((log.rows, feet), dtype=bool)
    time = log.array("time")
    phase = torch.from_numpy(np.remainder((time[:, 0] - time[0, 0]) / task.cycle, 1.0))
    return swing_of_feet(phase, feet).numpy() < 0.5


def gains(log: Rollout, task: str | Task) -> dict[str, float]:
    """Mean P gain [A/rad] of all controlled joints, and of the legs in stance and in swing.

    Returns:
        ``gain``, and for walking ``gain_stance`` and ``gain_swing``.
    """
    p_gain, carries = log.array("command/p_gain"), in_stance(log, task)
    sums, counts = {True: 0.0, False: 0.0}, {True: 0, False: 0}
    robot = load_robot(find_task(task).robot)
    for side, leg in enumerate(robot.legs):
        columns = [log.joints.index(joint) for joint in robot.controlled if joint in leg]
        for stance in (True, False):
            values = p_gain[carries[:, side] == stance][:, columns]
            sums[stance] += float(values.sum())
            counts[stance] += values.size
    result = {"gain": float(p_gain[:, [log.joints.index(joint) for joint in robot.controlled]].mean())}
    if find_task(task).cycle is not None and min(counts.values()):
        result |= {"gain_stance": sums[True] / counts[True], "gain_swing": sums[False] / counts[False]}
    return result


def mean_tilt(log: Rollout) -> float:
    """Mean angle of the trunk from upright [rad], roll and pitch together."""
    return float(np.linalg.norm(log.array("imu/orientation")[:, :2], axis=1).mean())


def gait_profile(
    logs: list[Rollout], task: str | Task, joint: str | None = None, bins: int = 25, skip: float = 1.0
) -> GaitProfile:
    """Target and P gain of one joint over the gait (paper, figure of the walking policy).

    Args:
        logs: episodes of walking; rows of the same phase are averaged.
        joint: name; None: the last but one of the right leg, an ankle.
        bins: parts of the cycle; bins without a row are NaN.
        skip: time at the beginning that is omitted [s].

    Raises:
        ValueError: if the task has no gait.
    """
    task = find_task(task)
    if task.cycle is None:
        raise ValueError(f"task {task.name!r} has no gait; a gait profile needs a walking task")
    robot = load_robot(task.robot)
    joint = robot.legs[1][-2] if joint is None else joint
    column, side = logs[0].joints.index(joint), foot_of(joint, robot)
    phases, targets, stiffness = [], [], []
    for log in logs:
        time = log.array("time")[:, 0] - log.array("time")[0, 0]
        late = time >= skip
        phases.append(np.remainder(time[late] / task.cycle, 1.0))
        targets.append(log.array("command/position")[late, column])
        stiffness.append(log.array("command/p_gain")[late, column])
    number = np.minimum((np.concatenate(phases) * bins).astype(int), bins - 1)
    target, gain = (_binned(number, np.concatenate(values), bins) for values in (targets, stiffness))
    middle = (np.arange(bins) + 0.5) / bins
    swing = swing_probability(torch.from_numpy(np.remainder(middle + FOOT_OFFSETS[2][side], 1.0))).numpy()
    return GaitProfile(middle, *target, *gain, swing < 0.5)


def _binned(number: NDArray[np.int64], values: NDArray[np.float64], bins: int) -> tuple[NDArray, NDArray]:
    """Mean and standard deviation [bin] of values by the number of their bin."""
    count = np.bincount(number, minlength=bins).astype(float)
    count[count == 0] = np.nan
    mean = np.bincount(number, values, bins) / count
    square = np.bincount(number, (values - mean[number]) ** 2, bins) / count
    return mean, np.sqrt(square)
