"""Soft actor-critic for policies that command angles and gains."""

from op3.train.collector import Collector
from op3.train.evaluate import evaluate
from op3.train.explorer import Explorer
from op3.train.practice import Practice
from op3.train.replay import Batch, Replay
from op3.train.sac import SAC, SACSettings
from op3.train.training import Progress, TrainSettings, train

__all__ = [
    "SAC",
    "Batch",
    "Collector",
    "Explorer",
    "Practice",
    "Progress",
    "Replay",
    "SACSettings",
    "TrainSettings",
    "evaluate",
    "train",
]
