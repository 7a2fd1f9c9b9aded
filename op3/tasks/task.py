"""A task as data: a scene and named terms, read from ``conf/task/<name>.yaml``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, fields
from math import ceil
from pathlib import Path
from typing import Annotated, Any

import torch
from omegaconf import DictConfig, OmegaConf
from pydantic import BeforeValidator, Field

from op3.common.assets import named_configs
from op3.common.settings import CONTROL_PERIOD, Named, Number, Positive, Text, Whole, nearest, settings
from op3.policy.actions import ActionMap
from op3.policy.manifest import Manifest
from op3.policy.mirror import Mirror
from op3.policy.observation import Observer
from op3.policy.observations import Sensed
from op3.policy.terms import FUNCTION, Term, find
from op3.robot import Robot, load_robot
from op3.tasks import commands, privileged

TICKS = 4
"""Ticks of the PD control per policy step: 125 Hz and 31.25 Hz (paper)."""

POLICY_PERIOD = TICKS * CONTROL_PERIOD
"""Time between policy steps [s]."""

Terms = Named[Any]
"""Terms by name; each maps ``function`` (unless it equals the name), parameters and options to values."""


@settings("gait")
class Gait:
    """The clock of a gait.

    Attributes:
        cycle: duration of a gait cycle [s].
        first_phase: phase at which an episode begins [cycles]; None: drawn for every episode.
    """

    cycle: Positive
    first_phase: Annotated[Number, Field(ge=0, lt=1)] | None = 0.0


def _gait(value: Any) -> Any:
    return Gait(**value) if isinstance(value, Mapping) else value


@settings("task")
class Task:
    """A task. `op3.policy.terms.Term` finds its terms; a term set to null is omitted.

    Attributes:
        name: name of the task.
        robot: name or path of the file of the robot.
        scene: name for `op3.scenes.build_scene`.
        duration: time limit of an episode [s].
        history: number of earlier observations that the policy receives in addition to the latest.
        gait: clock of a gait; None for a task without one.
        actions: ``position: {span: <rad>, joints: <names>}`` and ``p_gain: {low: <A/rad>, high: <A/rad>}``; without
            ``p_gain`` the servos close their own loop.
        observations: terms of `op3.policy.observations`.
        rewards: terms of `op3.tasks.rewards` that define the task, each with a ``weight``.
        shaping: terms that only help learning, each with a ``weight``.
        terminations: terms of `op3.tasks.terminations`.
        success: terms of `op3.tasks.successes`; without any, an episode succeeds if it does not fail.
        events: terms of `op3.tasks.events`.
        commands: terms of `op3.tasks.commands`.
        privileged: terms of `op3.tasks.privileged`, further observations for critics.
        curricula: by the path of a number, such as ``shaping.speed_bonus.weight``, pairs of steps and value, linearly
            interpolated; only in training.
        whole_step: whether rewards use means of currents and body motion over the policy step, or only the values at
            its end, which miss most of the impact of a landing.
    """

    name: Text
    robot: Text
    scene: Text
    actions: Terms
    observations: Terms
    rewards: Terms
    duration: Positive = 10.0
    history: Whole = 0
    gait: Annotated[Gait | None, BeforeValidator(_gait)] = None
    shaping: Terms = field(default_factory=dict)
    terminations: Terms = field(default_factory=dict)
    success: Terms = field(default_factory=dict)
    events: Terms = field(default_factory=dict)
    commands: Terms = field(default_factory=dict)
    privileged: Terms = field(default_factory=dict)
    curricula: Named[Any] = field(default_factory=dict)
    whole_step: bool = True

    def __post_init__(self):
        if twice := set(self.terms("rewards")) & set(self.terms("shaping")):
            raise ValueError(f"task {self.name}: {min(twice)!r} is a term of both rewards and shaping; rename one")
        for kind, terms in (("rewards", self.reward_terms), ("observations", self.terms("observations"))):
            if not terms:
                raise ValueError(f"task {self.name}: {kind} has no term; give at least one")

    def terms(self, kind: str) -> dict[str, dict[str, Any]]:
        """Terms of a kind that are on, by name."""
        specs = {name: spec for name, spec in getattr(self, kind).items() if spec is not None}
        if bad := [name for name, spec in specs.items() if not isinstance(spec, Mapping)]:
            raise ValueError(f"{kind}.{bad[0]} must be a mapping of fields, or null, got {specs[bad[0]]!r}")
        return {name: dict(spec) for name, spec in specs.items()}

    @property
    def schedules(self) -> dict[str, Any]:
        """Curricula that are on, by path."""
        return {path: schedule for path, schedule in self.curricula.items() if schedule is not None}

    @property
    def steps(self) -> int:
        """Policy steps of a full episode; 10 s are 313 steps of 32 ms."""
        return ceil(self.duration / POLICY_PERIOD - 1e-9)

    @property
    def cycle(self) -> float | None:
        """Duration of a gait cycle [s]; None for a task without a gait."""
        return None if self.gait is None else self.gait.cycle

    @property
    def desired_velocity(self) -> tuple[float, float]:
        """Velocity forwards and sideways [m/s] of the reward term ``command``; zero without it."""
        forward, sideways = self.rewards.get("command", {}).get("velocity", (0.0, 0.0))
        return float(forward), float(sideways)

    @property
    def reward_terms(self) -> tuple[str, ...]:
        """Names of all terms in the training reward."""
        return (*self.terms("rewards"), *self.terms("shaping"))

    def action_map(self) -> ActionMap:
        """The action map of the task."""
        return ActionMap.of_terms(self.terms("actions"), load_robot(self.robot))

    @property
    def layout(self) -> dict[str, int]:
        """Names and widths of the parts of one observation."""
        return self.observer(self.action_map().size).layout

    @property
    def observation_size(self) -> int:
        """Numbers in the policy's observation, with history."""
        return self.observer(self.action_map().size).size

    def observer(self, action_size: int) -> Observer:
        """The observer of a policy with this number of actions."""
        robot = load_robot(self.robot)
        return Observer(self.terms("observations"), robot, self.history, self.example(robot, action_size))

    def mirror(self, action_map: ActionMap) -> Mirror:
        """Images of the task's observations and actions in the robot's plane of symmetry.

        Raises:
            ValueError: if a part has no mirror image; the message names it.
        """
        robot = load_robot(self.robot)
        images = {name: getattr(term.target, "mirror", None) for name, term in self._commands(robot).items()}
        example = self.example(robot, action_map.size)
        return Mirror(self.observer(action_map.size), example, action_map, images, self.privileged_signs)

    @property
    def privileged_signs(self) -> tuple[float, ...]:
        """Signs of the mirror image of each privileged number."""
        signs: list[float] = []
        for name, spec in self.terms("privileged").items():
            term = find(spec.get(FUNCTION, name), privileged, f"privileged.{name}")
            if not hasattr(term, "mirror"):
                raise ValueError(f"privileged.{name}: the function needs mirror = (<a sign for each of its numbers>)")
            signs += term.mirror
        return tuple(signs)

    def _commands(self, robot: Robot) -> dict[str, Term]:
        """The terms of the commands, for one robot."""
        context = {"num_envs": 1, "duration": self.duration, "robot": robot, "policy_period": POLICY_PERIOD}
        return {name: Term("commands", name, spec, commands, context) for name, spec in self.terms("commands").items()}

    def example(self, robot: Robot, action_size: int) -> Sensed:
        """Sensor readings of one robot in the home pose, ``[1, ...]``."""
        position = torch.from_numpy(robot.home)[None]
        three = torch.zeros(1, 3, dtype=torch.float64)
        imu = robot.file.imu is not None
        return Sensed(
            joint_position=position,
            joint_velocity=0.0 * position,
            previous_action=torch.zeros(1, action_size, dtype=torch.float64),
            orientation=three if imu else None,
            angular_velocity=three if imu else None,
            phase=None if self.gait is None else three[:, 0],
            commands={name: term.at(three[:, 0]) for name, term in self._commands(robot).items()},
        )

    def check_policy(self, manifest: Manifest, name: str) -> None:
        """Raise a ValueError that begins with the policy's name if the policy does not fit the task."""
        made, here = manifest.action_map.robot, load_robot(self.robot)
        if load_robot(made).name != here.name:
            raise ValueError(f"{name} was trained for the robot {made}, the task is for {here.name}; add robot={made}")
        layout = self.observer(manifest.action_map.size).layout
        try:
            manifest.check_fits(layout, self.history, 1 / CONTROL_PERIOD, 1 / POLICY_PERIOD)
        except ValueError as error:
            raise ValueError(f"{name} does not fit task {self.name}: {error}") from None

    def changed(self, changes: Mapping[str, Any]) -> Task:
        """The task with changed values, by dotted path such as ``gait.first_phase``; paths may be new."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        values["gait"] = None if self.gait is None else vars(self.gait)
        tree = OmegaConf.create({name: _plain(value) for name, value in values.items()})
        for path, value in changes.items():
            if path.split(".")[0] not in values:
                raise ValueError(f"a task has no {path.split('.')[0]!r}{nearest(path, values)}")
            OmegaConf.update(tree, path, value, merge=False, force_add=True)
        return _made(tree)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(entry) for name, entry in value.items()}
    return list(value) if isinstance(value, tuple) else value


def task_names() -> tuple[str, ...]:
    """The tasks of the project."""
    return tuple(named_configs("task"))


def find_task(task: str | Task, changes: Mapping[str, Any] | None = None, **values: Any) -> Task:
    """A task, with some of its values changed.

    Args:
        task: a name in ``conf/task``, or the path of such a file.
        changes: values by dotted path, see `Task.changed`.
        **values: values at the top, such as ``duration``.

    Raises:
        ValueError: if there is no such task, or no such value.
    """
    if isinstance(task, str):
        path = Path(task)
        beside = {file.stem: file for file in path.parent.glob("*.yaml")} if path.is_file() else {}
        task = _made(_read(path.stem if beside else task, beside))
    changes = {**(changes or {}), **values}
    return task.changed(changes) if changes else task


def _read(name: str, beside: Mapping[str, Path]) -> DictConfig:
    """A task's content, merged with the files in its defaults as Hydra does.

    Args:
        beside: files by name, used instead of the project's.
    """
    known = {**named_configs("task"), **beside}
    if name not in known:
        raise ValueError(f"unknown task {name!r}{nearest(name, known)}")
    written = known[name]
    own = OmegaConf.load(written) if isinstance(written, Path) else OmegaConf.create(written)
    assert isinstance(own, DictConfig)
    layers = [entry for entry in own.pop("defaults", []) if entry != "_self_"]
    merged = OmegaConf.merge(*(_read(layer, beside) for layer in layers), own)
    assert isinstance(merged, DictConfig)
    return merged


def _made(tree: DictConfig) -> Task:
    values: Any = OmegaConf.to_container(tree, resolve=True)
    return Task(**{name: value for name, value in values.items() if not name.startswith("_")})
