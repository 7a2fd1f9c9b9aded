"""Robots whose truth is hidden: an independent physics behind noisy, quantised sensors."""

from op3.stand_in.cases import Case, draw_case, make_case, open_answers, seal
from op3.stand_in.hidden import CATALOGUE, KINDS, OUTSIDERS, SEVERITIES, Hidden
from op3.stand_in.leg import record_leg
from op3.stand_in.leg_servos import LegTruth
from op3.stand_in.robot import StandIn
from op3.stand_in.sensors import Sensors
from op3.stand_in.world import RANDOM_RANGES, World, world_names

__all__ = [
    "CATALOGUE",
    "KINDS",
    "OUTSIDERS",
    "RANDOM_RANGES",
    "SEVERITIES",
    "Case",
    "Hidden",
    "LegTruth",
    "Sensors",
    "StandIn",
    "World",
    "draw_case",
    "make_case",
    "open_answers",
    "record_leg",
    "seal",
    "world_names",
]
