"""Runs a policy on the readings of one robot with the functions used in training, and replays logs through a policy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from op3.deploy.command_sources import STANDING, CommandSource
from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.limits import Command
from op3.deploy.phases import Phase
from op3.deploy.robot_state import RobotState
from op3.deploy.ticker import PERIOD, POLICY_TICKS
from op3.policy import PolicyBundle
from op3.policy.actions import GAIN_HIGH
from op3.policy.heading import HeadingReference
from op3.policy.observation import Observer
from op3.policy.observations import Sensed
from op3.robot import Robot, load_robot
from op3.rollout import Rollout
from op3.tasks.evaluation import policy_rows
from op3.tasks.task import POLICY_PERIOD, find_task, task_names

Array = NDArray[np.float64]

TOLERANCE = 1e-5
"""Actions that differ by at most this value count as equal in a replay."""


class PolicyRunner:
    """A policy with its memory and its clock.

    Attributes:
        velocity: commanded velocity forwards and to the left [m/s], and turning rate [rad/s], ``[3]``.

    Args:
        cycle: duration of a gait cycle [s], for a policy that observes the phase; None: the cycle of its task.
        p_gain: largest gain that the policy may command [A/rad].

    Raises:
        ValueError: if the bundle cannot run on this robot; the message names the field.
    """

    def __init__(
        self,
        bundle: PolicyBundle,
        cycle: float | None = None,
        *,
        robot: str | Robot,
        p_gain: float = GAIN_HIGH,
    ):
        manifest = bundle.manifest
        manifest.check_robot(robot)
        manifest.check_fits(manifest.layout, manifest.history, 1 / PERIOD, 1 / (PERIOD * POLICY_TICKS))
        highest = manifest.action_map.gain_high
        if highest is not None and highest > p_gain:
            allowed = f"the robot's limit is {p_gain:g} A/rad; use a policy with lower gains, or raise limits.p_gain"
            raise ValueError(f"field gain_high of the policy's manifest is {highest:g} A/rad, and {allowed}")
        cycle = manifest.cycle if cycle is None else cycle
        if cycle is None and manifest.task in task_names():
            cycle = find_task(manifest.task).cycle
        if "phase" in manifest.layout and (cycle is None or cycle <= 0):
            raise ValueError("the policy observes the phase of a gait; give cycle=<seconds>")
        self._cycle = cycle if "phase" in manifest.layout else None
        self._robot = load_robot(robot)
        self.bundle = bundle
        # The first steps build tables and take a hundred times as long as later steps, too long for a running loop.
        self.reset()
        home = self._robot.home
        try:
            example = self._sense(home, 0.0 * home, np.zeros(3), np.zeros(3), 0)
            self._observer = Observer(manifest.observations, self._robot, manifest.history, example)
        except ValueError as error:
            raise ValueError(
                f"field layout: this version of op3 does not know an observation of the policy ({error})"
            ) from None
        if self._observer.layout != dict(manifest.layout):
            observed = self._observer.layout
            raise ValueError(
                f"field layout: this version observes {observed}, but the policy expects {dict(manifest.layout)}"
            )
        for step in range(3):
            self.act(self.observe(home, 0.0 * home, np.zeros(3), np.zeros(3), step))
        self.reset()

    def reset(self) -> None:
        """Begin an episode, with the robot at rest in the stand pose and zero commanded velocity."""
        self._begun = False
        self._yaw = 0.0
        self.velocity = np.zeros(3)
        self._heading = HeadingReference(1)
        self.previous = self.bundle.manifest.action_map.stand()

    def observe(
        self,
        joint_position: ArrayLike,
        joint_velocity: ArrayLike,
        orientation: ArrayLike,
        angular_velocity: ArrayLike,
        step: int,
    ) -> Array:
        """The observation of a policy step, history included.

        Args:
            joint_position: [joint] in rad.
            joint_velocity: [joint] in rad/s.
            orientation: [3] roll, pitch, yaw in rad.
            angular_velocity: [3] in rad/s.
        """
        sensed = self._sense(joint_position, joint_velocity, orientation, angular_velocity, step)
        stacked = self._observer.push(sensed) if self._begun else self._observer.reset(sensed)
        self._begun = True
        return stacked[0].numpy()

    def _sense(self, *readings: Any) -> Sensed:
        position, velocity, orientation, rates, step = readings
        angles = np.array(orientation, dtype=float)
        if not self._begun:
            self._yaw = angles[2]
        # Yaw is relative to the start of the episode, and continuous although the sensor's yaw wraps around.
        angles[2] = np.remainder(angles[2] - self._yaw + np.pi, 2 * np.pi) - np.pi
        values = (position, velocity, self.previous, angles, rates)
        rows = (torch.as_tensor(np.asarray(value, dtype=float))[None] for value in values)
        yaw = torch.tensor([angles[2]], dtype=torch.float64)
        if self._begun:
            self._heading.step(yaw, torch.from_numpy(self.velocity[2:]), POLICY_PERIOD)
        else:
            self._heading.begin(torch.ones(1, dtype=torch.bool), yaw)
        asked = {"velocity": torch.from_numpy(self.velocity)[None], "heading": self._heading.heading[:, None]}
        phase = None if self._cycle is None else torch.tensor([step * POLICY_PERIOD / self._cycle % 1.0]).double()
        return Sensed(*rows, phase=phase, commands=asked)

    def act(self, observation: Array) -> Array:
        """The action [2 controlled joint] in [-1, 1], remembered for the next observation."""
        self.previous = np.clip(self.bundle.act(observation), -1.0, 1.0)
        return self.previous

    def command(self, action: Array) -> Command:
        """Commands of all joints."""
        commands = self.bundle.manifest.action_map.commands(action)
        return Command(commands["position_target"], commands["p_gain"], commands["d_gain"])


STOPPING = 2.0
"""Time before the end of a commanded walk at which the command becomes zero [s], so that the robot comes to rest."""


class FollowPolicy(Phase):
    """The phase in which the policy commands at every fourth deadline.

    A policy with velocity commands must stand during the last `STOPPING` seconds and after its command source is lost.

    Args:
        commands: source of the velocity command; None: stand.

    Attributes:
        on_begin: function called once, immediately before the first observation.
        on_end: function called once, after the last step.
    """

    name = "policy"
    log = "run"

    def __init__(self, runner: PolicyRunner, duration: float, commands: CommandSource | None = None):
        if not duration > 0:
            raise ValueError(f"duration must be positive, got {duration}")
        self._runner, self._source = runner, commands
        self._steps = max(1, round(duration / (POLICY_TICKS * PERIOD)))
        self._last_step = -1
        self.on_begin: Callable[[], None] = lambda: None
        self.on_end: Callable[[], None] = lambda: None
        self._command: Command | None = None
        self._channels: dict[Any, Array] = {}
        runner.reset()

    def command(self, elapsed: int, state: RobotState) -> Command | None:
        """The current command, updated if a policy step is due.

        Raises:
            Stop: if the policy refuses the observation or its action is not finite.
        """
        # A step whose deadline was skipped runs at the next tick.
        step = elapsed // POLICY_TICKS
        if step >= self._steps:
            self.on_end()
            return None
        if self._command is None:
            self.on_begin()
        if step > self._last_step:
            self._last_step = step
            self._step(step, state)
        return self._command

    def _step(self, step: int, state: RobotState) -> None:
        if state.orientation is None or state.angular_velocity is None:
            raise Stop(ExitCode.NON_FINITE, "the policy needs an IMU, but the robot has none", damp=True)
        seen = (state.position, state.velocity, state.orientation, state.angular_velocity)
        self._runner.velocity = self._asked(step)
        try:
            observation = self._runner.observe(*seen, step)
            action = self._runner.act(observation)
        except ValueError as error:
            raise Stop(ExitCode.NON_FINITE, f"the policy stopped: {error}", damp=True) from error
        if not np.isfinite(action).all():
            raise Stop(ExitCode.NON_FINITE, "the policy's action is not finite; refused", damp=True)
        self._command = self._runner.command(action)
        self._channels = {("policy", "observation"): observation, ("policy", "action"): action.copy()}

    def _asked(self, step: int) -> Array:
        """The velocity commanded at a step ``[3]``."""
        time = step * POLICY_PERIOD
        asked = None if self._source is None else self._source.at(time)
        if asked is None and self._source is not None:
            self._source = None  # lost permanently: a stopped robot must not start by itself
        ends = self._steps * POLICY_PERIOD - time <= STOPPING
        return STANDING.copy() if asked is None or ends else asked

    def channels(self) -> dict[Any, Array]:
        """Current observation and action."""
        return self._channels


@dataclass(frozen=True)
class PolicyReplay:
    """Result of replaying policy steps of a log through a policy.

    Attributes:
        action_difference: largest absolute difference of an action.
        observation_difference: largest absolute difference of an observation; NaN if none was logged.
        first: step of the first action beyond the tolerance; None if there is none.
    """

    steps: int
    action_difference: float
    observation_difference: float
    first: int | None

    @property
    def ok(self) -> bool:
        """Whether all actions equal the recorded ones."""
        return self.action_difference < TOLERANCE

    def __str__(self) -> str:
        verdict = "the same actions" if self.ok else f"different actions from step {self.first} on"
        return (
            f"{self.steps} policy steps, {verdict}: largest |action difference| {self.action_difference:.2e}, "
            f"largest |observation difference| {self.observation_difference:.2e}"
        )


def replay_policy(log: Rollout, runner: PolicyRunner) -> PolicyReplay:
    """Replay the sensor readings of an episode through a policy and compare; rows have the loop's or policy's rate.

    Raises:
        ValueError: if a channel is missing in the log, or if rate or kind of policy differ.
    """
    sensed = ("joint/position", "joint/velocity", "imu/orientation", "imu/angular_velocity")
    for key in ("policy/action", *sensed):
        if key not in log:
            raise ValueError(f"the log has no {key}; give the folder `run` of a run with a policy")
    if log.batched:
        raise ValueError("the log has an episode axis; give one episode")
    asked = runner.bundle.manifest
    for what, size in (("action", asked.action_map.size), ("observation", asked.observation_size)):
        if f"policy/{what}" in log and (logged := log.array(f"policy/{what}").shape[-1]) != size:
            raise ValueError(
                f"the log's {what}s have {logged} numbers, but those of this policy have {size}; give the policy that"
                " the log recorded"
            )
    taken = log.array("policy/action")
    seen = log.array("policy/observation") if "policy/observation" in log else np.full((log.rows, 1), np.nan)
    readings = [log.array(key) for key in sensed]
    runner.reset()
    steps, rows = policy_rows(log, asked.policy_rate)
    actions, observations = [], []
    for step, row in zip(steps, rows, strict=True):
        observation = runner.observe(*(values[row] for values in readings), step=step)
        actions.append(np.abs(runner.act(observation) - taken[row]).max())
        observations.append(np.abs(observation - seen[row]).max())
    beyond = [step for step, difference in zip(steps, actions, strict=True) if not difference < TOLERANCE]
    return PolicyReplay(len(steps), float(max(actions)), float(max(observations)), beyond[0] if beyond else None)
