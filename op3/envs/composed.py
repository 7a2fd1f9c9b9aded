"""One robot at a task through dm_control composer, with the keys of the batched environment."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from op3.envs.specs import as_tensordict, set_specs
from op3.policy import ActionMap
from op3.servo import RobotModel
from op3.tasks.composer_task import ComposerTask, composer_environment
from op3.tasks.task import Task


class ComposerEnv(EnvBase):
    """The composer version of `op3.envs.BatchedEnv` with one robot and the same actions, observations and rewards.

    It makes the task available to composer software and verifies the batched environment independently of
    ``mujoco.Batch``. For training, the batched environment is many times faster.

    Args:
        model: effects and parameter values of the robot.
    """

    def __init__(self, task: Task, model: RobotModel, seed: int = 0, *, action_map: ActionMap | None = None):
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([1]))
        self.composer_task = ComposerTask(task, model, seed, action_map)
        self.composer = composer_environment(self.composer_task, seed)
        self.task, self.model, self.action_map = task, model, self.composer_task.action_map
        set_specs(self, self.composer_task.mdp)

    def _set_seed(self, seed: int | None) -> None:
        self.composer_task.seed(0 if seed is None else int(seed))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        del tensordict, kwargs
        self.composer.reset()
        return as_tensordict(self.composer_task.mdp, self.composer_task.observation)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.composer.step(tensordict["action"][0].double().numpy())
        made = self.composer_task
        return as_tensordict(made.mdp, made.observation, made.outcome, made.statistics)
