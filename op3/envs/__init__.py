"""TorchRL environments for the tasks."""

from typing import TYPE_CHECKING

from op3.common.lazy import lazy

if TYPE_CHECKING:
    from op3.envs.batched import BatchedEnv
    from op3.envs.composed import ComposerEnv
    from op3.envs.factory import make_env
    from op3.envs.record import record_episodes

__all__ = ["BatchedEnv", "ComposerEnv", "make_env", "record_episodes"]

__getattr__ = lazy(__name__)
