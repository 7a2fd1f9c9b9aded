"""Tasks: balancing and walking; rewards, evaluation; motions simulated, and the batched replay of logs."""

from op3.tasks.baselines import Hold, Random, StiffWalk, Zero, position_mode
from op3.tasks.composer_task import ComposerTask, composer_environment
from op3.tasks.episodes import episode_seed
from op3.tasks.evaluation import evaluation_return, evaluation_rewards
from op3.tasks.randomisation import ParameterRanges
from op3.tasks.replay import Prediction, Replay
from op3.tasks.setups import Setup
from op3.tasks.simulate import ModelRobot, simulate_motion
from op3.tasks.task import POLICY_PERIOD, Task, find_task, task_names

__all__ = [
    "POLICY_PERIOD",
    "ComposerTask",
    "Hold",
    "ModelRobot",
    "ParameterRanges",
    "Prediction",
    "Random",
    "Replay",
    "Setup",
    "StiffWalk",
    "Task",
    "Zero",
    "composer_environment",
    "episode_seed",
    "evaluation_return",
    "evaluation_rewards",
    "find_task",
    "position_mode",
    "simulate_motion",
    "task_names",
]
