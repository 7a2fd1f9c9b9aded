"""Simulation of a log's commands or of a motion with a model: predictions, windows and free-run simulation."""

from typing import TYPE_CHECKING

from op3.common.lazy import lazy

if TYPE_CHECKING:
    from op3.replay.log_replay import Prediction, Replay
    from op3.replay.setups import Setup
    from op3.replay.simulate import ModelRobot, simulate_motion

__all__ = ["ModelRobot", "Prediction", "Replay", "Setup", "simulate_motion"]

__getattr__ = lazy(__name__)
