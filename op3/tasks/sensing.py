"""From the robot's state to what the policy's computer reads: delayed, noisy, in whole counts."""

from collections import deque

import torch
from torch import Tensor

from op3.tasks.task import Sensors

Readings = dict[str, Tensor]
"""By the names of `Sensors`: ``[sim, joint]`` or ``[sim, 3]``."""


class SensorBank:
    """The sensors of many robots.

    Args:
        sensors: what each does.
        generator: of the noise.
    """

    def __init__(self, sensors: Sensors, generator: torch.Generator):
        self._sensors = vars(sensors)
        self._generator = generator
        self.depth = max(sensor.ticks for sensor in self._sensors.values()) + 1
        self._past: deque[Readings] = deque(maxlen=self.depth)

    def reset(self, readings: Readings, rows: Tensor | None = None) -> None:
        """These robots have stood like this for long; `rows` is a mask ``[sim]``, None for all."""
        if rows is None or not self._past:
            self._past.extend([readings] * self.depth)
            return
        mask = rows[:, None]
        for past in self._past:
            past.update({name: torch.where(mask, value, past[name]) for name, value in readings.items()})

    def push(self, readings: Readings) -> None:
        """Take the robots' state at a control tick."""
        self._past.append(dict(readings))

    def read(self) -> Readings:
        """What the computer reads now."""
        result = {}
        for name, sensor in self._sensors.items():
            value = self._past[-1 - sensor.ticks][name]
            if sensor.noise:
                value = value + sensor.noise * torch.randn(value.shape, generator=self._generator, dtype=value.dtype)
            if sensor.unit:
                value = torch.round(value / sensor.unit) * sensor.unit
            result[name] = value
        return result
