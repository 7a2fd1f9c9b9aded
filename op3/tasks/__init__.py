"""Tasks: balancing and walking; rewards, evaluation; motions simulated, and the batched replay of logs."""

from op3.tasks.baselines import Hold, Random, StiffWalk, Zero, position_mode
from op3.tasks.beginning import board_of, episode_seed
from op3.tasks.evaluation import evaluation_return, evaluation_rewards
from op3.tasks.locomotion import LocomotionTask, locomotion_environment
from op3.tasks.randomisation import Randomisation
from op3.tasks.replay import Prediction, Replay
from op3.tasks.setups import Setup
from op3.tasks.simulate import ModelRobot, simulate_motion
from op3.tasks.task import POLICY_PERIOD, TASKS, Placement, Task, find_task

__all__ = [
    "POLICY_PERIOD",
    "TASKS",
    "Hold",
    "LocomotionTask",
    "ModelRobot",
    "Placement",
    "Prediction",
    "Random",
    "Randomisation",
    "Replay",
    "Setup",
    "StiffWalk",
    "Task",
    "Zero",
    "board_of",
    "episode_seed",
    "evaluation_return",
    "evaluation_rewards",
    "find_task",
    "locomotion_environment",
    "position_mode",
    "simulate_motion",
]
