"""A log through the policy again: are the actions those that were taken?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from op3.deploy.policy_runner import PolicyRunner
from op3.deploy.ticker import PERIOD, POLICY_TICKS
from op3.rollout import Rollout

TOLERANCE = 1e-5
"""Largest difference of an action that counts as the same."""


@dataclass(frozen=True)
class PolicyReplay:
    """What came out.

    Attributes:
        steps: policy steps compared.
        action_difference: largest absolute difference of an action.
        observation_difference: largest absolute difference of an observation; NaN where none was logged.
        first: step of the first action beyond the tolerance; None if there is none.
    """

    steps: int
    action_difference: float
    observation_difference: float
    first: int | None

    @property
    def ok(self) -> bool:
        """Whether all actions are those that were taken."""
        return self.action_difference < TOLERANCE

    def __str__(self) -> str:
        verdict = "the same actions" if self.ok else f"other actions from step {self.first} on"
        return (
            f"{self.steps} policy steps, {verdict}: largest |action difference| {self.action_difference:.2e}, "
            f"largest |observation difference| {self.observation_difference:.2e}"
        )


def replay_policy(log: Rollout, runner: PolicyRunner) -> PolicyReplay:
    """Feed a log's sensor readings to a policy and compare.

    Args:
        log: one episode with `policy/action`, rows at the loop's or at the policy's rate.
        runner: the policy.

    Raises:
        ValueError: if the log lacks a channel, has another rate, or is of another kind of policy.
    """
    for key in ("policy/action", "joint/velocity", "imu/orientation", "imu/angular_velocity"):
        if key not in log:
            raise ValueError(f"the log has no {key}; give the folder `run` of a run with a policy")
    if log.batched:
        raise ValueError("the log has an episode axis; give one episode")
    asked, logged = runner.bundle.manifest, log.array("policy/action")
    if logged.shape[-1] != asked.action_map.size:
        raise ValueError(
            f"the log's actions have {logged.shape[-1]} numbers and those of this policy {asked.action_map.size}; give"
            " the policy that was run"
        )
    if "policy/observation" in log and log.array("policy/observation").shape[-1] != asked.observation_size:
        raise ValueError(
            f"the log's observations have {log.array('policy/observation').shape[-1]} numbers and those of this policy"
            f" {asked.observation_size}; give the policy that was run"
        )
    steps, rows = _steps(log)
    runner.reset()
    taken = logged
    seen = log.array("policy/observation") if "policy/observation" in log else None
    actions, observations = [], []
    position, velocity = log.array("joint/position"), log.array("joint/velocity")
    orientation, rates = log.array("imu/orientation"), log.array("imu/angular_velocity")
    for step, row in zip(steps, rows, strict=True):
        observation = runner.observe(position[row], velocity[row], orientation[row], rates[row], step)
        actions.append(np.abs(runner.act(observation) - taken[row]).max())
        if seen is not None:
            observations.append(np.abs(observation - seen[row]).max())
    beyond = [step for step, difference in zip(steps, actions, strict=True) if not difference < TOLERANCE]
    return PolicyReplay(
        steps=len(steps),
        action_difference=float(np.max(actions)),
        observation_difference=float(np.max(observations)) if observations else float("nan"),
        first=beyond[0] if beyond else None,
    )


def _steps(log: Rollout) -> tuple[list[int], list[int]]:
    """Numbers of the policy steps, and the row of each."""
    if abs(log.metadata.rate * PERIOD * POLICY_TICKS - 1) < 0.05:
        return list(range(log.rows)), list(range(log.rows))
    if abs(log.metadata.rate * PERIOD - 1) > 0.05:
        raise ValueError(f"the log has {log.metadata.rate:g} rows per second; the loop runs at {1 / PERIOD:g} Hz")
    time = log.array("time")[:, 0]
    if "raw/lateness" in log:
        time = time - log.array("raw/lateness")[:, 0]
    step = np.round((time - time[0]) / PERIOD).astype(int) // POLICY_TICKS
    rows = np.flatnonzero(np.diff(step, prepend=-1) > 0)
    return [int(step[row]) for row in rows], [int(row) for row in rows]
