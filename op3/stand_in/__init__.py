"""Robots with hidden parameters: independent physics behind noisy, quantised sensors."""

from op3.stand_in.cases import Case, draw_case, make_case, open_answers, record_case, seal
from op3.stand_in.hidden import CATALOGUE, KINDS, OUTSIDERS, SEVERITIES, Hidden
from op3.stand_in.sensors import Sensors
from op3.stand_in.stand_in_robot import StandIn
from op3.stand_in.world import BENCH_RANGES, RANDOM_RANGES, HiddenWorld, world_names

__all__ = [
    "BENCH_RANGES",
    "CATALOGUE",
    "KINDS",
    "OUTSIDERS",
    "RANDOM_RANGES",
    "SEVERITIES",
    "Case",
    "Hidden",
    "HiddenWorld",
    "Sensors",
    "StandIn",
    "draw_case",
    "make_case",
    "open_answers",
    "record_case",
    "seal",
    "world_names",
]
