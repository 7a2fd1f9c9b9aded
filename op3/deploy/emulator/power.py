"""Battery and winding temperatures, for a physics that has none of its own."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from op3.robot import load_servo

Array = NDArray[np.float64]


@dataclass
class Battery:
    """Three lithium-polymer cells behind a resistance.

    Attributes:
        full: voltage without load when full [V]; 3 x 4.2 V.
        empty: voltage without load when empty [V]; 3 x 3.4 V.
        capacity: [A s]; the OP3's battery has 1.8 Ah (ROBOTIS e-Manual).
        resistance: of battery and harness [ohm].
        idle: current of computer, boards and idle servos [A] (inferred: 20 W computer, 20 x 40 mA).
        charge: share that is left, 1 for full.
    """

    full: float = 12.6
    empty: float = 10.2
    capacity: float = 6480.0
    resistance: float = 0.2
    idle: float = 2.5
    charge: float = 0.7
    voltage: float = 0.0

    def __post_init__(self):
        if not 0 <= self.charge <= 1:
            raise ValueError(f"the charge of a battery lies between 0 and 1, got {self.charge}")
        self.voltage = self._open - self.resistance * self.idle

    @property
    def _open(self) -> float:
        return self.empty + (self.full - self.empty) * self.charge

    def step(self, motor_power: float, duration: float) -> None:
        """Deliver power to the motors [W] for a while [s]; what they feed back charges nothing."""
        current = self.idle + max(motor_power, 0.0) / self.voltage
        self.charge = max(0.0, self.charge - current * duration / self.capacity)
        self.voltage = max(1.0, self._open - self.resistance * current)


@dataclass
class Windings:
    """Temperatures of the motors: one heat capacity each, heated by the current's losses.

    Attributes:
        ambient: [C].
        resistance: winding to air [K/W], one number or [joint]; see `ServoMake.thermal_resistance`.
        time: time constant [s] (inferred).
    """

    ambient: float = 28.0
    resistance: float | Array = field(default_factory=lambda: load_servo("xm430-w350").thermal_resistance)
    time: float = 240.0

    def start(self, count: int) -> Array:
        """Temperatures of motors that have not run, [joint] in C."""
        return np.full(count, self.ambient)

    def step(self, temperature: Array, losses: Array, duration: float) -> None:
        """Warm up or cool down in place.

        Args:
            temperature: [joint] in C.
            losses: [joint] in W.
            duration: [s].
        """
        temperature += duration / self.time * (self.ambient + self.resistance * losses - temperature)
