"""Balancing and walking as a dm_control composer task: the batched environment's twin, one robot at a time."""

from typing import Any

import numpy as np
import torch
from dm_control import composer
from dm_control.composer.observation import observable
from dm_env import specs

from op3.policy import ActionMap
from op3.robot import board_drive, build_scene, place_tiles, stack, tile_ids
from op3.servo import RobotModel
from op3.sim import GearedServo
from op3.tasks.beginning import begin, episode_seed
from op3.tasks.pushes import Pushes
from op3.tasks.rules import Outcome, Rules
from op3.tasks.setups import OP3_CONTROL_PERIOD
from op3.tasks.snapshot import Probe, Snapshot
from op3.tasks.task import POLICY_PERIOD, Task
from op3.tasks.whole_step import WholeStep

PHYSICS_TIMESTEP = 0.001
"""Step of the physics [s]; paper, 1 ms."""


class LocomotionTask(composer.Task):
    """A robot at a task; the action is the policy's.

    Build an environment with `locomotion_environment`: only then is the order of steps that of the batched environment,
    whose observations and rewards this one gives to rounding. A time step's ``observation`` has one entry of that name,
    history included.

    Args:
        seed: of everything random; episodes are those of the batched environment's first robot.
    """

    def __init__(self, task: Task, model: RobotModel, seed: int = 0, action_map: ActionMap | None = None):
        self.task = task
        self.action_map = action_map or ActionMap.around_stand()
        self._scene = build_scene(task.scene)
        assert self._scene.robot is not None
        self.servo = GearedServo(self._scene.joints, model, self._scene.robot.trunk, OP3_CONTROL_PERIOD)
        self._every = round(OP3_CONTROL_PERIOD / PHYSICS_TIMESTEP)
        self.set_timesteps(control_timestep=POLICY_PERIOD, physics_timestep=PHYSICS_TIMESTEP)
        self.observation = torch.zeros(1, task.observation_size, dtype=torch.float64)
        seen = observable.Generic(lambda physics: self.observation[0].numpy())
        seen.enabled = True
        self._observables: dict[str, observable.Observable] = {"observation": seen}
        self.rules = Rules(task, self.action_map, 1)
        self.seed(seed)

    def seed(self, seed: int) -> None:
        """Start the episodes of another seed."""
        self._seed, self._episodes = seed, 0

    @property
    def root_entity(self) -> composer.Entity:
        """The arena."""
        return self._scene.arena

    @property
    def task_observables(self) -> dict[str, observable.Observable]:
        """What the policy sees."""
        return self._observables

    def action_spec(self, physics: Any) -> specs.BoundedArray:
        """Target angles and gains, each in [-1, 1]."""
        del physics
        return specs.BoundedArray((self.action_map.size,), np.float64, minimum=-1.0, maximum=1.0)

    def after_compile(self, physics: Any, random_state: Any) -> None:
        """Find servos, sensors and tiles."""
        self.servo.after_compile(physics)
        model = physics.model.ptr
        self._probe = Probe(model, self._scene, self.task.cycle is not None)
        self._whole_step = WholeStep(model, self._scene, 1, self.task.cycle is not None)
        self._tiles = tile_ids(model)
        assert self._scene.robot is not None
        self._trunk = model.body(self._scene.robot.trunk.full_identifier).id

    def initialize_episode(self, physics: Any, random_state: Any) -> None:
        """Put the robot down for the next episode."""
        beginning = begin(self.task, self._scene, episode_seed(self._seed, 0, self._episodes))
        self._episodes += 1
        data, model = physics.data.ptr, physics.model.ptr
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = beginning.qpos, beginning.qvel, 0.0
        if beginning.tiles is not None:
            place_tiles(model.geom_pos, self._tiles, beginning.tiles)
        data.xfrc_applied[:] = 0.0
        self._pushes = None if beginning.push is None else Pushes([beginning.push])
        if beginning.board is not None:
            self._board: Any = stack([beginning.board])
            self._drive: Any = board_drive(model, beginning.board, OP3_CONTROL_PERIOD)
        first = {name: value[0] for name, value in self.rules.resting_commands(1).items()}
        self.servo.initialize_episode(physics, **first)
        phase = torch.tensor([beginning.phase], dtype=torch.float64)
        self.observation = self.rules.begin(self._snapshot(physics), torch.ones(1, dtype=torch.bool), phase)
        self.outcome: Outcome | None = None

    def before_step(self, physics: Any, action: Any, random_state: Any) -> None:
        """Take the policy's action."""
        del random_state
        self._whole_step.begin(physics.data.ptr.site_xpos[None])
        self._action = torch.as_tensor(action, dtype=torch.float64)[None]
        self._commands = {name: value[0] for name, value in self.rules.action_map.commands(self._action).items()}
        self._substep, self._start = 0, self.rules.time.numpy()

    def before_substep(self, physics: Any, action: Any, random_state: Any) -> None:
        """Drive the board and tick the servos every 8 ms; run the servo law."""
        del action
        if self._substep % self._every == 0:
            data, time = physics.data.ptr, self._start + self._substep * PHYSICS_TIMESTEP
            if self._pushes is not None:
                self._pushes.drive(time, data.xfrc_applied[self._trunk][None])
            if self.task.board is not None:
                self._drive.apply(self._board, time, data.qpos[None], data.qvel[None], data.qfrc_applied[None])
            self.servo.before_step(physics, **self._commands)
        self.servo.before_substep(physics)
        self._substep += 1

    def after_substep(self, physics: Any, random_state: Any) -> None:
        """Look at what the step's means and peaks are made of."""
        del random_state
        data = physics.data.ptr
        arrays = (data.qpos, data.qvel, data.sensordata, data.site_xpos, self.servo.motor_current)
        self._whole_step.look(*(array[None] for array in arrays))

    def after_step(self, physics: Any, random_state: Any) -> None:
        """Judge the step."""
        del random_state
        snapshot = self._snapshot(physics)
        data = physics.data.ptr
        failed = torch.tensor([not np.isfinite(data.qacc).all() or bool(data.warning.number.any())])
        self.throughout = self._whole_step.result()
        self.outcome = self.rules.finish(self._action, snapshot, self.throughout, failed)
        self.observation = self.outcome.observation

    def get_reward(self, physics: Any) -> float:
        """The training reward of the step."""
        del physics
        return 0.0 if self.outcome is None else float(self.outcome.reward)

    def should_terminate_episode(self, physics: Any) -> bool:
        """Whether the robot fell or the time is over."""
        del physics
        outcome = self.outcome
        return outcome is not None and bool(outcome.terminated | outcome.truncated)

    def get_discount(self, physics: Any) -> float:
        """0 where the robot fell, 1 elsewhere, the time limit included."""
        del physics
        return 0.0 if self.outcome is not None and bool(self.outcome.terminated) else 1.0

    def _snapshot(self, physics: Any) -> Snapshot:
        data = physics.data.ptr
        channels = {key: value[None] for key, value in self.servo.measure(physics).items()}
        qpos, qvel, sensors = (torch.from_numpy(array)[None] for array in (data.qpos, data.qvel, data.sensordata))
        return self._probe.read(qpos, qvel, sensors, channels)


def locomotion_environment(task: LocomotionTask, seed: int = 0) -> composer.Environment:
    """A composer environment whose physics steps are those of the batched environment; diverging ends an episode."""
    return composer.Environment(
        task,
        random_state=np.random.RandomState(seed),
        raise_exception_on_physics_error=False,
        strip_singleton_obs_buffer_dim=True,
        legacy_step=False,
    )
