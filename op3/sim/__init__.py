"""Simulation of robots with 1 ms steps and the servo law between steps, for many robots or one in a composer task."""

from typing import TYPE_CHECKING

from op3.common.lazy import lazy

if TYPE_CHECKING:
    from op3.common.assets import find_model, model_names
    from op3.sim.batch_simulation import BatchSimulation
    from op3.sim.geared_servo import GearedServo
    from op3.sim.model_file import load_model, model_hash, save_model
    from op3.sim.pendulum_simulation import PendulumSimulation
    from op3.sim.ports import ServoPorts, attach_servos
    from op3.sim.servo_models import model_for, servo_model
    from op3.sim.trajectories import TrajectoryDynamics, trajectory_dynamics
    from op3.sim.window_simulation import MeasuredMotion, Window, WindowSimulation

__all__ = [
    "BatchSimulation",
    "GearedServo",
    "MeasuredMotion",
    "PendulumSimulation",
    "ServoPorts",
    "TrajectoryDynamics",
    "Window",
    "WindowSimulation",
    "attach_servos",
    "find_model",
    "load_model",
    "model_for",
    "model_hash",
    "model_names",
    "save_model",
    "servo_model",
    "trajectory_dynamics",
]

__getattr__ = lazy(__name__)
