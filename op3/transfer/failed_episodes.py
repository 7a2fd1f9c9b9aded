"""Selects the episodes on a robot that a simulation can reproduce."""

from collections.abc import Sequence

from op3.policy import PolicyBundle
from op3.rollout import LogError, Rollout
from op3.tasks.task import POLICY_PERIOD, Task


def that_count(episodes: Sequence[Rollout]) -> tuple[list[Rollout], list[Rollout]]:
    """Episodes that ended by time limit or fall, and all other episodes.

    Other causes on a robot (a voltage, a lost bus, heat) do not occur in simulation, so the return of such an episode
    contains no information on the parameters.
    """
    ends = (None, "ok", "fall")
    count = [log for log in episodes if log.metadata.extra.get("exit") in ends]
    return count, [log for log in episodes if log.metadata.extra.get("exit") not in ends]


def ended_by(episodes: Sequence[Rollout]) -> str:
    """The causes that ended episodes of the robot, as text."""
    return ", ".join(sorted({str(log.metadata.extra["exit"]) for log in episodes}))


def check_episode(log: Rollout, task: Task, policy: PolicyBundle) -> None:
    """Check that a log is an episode of this policy and task that a simulation can reproduce.

    Raises:
        LogError: if not; the message states the remedy.
    """
    name = log.metadata.recording
    trained, played = policy.manifest.training.model_hash, log.metadata.model_hash
    # a robot's log names the policy's model, a simulation's log the simulated model
    if "exit" in log.metadata.extra and trained and played and played != trained:
        raise LogError(
            f"the episode's policy was trained on the model {played}, but the bundle's policy on {trained}",
            "give the bundle that produced the episode",
            column="field model_hash",
            source=name,
        )
    attempted = log.metadata.extra.get("task")
    if isinstance(attempted, str) and attempted != task.name:
        raise LogError(
            f"the episode is of the task {attempted}, not {task.name}",
            f"give task={attempted}, or episodes of {task.name}",
            column="field task",
            source=name,
        )
    shortest = task.duration - 2.0 * POLICY_PERIOD
    if not log.metadata.fallen and log.duration < shortest:
        raise LogError(
            f"the episode lasts {log.duration:.2f} s without a fall, but those of {task.name} last {task.duration:g} s",
            f"record episodes of {task.duration:g} s, or set the task's duration",
            source=name,
        )
