"""TorchRL environments over the tasks."""

from op3.envs.batched import BatchedEnv
from op3.envs.composed import ComposerEnv
from op3.envs.factory import make_env
from op3.envs.record import record_episodes

__all__ = ["BatchedEnv", "ComposerEnv", "make_env", "record_episodes"]
