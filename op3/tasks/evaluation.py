"""R_eval: what an episode was worth, as one function of its log, for simulation and robot alike.

The paper evaluates eq. (8) with the last column of Table II. A robot knows no velocity of its body, so balance takes it
from the body's rates, and walking from the distance travelled (paper, section "Task for Evaluation").
"""

from typing import Any

import torch
from torch import Tensor

from op3.robot import pose, standing_height
from op3.rollout import LogError, Rollout
from op3.tasks import rewards
from op3.tasks.task import Task, find_task

TRUNK_HEIGHT = standing_height(pose("stand"))
"""Height of the trunk above the soles in the stand pose [m]: lever from its rates to its velocity."""


def evaluation_rewards(log: Rollout, task: str | Task | None = None) -> Tensor:
    """R_eval of every policy step.

    A step is judged by the sensors at its beginning, when its action was chosen; the action before the first counts as
    equal to it.

    Args:
        log: of one episode, with the channels of `op3.envs.record_episodes`.
        task: that was attempted; None: the one that the metadata name in ``extra["task"]``.

    Returns:
        ``[step]``.

    Raises:
        LogError: if the log lacks a channel or a field of its metadata.
    """
    if log.batched:
        raise LogError("R_eval is of one episode, but the log has many", "give log.episodes() one by one")
    task = find_task(task if task is not None else _field(log, "task", log.metadata.extra.get("task")))
    rows = policy_rows(log)

    def channel(key: str) -> Tensor:
        return torch.from_numpy(log.array(key))[rows]

    orientation, rates, action = channel("imu/orientation"), channel("imu/angular_velocity"), channel("policy/action")
    velocity = _walked(log, len(action)) if task.cycle is not None else _swayed(rates)
    acceleration = rewards.body_acceleration(channel("imu/linear_acceleration"), orientation)
    previous = torch.cat([action[:1], action[:-1]])
    desired = torch.tensor(task.desired_velocity, dtype=torch.float64)
    terms = rewards.weighted(
        rewards.EVALUATION,
        rewards.command_term(velocity, desired, orientation, rewards.EVALUATION),
        rewards.smooth_term(action, previous, channel("joint/current"), rates, acceleration),
    )
    return rewards.total(terms)


def evaluation_return(log: Rollout, task: str | Task | None = None) -> float:
    """R_eval of an episode: the sum over its policy steps; an episode that ends in a fall has fewer."""
    return float(evaluation_rewards(log, task).sum())


def policy_rows(log: Rollout) -> slice:
    """The rows of a log in which the policy acted."""
    rate = _field(log, "policy_rate", log.metadata.policy_rate)
    every = log.metadata.rate / rate
    if every < 1 or abs(every - round(every)) > 1e-3:
        problem = f"the log has {log.metadata.rate:g} rows per second, which is no multiple of {rate:g}"
        raise LogError(
            problem, "correct rate or policy_rate", source=log.metadata.recording, column="field policy_rate"
        )
    return slice(None, None, round(every))


def _swayed(rates: Tensor) -> Tensor:
    """Velocity forwards and sideways of a trunk that turns about its soles, ``[step, 2]`` in m/s."""
    return TRUNK_HEIGHT * torch.stack([rates[:, 1], -rates[:, 0]], 1)


def _walked(log: Rollout, steps: int) -> Tensor:
    """Mean velocity of the episode, ``[step, 2]`` in m/s; its sideways part is not measured and counts as zero."""
    distance = _field(log, "travelled_distance", log.metadata.travelled_distance)
    duration = _field(log, "episode_duration", log.metadata.episode_duration)
    return torch.tensor([distance / duration, 0.0], dtype=torch.float64).expand(steps, 2)


def _field(log: Rollout, name: str, value: Any) -> Any:
    if value is None:
        problem, remedy = "R_eval needs this field of the metadata", f"add `{name}:` to the metadata"
        raise LogError(problem, remedy, source=log.metadata.recording, column=f"field {name}")
    return value
