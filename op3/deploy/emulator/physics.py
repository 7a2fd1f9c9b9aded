"""The robot behind the bus: the interface of its physics, and a stand-in robot with this interface."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from op3.robot import Robot
from op3.scenes import BoardMotion, WeightSchedule
from op3.scenes.scene import Scene
from op3.stand_in import HiddenWorld, StandIn
from op3.stand_in.sensors import Sensors

Array = NDArray[np.float64]

PERIOD = 0.001
"""Period of the servos' control loops [s] (inferred: the unit of the register `realtime_tick`)."""


class Physics(Protocol):
    """The physics of a robot, without its electronics.

    Attributes:
        known: content of its file; its joints are in the order of every [joint] array.
        supply: voltage of the supply [V]; None if the robot has a battery.
    """

    known: Robot
    supply: float | None

    @property
    def position(self) -> Array:
        """Joint angles as the encoders see them [joint] in rad."""
        ...

    def drive(self, enabled: NDArray[np.bool_], current: Array) -> None:
        """Set the currents [joint] in A; joints that are not enabled move freely, with friction only."""
        ...

    def advance(self, duration: float) -> None:
        """Simulate whole multiples of `PERIOD` [s]; raises a RuntimeError if the physics diverges."""
        ...

    def read(self) -> Sensors:
        """Current readings of all sensors in SI units, before rounding to registers; with the IMU if there is one."""
        ...

    def set_ground(self, board: BoardMotion | WeightSchedule | None = None, tiles: ArrayLike | None = None) -> None:
        """Set the motion of the ground, see `op3.stand_in.StandIn.set_ground`."""
        ...

    def foremost(self) -> float:
        """Forward position of the inner tip of the foremost foot in the world [m]; 0 without feet."""
        ...


class StandInPhysics(StandIn):
    """A stand-in robot with hidden parameters behind the bus. It has a battery, temperatures and an IMU.

    Args:
        seed: seed of sensor noise and servo state.
        joint_position: [joint] in rad at the start; by default home.
    """

    def __init__(
        self,
        world: HiddenWorld,
        scene: Scene,
        *,
        seed: int = 0,
        joint_position: ArrayLike | None = None,
    ):
        super().__init__(world, scene, seed=seed)
        self.reset(self.rest if joint_position is None else joint_position)
        self._sensors = self.read_sensors()

    @property
    def position(self) -> Array:
        """See `Physics`."""
        return self._sensors.position

    def advance(self, duration: float) -> None:
        """See `Physics`."""
        super().advance(duration)
        self._sensors = self.read_sensors()

    def read(self) -> Sensors:
        """See `Physics`."""
        sensors, supply = self._sensors, self.supply
        return sensors if supply is None else replace(sensors, voltage=np.full_like(sensors.voltage, supply))
