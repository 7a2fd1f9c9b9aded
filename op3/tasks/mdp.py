"""The Markov decision process of a task for many robots: observations, rewards and ends of episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from op3.common.settings import nearest
from op3.policy import ActionMap
from op3.policy.observations import Sensed
from op3.policy.terms import Term, shape_of
from op3.robot import Robot
from op3.robot.register_units import ANGLE_UNIT, GYRO_UNIT
from op3.scenes import Scene
from op3.servo import RobotModel
from op3.tasks import commands, events, privileged, rewards, successes, terminations
from op3.tasks.episodes import Array, Episodes, World
from op3.tasks.snapshot import Snapshot
from op3.tasks.state import State
from op3.tasks.task import POLICY_PERIOD, Task
from op3.tasks.whole_step import StepStatistics

HOMES: Mapping[str, Any] = {
    "rewards": rewards,
    "shaping": rewards,
    "terminations": terminations,
    "success": successes,
    "commands": commands,
    "events": events,
    "privileged": privileged,
}
"""Kinds of terms, and the module in which short names are looked up."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of a policy step, tensors ``[env, ...]``.

    Attributes:
        observation: with history.
        reward: ``[env]``.
        terms: weighted contributions to the reward by name, ``[env]``; the reward is their sum.
        terminated: the robot failed, or its simulation did.
        truncated: the time is over.
        success: the terms of ``success`` hold, and the robot has not failed.
    """

    observation: Tensor
    reward: Tensor
    terms: dict[str, Tensor]
    terminated: Tensor
    truncated: Tensor
    success: Tensor


class Mdp:
    """A task for several robots: its terms and their memory, without a simulation.

    If it is created and called under ``with torch.device("cuda")``, all its tensors are on that device.

    Args:
        model: model of the servos, from which randomisation draws.

    Attributes:
        readings: latest sensor readings, quantised: joint_position, joint_velocity, orientation and
            angular_velocity, ``[env, joint | 3]``.
        terms: by kind and name.
        state: state at the end of the last policy step.
        privileged: observations only for critics, ``[env, number]``; see `op3.tasks.privileged`.

    Raises:
        ValueError: if a term is invalid; the message names the term and the field.
    """

    def __init__(self, task: Task, scene: Scene, model: RobotModel, action_map: ActionMap, num_envs: int):
        self.task, self.scene, self.action_map, self.num_envs = task, scene, action_map, num_envs
        self.robot: Robot = scene.robot_file
        context = {
            "robot": self.robot,
            "scene": scene,
            "model": model,
            "action_map": action_map,
            "num_envs": num_envs,
            "policy_period": POLICY_PERIOD,
            "duration": task.duration,
            "gait_cycle": task.cycle,
        }
        self.terms: dict[str, dict[str, Term]] = {}
        for kind, home in HOMES.items():
            options = {"weight": 1.0} if kind in ("rewards", "shaping") else {}
            inputs = 2 if kind == "events" else 1
            self.terms[kind] = {
                name: Term(kind, name, spec, home, context, options, inputs) for name, spec in task.terms(kind).items()
            }
        self.observer = task.observer(action_map.size)
        self.privileged = torch.zeros(num_envs, len(task.privileged_signs), dtype=torch.float64)
        self._units = _resolutions(self.robot)
        self.readings: dict[str, Tensor] = {}
        self.state: State
        self.steps = torch.zeros(num_envs, dtype=torch.int64)
        self._first_phase = torch.zeros(num_envs, dtype=torch.float64)
        self._first_action = torch.as_tensor(action_map.stand())
        self._previous = self._first_action.repeat(num_envs, 1)
        self._noise = [np.random.default_rng(0)] * num_envs

    @property
    def time(self) -> Tensor:
        """Time since each episode began [s], ``[env]``."""
        return self.steps.double() * POLICY_PERIOD

    @property
    def phase(self) -> Tensor:
        """Phase of the gait in cycles, ``[env]``; zeros without a gait."""
        cycle = self.task.cycle
        return 0.0 * self.time if cycle is None else torch.remainder(self.time / cycle + self._first_phase, 1.0)

    def event(self, name: str) -> Any:
        """The instance of an event by name; None if the task has no such event."""
        term = self.terms["events"].get(name)
        return None if term is None else term.target

    def set(self, path: str, value: float) -> None:
        """Change a number of a term by its path, such as ``shaping.speed_bonus.weight``.

        Raises:
            ValueError: if there is no such term or field.
        """
        kind, name, field = (*path.split("."), "", "")[:3]
        if kind not in self.terms or name not in self.terms[kind]:
            known = [f"{kind}.{name}" for kind, terms in self.terms.items() for name in terms]
            raise ValueError(f"{path}: the task has no such term{nearest(f'{kind}.{name}', known)}")
        self.terms[kind][name].set(field, value)

    def attach(self, world: World) -> None:
        """Let events look up the arrays that they change, once the simulation exists."""
        self._world = world
        for term in self.terms["events"].values():
            if hook := term.hook("attach"):
                hook(world)

    def begin(self, rows: np.ndarray, seeds: np.ndarray) -> Episodes:
        """Draw episodes of some robots.

        Args:
            rows: numbers of the robots, ``[row]``.
            seeds: seeds of their episodes, ``[row]``.

        Returns:
            Initial states to set before `begun` is called.
        """
        world = self._world
        qpos = np.tile(self.scene.initial_qpos(self.robot.home), (len(rows), 1))
        episodes = Episodes(rows, seeds, qpos, np.zeros((len(rows), world.qvel.shape[1])))
        mask = torch.zeros(self.num_envs, dtype=torch.bool)
        mask[rows] = True
        for kind in ("events", "commands"):
            for term in self.terms[kind].values():
                if hook := term.hook("begin"):
                    hook(episodes)
        for kind in ("rewards", "shaping", "terminations", "success", "privileged"):
            for term in self.terms[kind].values():
                if hook := term.hook("begin"):
                    hook(mask)
        self.steps[rows] = 0
        self._previous[rows] = self._first_action
        gait = self.task.gait
        if gait is not None:
            drawn = [g.random() for g in episodes.generators(2)] if gait.first_phase is None else gait.first_phase
            self._first_phase[rows] = torch.as_tensor(drawn, dtype=torch.float64)
        for row, generator in zip(rows, episodes.generators(5), strict=True):
            self._noise[row] = generator
        self._begun = mask
        return episodes

    def begun(self, snapshot: Snapshot) -> Tensor:
        """Begin the episodes whose initial states have been set; returns all observations, ``[env, observation]``."""
        for term in self.terms["commands"].values():
            if hook := term.hook("begun"):
                hook(self._begun, snapshot.readings["orientation"][:, 2])
        if terms := self.terms["privileged"]:
            still = StepStatistics.still(self.num_envs, len(self.robot.file.feet) if self.task.gait else 0)
            state = State(snapshot, still, self._previous, self._previous, self.time, self.phase, self._asked())
            at_first = self._privileged(state, {name: term for name, term in terms.items() if not term.keeps_memory})
            self.privileged = torch.where(self._begun[:, None], at_first, self.privileged)
        return self.observer.reset(self._sense(snapshot), self._begun, self._noise)

    def resting_commands(self, count: int) -> dict[str, Tensor]:
        """Servo commands at the beginning of an episode, ``[count, joint]``."""
        return self.action_map.commands(self._first_action.expand(count, -1))

    def tick(self, time: Array) -> None:
        """Let events act at a control tick, at times of each episode [s], ``[env]``."""
        for term in self.terms["events"].values():
            if not term.keeps_memory:
                term(self._world, time)
            elif hook := term.hook("tick"):
                hook(time)

    def finish(self, action: Tensor, snapshot: Snapshot, step: StepStatistics, failed: Tensor) -> Outcome:
        """Result of a policy step that has ended.

        Args:
            action: taken at its beginning, ``[env, action]``; clipped to [-1, 1], as in the command.
            failed: simulations that diverged, ``[env]``.
        """
        action = action.clamp(-1.0, 1.0)
        asked = self._asked()
        self.steps += 1
        for term in self.terms["commands"].values():
            if hook := term.hook("follow"):
                hook(snapshot.readings["orientation"][:, 2], asked)
        judged = step if self.task.whole_step else snapshot.at_the_end(step)
        self.state = state = State(snapshot, judged, action, self._previous, self.time, self.phase, asked)
        terms = {
            name: term.options["weight"] * self._value(kind, term, state)
            for kind in ("rewards", "shaping")
            for name, term in self.terms[kind].items()
        }
        reward = torch.stack(list(terms.values())).sum(0)
        terminated = failed.clone()
        for term in self.terms["terminations"].values():
            terminated |= self._value("terminations", term, state)
        success = ~terminated
        for term in self.terms["success"].values():
            success &= self._value("success", term, state)
        self._previous = action
        observation = self.observer.push(self._sense(snapshot), self._noise)
        self.privileged = self._privileged(state, self.terms["privileged"])
        # values of a diverged state are meaningless
        reward, observation = torch.where(failed, 0.0, reward), torch.where(failed[:, None], 0.0, observation)
        terms = {name: torch.where(failed, 0.0, term) for name, term in terms.items()}
        self.privileged = torch.where(failed[:, None], 0.0, self.privileged)
        truncated = (self.steps >= self.task.steps) & ~terminated
        return Outcome(observation, reward, terms, terminated, truncated, success)

    def _value(self, kind: str, term: Term, state: State) -> Tensor:
        """A term's value, checked to have one number per robot or, for a privileged term, per mirror sign."""
        value, axes, shape = term(state), "[env]", (self.num_envs,)
        if kind == "privileged":
            axes, shape = "[env, sign of its mirror]", (self.num_envs, len(term.target.mirror))
        if not isinstance(value, Tensor) or tuple(value.shape) != shape:
            raise ValueError(f"{kind}.{term.name} must return {axes} = {shape}, got {shape_of(value)}")
        if kind in ("terminations", "success") and value.dtype != torch.bool:
            raise ValueError(f"{kind}.{term.name} must return true or false for each robot, got {value.dtype}")
        return value.detach()

    def _privileged(self, state: State, terms: Mapping[str, Term]) -> Tensor:
        """Values of privileged terms, ``[env, number]``; 0 for terms of the task without a value."""
        columns = []
        for name, term in self.terms["privileged"].items():
            zeros = torch.zeros(self.num_envs, len(term.target.mirror), dtype=torch.float64)
            columns.append(self._value("privileged", term, state) if name in terms else zeros)
        return torch.cat(columns, 1) if columns else torch.zeros(self.num_envs, 0, dtype=torch.float64)

    def _asked(self) -> dict[str, Tensor]:
        """Current commands by name, ``[env, number]``."""
        return {name: term.at(self.time) for name, term in self.terms["commands"].items()}

    def _sense(self, snapshot: Snapshot) -> Sensed:
        self.readings = {n: torch.round(snapshot.readings[n] / unit) * unit for n, unit in self._units.items()}
        gait = None if self.task.gait is None else self.phase
        imu = {name: self.readings.get(name) for name in ("orientation", "angular_velocity")}
        joints = self.readings["joint_position"], self.readings["joint_velocity"]
        return Sensed(*joints, self._previous, **imu, phase=gait, commands=self._asked())


def _resolutions(robot: Robot) -> dict[str, Tensor]:
    """Resolution of the readings: ``[joint]`` in rad and rad/s, and ``[1]`` for the IMU."""

    def numbers(values: list[float]) -> Tensor:
        return torch.tensor(values, dtype=torch.float64)

    units = {
        "joint_position": numbers([servo.position_unit for servo in robot.servos]),
        "joint_velocity": numbers([servo.counts.velocity.si for servo in robot.servos]),
    }
    if robot.file.imu is not None:  # counts of the OpenCR's IMU
        units |= {"orientation": numbers([ANGLE_UNIT]), "angular_velocity": numbers([GYRO_UNIT])}
    return units
