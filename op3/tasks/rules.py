"""The rules of a task for many robots at once, whatever simulates them: observation, commands, reward, the end."""

from dataclasses import dataclass
from math import inf

import torch
from torch import Tensor

from op3.policy import ActionMap
from op3.policy.observation import History, observe
from op3.robot.units import ANGLE_UNIT, GYRO_UNIT, POSITION_UNIT, VELOCITY_UNIT
from op3.tasks import rewards
from op3.tasks.snapshot import Snapshot
from op3.tasks.task import POLICY_PERIOD, Task
from op3.tasks.whole_step import Throughout

UNITS = {
    "joint_position": POSITION_UNIT,
    "joint_velocity": VELOCITY_UNIT,
    "orientation": ANGLE_UNIT,
    "angular_velocity": GYRO_UNIT,
}
"""One count of what the policy's computer reads [rad, rad/s]; registers of servo and OpenCR (ROBOTIS e-Manual)."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a policy step led to, tensors ``[sim, ...]``.

    Attributes:
        observation: history included.
        reward: ``[sim]``.
        terms: weighted contributions to the reward by name, ``[sim]``; the reward is 1 plus their sum.
        terminated: the robot fell, or its simulation failed.
        truncated: the time is over.
    """

    observation: Tensor
    reward: Tensor
    terms: dict[str, Tensor]
    terminated: Tensor
    truncated: Tensor


class Rules:
    """The rules of a task, and the little memory they need.

    Attributes:
        readings: what the computer read last, in whole counts: by the names of `UNITS`, ``[sim, joint | 3]``.
    """

    def __init__(self, task: Task, action_map: ActionMap, num_sims: int):
        self.task = task
        self.action_map = action_map
        self.readings: dict[str, Tensor] = {}
        self.steps = torch.zeros(num_sims, dtype=torch.int64)
        self.first_phase = torch.zeros(num_sims, dtype=torch.float64)
        self.speed_bonus = 0.0
        """What a learner gets for forward speed, per m/s up to the desired speed; not in the paper and not judged."""
        self.largest_lag = inf
        """Episodes of a learner end when the robot is further behind where the desired speed would have it [m]."""
        self._lag = torch.zeros(num_sims, dtype=torch.float64)
        self._history = History(task.history)
        self._first_action = torch.from_numpy(action_map.stand())
        self._previous = self._first_action.repeat(num_sims, 1)
        self._desired = torch.tensor(task.desired_velocity, dtype=torch.float64)

    @property
    def time(self) -> Tensor:
        """Time since each episode's beginning [s], ``[sim]``."""
        return self.steps.double() * POLICY_PERIOD

    def begin(self, snapshot: Snapshot, rows: Tensor, phase: Tensor) -> Tensor:
        """Episodes begin for the rows of a mask ``[sim]``; the robots hold the stand pose with the highest gain.

        Args:
            phase: of the gait, ``[sim]`` in cycles, which counts for those.

        Returns:
            The observation of all robots, ``[sim, observation]``.
        """
        self.steps[rows] = 0
        self._lag[rows] = 0.0
        self.first_phase = torch.where(rows, phase, self.first_phase)
        self._previous = torch.where(rows[:, None], self._first_action, self._previous)
        return self._history.reset(self._observe(snapshot), rows)

    def resting_commands(self, count: int) -> dict[str, Tensor]:
        """Commands that are in force when an episode begins, ``[count, joint]``."""
        return self.action_map.commands(self._first_action.expand(count, -1))

    def finish(self, action: Tensor, snapshot: Snapshot, throughout: Throughout, failed: Tensor) -> Outcome:
        """A policy step is over.

        Args:
            action: taken at its beginning, ``[sim, action]``; beyond [-1, 1] it counts as clipped, as it was commanded.
            failed: simulations that diverged, ``[sim]``.
        """
        action = action.clamp(-1.0, 1.0)
        self.steps += 1
        orientation = snapshot.readings["orientation"]
        terms = self._terms(action, snapshot, throughout)
        reward = rewards.total(terms)
        tilted = orientation[:, :2].abs().amax(1) > self.task.fall_angle
        shortfall = (self._desired[0] - snapshot.velocity[:, 0]) * self._desired[0].sign()
        self._lag = (self._lag + POLICY_PERIOD * shortfall).clamp(min=0.0)
        terminated = tilted | (snapshot.height < self.task.fall_height) | failed | (self._lag > self.largest_lag)
        self._previous = action
        observation = self._history.push(self._observe(snapshot))
        if failed.any():  # what a diverged state would say is worth nothing
            reward = torch.where(failed, 0.0, reward)
            terms = {name: torch.where(failed, 0.0, term) for name, term in terms.items()}
            observation = torch.where(failed[:, None], 0.0, observation)
        truncated = (self.steps >= self.task.steps) & ~terminated
        return Outcome(observation, reward, terms, terminated, truncated)

    def _terms(self, action: Tensor, snapshot: Snapshot, throughout: Throughout) -> dict[str, Tensor]:
        task, weights, orientation = self.task, self.task.coefficients, snapshot.readings["orientation"]
        judged = throughout if task.whole_step else snapshot.at_the_end()
        terms = rewards.weighted(
            weights,
            rewards.command_term(snapshot.velocity[:, :2], self._desired, orientation, weights),
            rewards.smooth_term(
                rewards.norm(action - self._previous), judged.current, judged.angular_velocity + judged.acceleration
            ),
        )
        if task.cycle is not None:
            bipedal = rewards.bipedal_term(self._phase(), judged.foot_force, judged.foot_speed)
            wanted = self._desired[0].abs()
            terms["bipedal"] = weights.bipedal * bipedal
            terms["speed_bonus"] = self.speed_bonus * snapshot.velocity[:, 0].clamp(-wanted, wanted)
        if task.overload:
            terms["overload"] = task.overload * rewards.overload_term(snapshot.current)
        if task.self_contact:
            terms["self_contact"] = -task.self_contact * throughout.self_contact
        if task.clearance:
            clearance = rewards.clearance_term(self._phase(), throughout.foot_clearance, task.clearance_height)
            terms["clearance"] = task.clearance * clearance
        return terms

    def _phase(self) -> Tensor:
        """Phase of the gait in cycles, ``[sim]``."""
        assert self.task.cycle is not None
        return torch.remainder(self.time / self.task.cycle + self.first_phase, 1.0)

    def _observe(self, snapshot: Snapshot) -> Tensor:
        self.readings = {name: torch.round(snapshot.readings[name] / unit) * unit for name, unit in UNITS.items()}
        phase = None if self.task.cycle is None else self._phase()
        return observe(**self.readings, previous_action=self._previous, phase=phase)
