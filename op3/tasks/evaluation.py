"""R_eval: the return of an episode as a function of its log, in simulation and on the robot.

The paper evaluates eq. (8) with the last column of Table II. A robot does not measure the velocity of its body: balance
computes it from the body's rates, walking from the distance travelled (paper, section "Task for Evaluation").
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from op3.robot import Robot, load_robot, standing_height
from op3.rollout import LogError, Rollout
from op3.tasks import rewards
from op3.tasks.task import Task, find_task

COMMAND_WEIGHT, SMOOTH_WEIGHT, STEEPNESS = 0.6, 0.1, (2.0, 2.0)
"""K_cmd, K_smooth, and K_xd and K_yd [s/m] of R_eval, for both tasks (paper, Table II)."""


def evaluation_rewards(log: Rollout, task: str | Task | None = None) -> Tensor:
    """R_eval of every policy step; the logged rewards for a task without the paper's ``command`` term.

    A step is evaluated with the sensors at its beginning, when its action was chosen; the action before the first is
    taken as equal to the first.

    Args:
        log: log of one episode, with the channels of `op3.envs.record_episodes`.
        task: task of the episode; None: the one that the metadata name in ``extra["task"]``.

    Returns:
        ``[step]``.

    Raises:
        LogError: if a channel or a field of the metadata is missing.
    """
    if log.batched:
        raise LogError("R_eval is defined for one episode, but the log has many", "give log.episodes() one by one")
    task = find_task(task if task is not None else _field(log, "task", log.metadata.extra.get("task")))
    _, rows = policy_rows(log, _field(log, "policy_rate", log.metadata.policy_rate))
    if not paper_reward(task):
        return torch.from_numpy(log.array("policy/reward"))[rows, 0]

    def channel(key: str) -> Tensor:
        return torch.from_numpy(log.array(key))[rows]

    orientation, rates, action = channel("imu/orientation"), channel("imu/angular_velocity"), channel("policy/action")
    result = evaluation_terms(
        task,
        action,
        torch.cat([action[:1], action[:-1]]),
        channel("joint/current"),
        orientation,
        rates,
        channel("imu/linear_acceleration"),
        swayed(rates, load_robot(task.robot)) if task.cycle is None else None,
    )
    return result if task.cycle is None else result + travel_term(task, _walked(log))


def evaluation_terms(
    task: Task,
    action: Tensor,
    previous: Tensor,
    current: Tensor,
    orientation: Tensor,
    rates: Tensor,
    specific_force: Tensor,
    velocity: Tensor | None,
) -> Tensor:
    """R_eval of steps, ``[...]``, without the velocity term if the velocity is not known yet.

    Args:
        action: ``[..., action]``.
        current: current of all motors, ``[..., joint]`` in A.
        orientation: roll, pitch and yaw, ``[..., 3]`` in rad.
        rates: angular rates of the body, ``[..., 3]`` in rad/s.
        specific_force: specific force of the IMU, ``[..., 3]`` in m/s^2.
        velocity: forwards and sideways, ``[..., 2]`` in m/s; None: `travel_term` adds its part later.
    """
    desired = torch.tensor(task.desired_velocity, dtype=torch.float64)
    acceleration = rewards.body_acceleration(specific_force, orientation)
    velocity = desired if velocity is None else velocity
    motion = rewards.norm(rates) + rewards.norm(acceleration)
    smooth = rewards.smooth_term(rewards.norm(action - previous), rewards.norm(current), motion)
    command = rewards.command_term(velocity, desired, orientation, *STEEPNESS)
    return 1.0 + COMMAND_WEIGHT * command + SMOOTH_WEIGHT * smooth


def travel_term(task: Task, speed: Tensor) -> Tensor:
    """Contribution of a mean forward speed [m/s], ``[...]``, to every step; the sideways speed is unknown and counts as
    0."""
    velocity = torch.stack([speed, torch.zeros_like(speed)], -1)
    desired = torch.tensor(task.desired_velocity, dtype=torch.float64)
    upright = torch.zeros_like(velocity)
    return COMMAND_WEIGHT * rewards.command_term(velocity, desired, upright, *STEEPNESS)


def evaluation_return(log: Rollout, task: str | Task | None = None) -> float:
    """R_eval of an episode: the sum over its policy steps; an episode that ends in a fall has fewer."""
    return float(evaluation_rewards(log, task).sum())


def stood(log: Rollout) -> bool:
    """Whether a robot was upright until the end of its episode, including any motion to an end pose."""
    return not _field(log, "fallen", log.metadata.fallen) and "afterwards" not in log.metadata.extra


def succeeded(log: Rollout, task: str | Task) -> bool:
    """Whether an episode succeeded according to the task's ``success``; for walking, upright until the end and
    forwards.

    A simulated episode has the result in its metadata. For a real one, the measured distance is compared.
    """
    if not stood(log):
        return False
    if (success := log.metadata.extra.get("success")) is not None:
        return bool(success)
    travelled = find_task(task).terms("success").get("travelled")
    if travelled is None:
        return True
    return _field(log, "travelled_distance", log.metadata.travelled_distance) >= travelled["distance"]


def policy_rows(log: Rollout, rate: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices of a policy's steps in an episode, and the row of each; a loop may skip rows.

    Args:
        rate: rate of the policy [Hz].

    Raises:
        LogError: if the log's rate is not a multiple of the policy's rate.
    """
    every = log.metadata.rate / rate
    if every < 1 or abs(every - round(every)) > 1e-3:
        problem = f"the log has {log.metadata.rate:g} rows per second, which is not a multiple of {rate:g}"
        raise LogError(
            problem, "correct rate or policy_rate", source=log.metadata.recording, column="field policy_rate"
        )
    time = log.array("time")[:, 0]
    if "raw/lateness" in log:
        time = time - log.array("raw/lateness")[:, 0]
    step = np.round((time - time[0]) * log.metadata.rate).astype(int) // round(every)
    rows = np.flatnonzero(np.diff(step, prepend=-1) > 0)
    return step[rows], rows


def paper_reward(task: Task) -> bool:
    """Whether R_eval is defined for a task: the paper's balancing or walking, at one velocity."""
    return "command" in task.terms("rewards") and not task.commands


def swayed(rates: Tensor, robot: Robot) -> Tensor:
    """Velocity forwards and sideways of a trunk that turns about its soles, ``[..., 2]`` in m/s.

    The lever is the height of the trunk above the soles in the stand pose.
    """
    return standing_height(robot.home, robot) * torch.stack([rates[..., 1], -rates[..., 0]], -1)


def _walked(log: Rollout) -> Tensor:
    """Mean forward speed of the episode [m/s]."""
    distance = _field(log, "travelled_distance", log.metadata.travelled_distance)
    duration = _field(log, "episode_duration", log.metadata.episode_duration)
    return torch.tensor(distance / duration, dtype=torch.float64)


def _field(log: Rollout, name: str, value: Any) -> Any:
    if value is None:
        problem, remedy = "R_eval needs this field of the metadata", f"add `{name}:` to the metadata"
        raise LogError(problem, remedy, source=log.metadata.recording, column=f"field {name}")
    return value
