"""Running a policy on sensor readings: the same functions as in training, one robot at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.limits import Command
from op3.deploy.state import State
from op3.deploy.ticker import PERIOD, POLICY_TICKS
from op3.policy import PolicyBundle
from op3.policy.observation import BALANCE_LAYOUT, WALK_LAYOUT, History, observe
from op3.robot import JOINTS, pose
from op3.tasks.task import POLICY_PERIOD, TASKS

Array = NDArray[np.float64]


class PolicyRunner:
    """A policy, its memory and its clock.

    Args:
        bundle: the policy.
        cycle: duration of a gait cycle [s], for a policy that sees the phase; None for that of its task.

    Raises:
        ValueError: if the bundle cannot run on this robot; the message names the field.
    """

    def __init__(self, bundle: PolicyBundle, cycle: float | None = None):
        manifest = bundle.manifest
        layout = dict(manifest.layout)
        if layout not in (BALANCE_LAYOUT, WALK_LAYOUT):
            raise ValueError(f"field layout: this version observes {BALANCE_LAYOUT} and phase, the policy {layout}")
        manifest.check_fits(layout, manifest.history, 1 / PERIOD, 1 / (PERIOD * POLICY_TICKS))
        self._phased = "phase" in layout
        if cycle is None and manifest.task in TASKS:
            cycle = TASKS[manifest.task].cycle
        if self._phased and (cycle is None or cycle <= 0):
            raise ValueError("the policy sees the phase of a gait; give cycle=<seconds>")
        self.bundle = bundle
        self._cycle = cycle
        self._warm_up()
        self.reset()

    def _warm_up(self) -> None:
        """The first steps build tables and take a hundred times as long as later ones: not in a running loop."""
        self.reset()
        for step in range(3):
            self.act(self.observe(pose("stand"), np.zeros(len(JOINTS)), np.zeros(3), np.zeros(3), step))

    def reset(self) -> None:
        """Begin an episode: the robot has held the stand pose."""
        self._history = History(self.bundle.manifest.history)
        self._begun = False
        self._yaw = 0.0
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
            step: policy steps since the episode began.
        """
        angles = np.array(orientation, dtype=float)
        if not self._begun:
            self._yaw = angles[2]
        # Yaw counts from where the episode began, and does not jump where the sensor's wraps around.
        angles[2] = np.remainder(angles[2] - self._yaw + np.pi, 2 * np.pi) - np.pi
        phase = None
        if self._phased:
            assert self._cycle is not None
            phase = torch.tensor(step * POLICY_PERIOD / self._cycle % 1.0, dtype=torch.float64)
        now = observe(
            torch.as_tensor(np.asarray(joint_position, dtype=float)),
            torch.as_tensor(np.asarray(joint_velocity, dtype=float)),
            torch.from_numpy(angles),
            torch.as_tensor(np.asarray(angular_velocity, dtype=float)),
            torch.from_numpy(self.previous),
            phase,
        )
        stacked = self._history.push(now) if self._begun else self._history.reset(now)
        self._begun = True
        return stacked.numpy()

    def act(self, observation: Array) -> Array:
        """The action [2 controlled joint] in [-1, 1], remembered for the next observation."""
        self.previous = np.clip(self.bundle.act(observation), -1.0, 1.0)
        return self.previous

    def command(self, action: Array) -> Command:
        """Commands of all joints: those that the policy does not command hold the stand pose."""
        commands = self.bundle.manifest.action_map.commands(action)
        return Command(commands["position_target"], commands["p_gain"], commands["d_gain"])


class FollowPolicy:
    """The phase in which the policy commands, every fourth deadline.

    Args:
        runner: the policy.
        duration: of the episode [s].
    """

    name = "policy"
    log = "run"

    def __init__(self, runner: PolicyRunner, duration: float):
        if not duration > 0:
            raise ValueError(f"duration must be positive, got {duration}")
        self._runner = runner
        self._steps = max(1, round(duration / (POLICY_TICKS * PERIOD)))
        self._last_step = -1
        self.on_begin: Callable[[], None] | None = None
        """Called once, right before the first observation."""
        self._command: Command | None = None
        self._channels: dict[Any, Array] = {}
        runner.reset()

    def command(self, elapsed: int, state: State) -> Command | None:
        """The command in force; a new one where a policy step is due.

        Raises:
            Stop: if the policy refuses the observation or answers something that is not finite.
        """
        # A step whose own deadline was skipped is made up for at the next tick.
        step = elapsed // POLICY_TICKS
        if step >= self._steps:
            return None
        if step > self._last_step or self._command is None:
            self._last_step = step
            self._step(step, state)
        return self._command

    def _step(self, step: int, state: State) -> None:
        if self.on_begin is not None:
            self.on_begin()
            self.on_begin = None
        try:
            observation = self._runner.observe(
                state.position, state.velocity, state.orientation, state.angular_velocity, step
            )
            action = self._runner.act(observation)
        except ValueError as error:
            raise Stop(ExitCode.NON_FINITE, f"the policy refused: {error}", damp=True) from error
        if not np.isfinite(action).all():
            raise Stop(ExitCode.NON_FINITE, "the policy's action is not finite; refused", damp=True)
        self._command = self._runner.command(action)
        self._channels = {("policy", "observation"): observation, ("policy", "action"): action.copy()}

    def channels(self) -> dict[Any, Array]:
        """Observation and action in force."""
        return self._channels
