"""Soft actor-critic for policies that command angles and gains."""

from op3.train.collector import Collector
from op3.train.demonstrations import Demonstrations, DemonstrationSettings
from op3.train.evaluate import evaluate
from op3.train.replay import Batch, Replay
from op3.train.sac import SAC, SACSettings
from op3.train.training import Progress, TrainSettings, train

__all__ = [
    "SAC",
    "Batch",
    "Collector",
    "DemonstrationSettings",
    "Demonstrations",
    "Progress",
    "Replay",
    "SACSettings",
    "TrainSettings",
    "evaluate",
    "train",
]
