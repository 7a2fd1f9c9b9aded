"""Learning algorithms for policies, and the training loop."""

import logging
import warnings
from typing import TYPE_CHECKING

from op3.common.lazy import lazy

with warnings.catch_warnings():  # TorchRL warns about its own classes
    warnings.simplefilter("ignore", DeprecationWarning)
    import torchrl.collectors  # noqa: F401
logging.getLogger("torchrl").setLevel(logging.WARNING)  # and logs every created storage

# isort: split
from op3.train.algorithm import Algorithm, AlgorithmSettings, Explorer
from op3.train.greedy_episodes import evaluate
from op3.train.off_policy import Mirrored, OffPolicy, OffPolicySettings
from op3.train.sac import SAC, SACSettings
from op3.train.training import Curriculum, Progress, TrainSettings, train

if TYPE_CHECKING:
    from op3.train.ppo import PPO, PPOSettings
    from op3.train.recorded import transitions
    from op3.train.td3 import TD3, TD3Settings

__all__ = [
    "PPO",
    "SAC",
    "TD3",
    "Algorithm",
    "AlgorithmSettings",
    "Curriculum",
    "Explorer",
    "Mirrored",
    "OffPolicy",
    "OffPolicySettings",
    "PPOSettings",
    "Progress",
    "SACSettings",
    "TD3Settings",
    "TrainSettings",
    "evaluate",
    "train",
    "transitions",
]

__getattr__ = lazy(__name__)
