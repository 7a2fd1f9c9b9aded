"""Soft actor-critic for policies that command angles and gains."""

from op3.train.collector import Collector
from op3.train.evaluate import evaluate
from op3.train.explorer import Explorer
from op3.train.practice import Practice
from op3.train.replay_buffer import Batch, ReplayBuffer
from op3.train.sac import SAC, SACSettings
from op3.train.training import Progress, TrainSettings, train

__all__ = [
    "SAC",
    "Batch",
    "Collector",
    "Explorer",
    "Practice",
    "Progress",
    "ReplayBuffer",
    "SACSettings",
    "TrainSettings",
    "evaluate",
    "train",
]
