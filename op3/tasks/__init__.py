"""Tasks as lists of terms: balancing, walking, reaching; rewards, events, evaluation."""

from typing import TYPE_CHECKING

from op3.common.lazy import lazy

if TYPE_CHECKING:
    from op3.tasks.baselines import Hold, Random, StiffWalk, Zero, position_mode
    from op3.tasks.composer_task import ComposerTask, composer_environment
    from op3.tasks.episodes import episode_seed
    from op3.tasks.evaluation import evaluation_return, evaluation_rewards
    from op3.tasks.randomisation import ParameterRanges
    from op3.tasks.task import POLICY_PERIOD, Task, find_task, task_names

__all__ = [
    "POLICY_PERIOD",
    "ComposerTask",
    "Hold",
    "ParameterRanges",
    "Random",
    "StiffWalk",
    "Task",
    "Zero",
    "composer_environment",
    "episode_seed",
    "evaluation_return",
    "evaluation_rewards",
    "find_task",
    "position_mode",
    "task_names",
]

__getattr__ = lazy(__name__)
