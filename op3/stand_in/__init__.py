"""Robots whose truth is hidden: an independent physics behind noisy, quantised sensors."""

from op3.stand_in.robot import StandIn
from op3.stand_in.sensors import Sensors
from op3.stand_in.world import RANDOM_RANGES, World, world_names

__all__ = ["RANDOM_RANGES", "Sensors", "StandIn", "World", "world_names"]
