"""One robot at a task through dm_control composer, with the keys of the batched environment."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from op3.envs.specs import PEAKS, set_specs
from op3.policy import ActionMap
from op3.servo import RobotModel
from op3.tasks.locomotion import LocomotionTask, locomotion_environment
from op3.tasks.task import Task


class ComposerEnv(EnvBase):
    """The composer twin of `op3.envs.BatchedEnv` with one robot: same actions, same observations and rewards.

    It shows the task to everything that speaks composer, and checks the batched environment independently of
    ``mujoco.Batch``; for training the batched one is many times faster.

    Args:
        model: effects and parameter values of the robot.
    """

    def __init__(self, task: Task, model: RobotModel, seed: int = 0, *, action_map: ActionMap | None = None):
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([1]))
        self.composer_task = LocomotionTask(task, model, seed, action_map)
        self.composer = locomotion_environment(self.composer_task, seed)
        self.task, self.model, self.action_map = task, model, self.composer_task.action_map
        set_specs(self, task, self.action_map, 1)

    def _set_seed(self, seed: int | None) -> None:
        self.composer_task.seed(0 if seed is None else int(seed))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        del tensordict, kwargs
        self.composer.reset()
        zeros = torch.zeros(1, 1)
        terms = {name: zeros.clone() for name in self.task.reward_terms}
        peaks = {name: zeros.clone() for name in PEAKS}
        return self._pack(terms, peaks, torch.zeros(1, dtype=torch.bool), torch.zeros(1, dtype=torch.bool))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.composer.step(tensordict["action"][0].double().numpy())
        outcome = self.composer_task.outcome
        assert outcome is not None
        terms = {name: term.float()[:, None] for name, term in outcome.terms.items()}
        throughout = self.composer_task.throughout
        peaks = {name: getattr(throughout, f"peak_{name}").float()[:, None] for name in PEAKS}
        answer = self._pack(terms, peaks, outcome.terminated, outcome.truncated)
        return answer.set("reward", outcome.reward.float()[:, None])

    def _pack(self, terms: dict, peaks: dict, terminated: torch.Tensor, truncated: torch.Tensor) -> TensorDict:
        flags = {"done": terminated | truncated, "terminated": terminated, "truncated": truncated}
        return TensorDict(
            {
                "observation": self.composer_task.observation.float(),
                "reward_terms": terms,
                "peak": peaks,
                **{name: flag.clone()[:, None] for name, flag in flags.items()},
            },
            self.batch_size,
        )
