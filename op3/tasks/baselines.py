"""Fixed policies without learning, as baselines for trained ones."""

import dataclasses
from math import pi
from typing import Any

import torch
from torch import Tensor

from op3.motions import SinusoidalGait
from op3.policy import ActionMap
from op3.robot import load_robot
from op3.servo import RobotModel, effect_class


class Hold:
    """Holds the stand pose, stiffly by default.

    Args:
        action_map: the task's action map.
        p_gain: P gain of every controlled joint [A/rad]; None: the highest, 6 A/rad.
    """

    def __init__(self, action_map: ActionMap, p_gain: float | None = None):
        self._action = torch.from_numpy(action_map.stand(p_gain))

    def act(self, observation: Tensor) -> Tensor:
        """The same action for every observation, ``[..., action]``."""
        return self._action.to(observation).expand(*observation.shape[:-1], -1)


class Zero:
    """Action zero: the stand pose with gains in the middle of their range."""

    def __init__(self, action_map: ActionMap):
        self._size = action_map.size

    def act(self, observation: Tensor) -> Tensor:
        """Zeros ``[..., action]``."""
        return observation.new_zeros(*observation.shape[:-1], self._size)


class Random:
    """Uniform actions."""

    def __init__(self, action_map: ActionMap, seed: int = 0):
        self._size = action_map.size
        self._generator = torch.Generator().manual_seed(seed)

    def act(self, observation: Tensor) -> Tensor:
        """Uniform in [-1, 1], ``[..., action]``."""
        shape = (*observation.shape[:-1], self._size)
        return 2.0 * torch.rand(shape, generator=self._generator, dtype=observation.dtype) - 1.0


POSITION_GAIN = 800.0
"""Position P gain register of the OP3's servos as delivered."""

_DUTY_PER_ERROR = 4096 / (2 * pi) / 128 / 885
"""Duty per radian and unit of the register: counts per radian, 128 (control table), 885 for full duty."""


class StiffWalk:
    """The walk shipped with the OP3, with servos in position mode; it needs a model from `position_mode`.

    Args:
        firmware_gain: position P gain register of the servos.
    """

    def __init__(self, firmware_gain: float = POSITION_GAIN):
        self.gait = SinusoidalGait(step=0.045)  # gives 0.3 m/s without foot slip
        self.firmware_gain = firmware_gain
        self._hold = Hold(ActionMap.around_stand(load_robot("op3")))

    def act(self, observation: Tensor) -> Tensor:
        """The stand pose; `commands` overrides it."""
        return self._hold.act(observation)

    def commands(self, time: Tensor) -> dict[str, Tensor]:
        """Goals of the servos at times since each episode's beginning, ``[sim]`` in s."""
        targets = torch.from_numpy(self.gait.targets(time.numpy()))
        return {"position_target": targets, "firmware_gain": torch.tensor(self.firmware_gain, dtype=torch.float64)}


def position_mode(model: RobotModel) -> RobotModel:
    """The same model with servos in position mode: internal loop, driven by voltage, with the same command latency.

    Raises:
        ValueError: if the model's servos are not driven by current.
    """
    motor: Any = model.effect("motor")
    servo: Any = effect_class("position_servo")
    made = model.without("current_pd").with_effect(dataclasses.replace(motor, drive="voltage"))
    made = made.with_effect(servo(error_gain=_DUTY_PER_ERROR, max_duty=1.0))
    if "latency" not in made.effect_names:
        return made
    latency: Any = made.effect("latency")
    return made.with_effect(dataclasses.replace(latency, signal="goal"))
