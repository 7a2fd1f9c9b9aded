"""Tasks: excitations and the bench as composer tasks, and the batched replay of logs."""

from op3.tasks.playback import Playback, bench_task, play, playback_environment, squat_task
from op3.tasks.replay import Prediction, Replay
from op3.tasks.setups import Setup
from op3.tasks.simulate import simulate_motion

__all__ = [
    "Playback",
    "Prediction",
    "Replay",
    "Setup",
    "bench_task",
    "play",
    "playback_environment",
    "simulate_motion",
    "squat_task",
]
