"""A task as a dm_control composer task, for one robot."""

from typing import Any

import numpy as np
import torch
from dm_control import composer
from dm_control.composer.observation import observable
from dm_env import specs

from op3.common.settings import CONTROL_PERIOD
from op3.policy import ActionMap
from op3.robot import load_robot
from op3.scenes import build_scene, tile_ids
from op3.servo import RobotModel
from op3.sim import GearedServo
from op3.tasks.episodes import World, episode_seed
from op3.tasks.mdp import Mdp, Outcome
from op3.tasks.snapshot import Probe, Snapshot
from op3.tasks.task import POLICY_PERIOD, Task
from op3.tasks.whole_step import WholeStep

PHYSICS_TIMESTEP = 0.001
"""Step of the physics [s]; paper, 1 ms."""


class ComposerTask(composer.Task):
    """A robot with a task; its actions are the policy's actions.

    Build an environment with `composer_environment`: it takes steps in the order of the batched environment, whose
    observations and rewards this task reproduces up to rounding. A time step has one entry ``observation``, with
    history; the servos' observables exist but are disabled.

    Args:
        seed: seed of the episodes, which are those of the batched environment's first robot.
    """

    def __init__(self, task: Task, model: RobotModel, seed: int = 0, action_map: ActionMap | None = None):
        self.task = task
        self.action_map = action_map or task.action_map()
        self.scene = build_scene(task.scene, robot=load_robot(task.robot))
        robot = self.scene.robot
        assert robot is not None
        base = None if robot.robot.file.base is None else robot.trunk
        self.servos = GearedServo(self.scene.joints, model, base, CONTROL_PERIOD)
        robot.attach(self.servos)
        self._every = round(CONTROL_PERIOD / PHYSICS_TIMESTEP)
        self.set_timesteps(control_timestep=POLICY_PERIOD, physics_timestep=PHYSICS_TIMESTEP)
        self.mdp = Mdp(task, self.scene, model, self.action_map, 1)
        self.observation = torch.zeros(1, self.mdp.observer.size, dtype=torch.float64)
        self.outcome: Outcome | None = None
        self._begins = False
        seen = observable.Generic(self._observe)
        seen.enabled = True
        self._observables: dict[str, observable.Observable] = {"observation": seen}
        self.seed(seed)

    def seed(self, seed: int) -> None:
        """Restart with the episodes of another seed."""
        self._seed, self._episodes = seed, 0

    @property
    def root_entity(self) -> composer.Entity:
        """The arena."""
        return self.scene.arena

    @property
    def task_observables(self) -> dict[str, observable.Observable]:
        """The policy's observation."""
        return self._observables

    def action_spec(self, physics: Any) -> specs.BoundedArray:
        """Target angles and gains, each in [-1, 1]."""
        del physics
        return specs.BoundedArray((self.action_map.size,), np.float64, minimum=-1.0, maximum=1.0)

    def after_compile(self, physics: Any, random_state: Any) -> None:
        """Look up sensors, and call `attach` of all events."""
        del random_state
        model, data = physics.model.ptr, physics.data.ptr
        with_feet = self.task.gait is not None
        self._probe = Probe(model, self.scene, with_feet)
        self._whole_step = WholeStep(model, self.scene, 1, with_feet)
        assert self.scene.robot is not None
        base = model.body(self.scene.robot.trunk.full_identifier).id
        self.mdp.attach(
            World(
                model=model,
                qpos=data.qpos[None],
                qvel=data.qvel[None],
                qfrc_applied=data.qfrc_applied[None],
                base_wrench=data.xfrc_applied[base][None],
                geom_pos=model.geom_pos[None] if len(tile_ids(model)) else None,
            )
        )

    def initialize_episode(self, physics: Any, random_state: Any) -> None:
        """Place the robot for the next episode; the servos' own hook follows."""
        del random_state
        seed = episode_seed(self._seed, 0, self._episodes)
        self._episodes += 1
        data = physics.data.ptr
        data.qfrc_applied[:] = data.xfrc_applied[:] = 0.0
        episodes = self.mdp.begin(np.zeros(1, dtype=np.int64), np.array([seed]))
        data.qpos[:], data.qvel[:] = episodes.qpos[0], episodes.qvel[0]
        self.servos.command(**{name: value[0] for name, value in self.mdp.resting_commands(1).items()})
        self.outcome, self._begins = None, True

    def before_step(self, physics: Any, action: Any, random_state: Any) -> None:
        """Take the policy's action."""
        del random_state
        self._whole_step.begin(physics.data.ptr.site_xpos[None])
        self._action = torch.as_tensor(action, dtype=torch.float64)[None]
        self.servos.command(**{name: value[0] for name, value in self.action_map.commands(self._action).items()})
        self._substep, self._start = 0, self.mdp.time.numpy()

    def before_substep(self, physics: Any, action: Any, random_state: Any) -> None:
        """Let events act every 8 ms; the servos' own hook follows."""
        del physics, action, random_state
        if self._substep % self._every == 0:
            self.mdp.tick(self._start + self._substep * PHYSICS_TIMESTEP)
        self._substep += 1

    def after_substep(self, physics: Any, random_state: Any) -> None:
        """Update the step's means and peaks."""
        del random_state
        data = physics.data.ptr
        arrays = (data.qpos, data.qvel, data.sensordata, data.site_xpos, self.servos.motor_current)
        self._whole_step.look(*(array[None] for array in arrays))

    def after_step(self, physics: Any, random_state: Any) -> None:
        """Compute reward, termination and observation."""
        del random_state
        data = physics.data.ptr
        failed = torch.tensor([not np.isfinite(data.qacc).all() or bool(data.warning.number.any())])
        self.statistics = self._whole_step.result()
        self.outcome = self.mdp.finish(self._action, self._snapshot(physics), self.statistics, failed)
        self.observation = self.outcome.observation

    def get_reward(self, physics: Any) -> float:
        """The training reward of the step."""
        del physics
        return 0.0 if self.outcome is None else float(self.outcome.reward)

    def should_terminate_episode(self, physics: Any) -> bool:
        """Whether the robot failed or the time is over."""
        del physics
        outcome = self.outcome
        return outcome is not None and bool(outcome.terminated | outcome.truncated)

    def get_discount(self, physics: Any) -> float:
        """0 after a failure, otherwise 1, including at the time limit."""
        del physics
        return 0.0 if self.outcome is not None and bool(self.outcome.terminated) else 1.0

    def _observe(self, physics: Any) -> np.ndarray:
        """The policy's observation; the first in an episode is requested after the servos have been initialised."""
        if self._begins:
            self.observation, self._begins = self.mdp.begun(self._snapshot(physics)), False
        return self.observation[0].numpy()

    def _snapshot(self, physics: Any) -> Snapshot:
        data = physics.data.ptr
        channels = {key: value[None] for key, value in self.servos.measure(physics).items()}
        arrays = (data.qpos, data.qvel, data.sensordata, data.xpos, data.xquat, data.site_xpos)
        qpos, qvel, sensors, place, turn, sites = (torch.from_numpy(array)[None] for array in arrays)
        return self._probe.read(qpos, qvel, sensors, (place, turn), sites, channels)


def composer_environment(task: ComposerTask, seed: int = 0) -> composer.Environment:
    """A composer environment with the same physics steps as the batched environment; divergence ends an episode."""
    return composer.Environment(
        task,
        random_state=np.random.RandomState(seed),
        raise_exception_on_physics_error=False,
        strip_singleton_obs_buffer_dim=True,
        legacy_step=False,
    )
