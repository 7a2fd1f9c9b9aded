"""Packets lost on the servos' bus."""

from typing import Literal

import numpy as np

from op3.servo.effect import Effect, Parameter, Stage, register
from op3.servo.law import CURRENT
from op3.servo.machine_code import scalar

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""Step of the generator of random numbers."""


@scalar
def chance(seed, number):
    """A random number in [0, 1) as a function of seed and index: splitmix64 (Steele et al., 2014)."""
    mixed = np.uint64(seed) * np.uint64(0xD1342543DE82EF95) + (np.uint64(number) + np.uint64(1)) * GOLDEN
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.float64((mixed ^ (mixed >> np.uint64(31))) >> np.uint64(11)) * 2.0**-53


@register
class PacketDrop(Effect):
    """Some command packets do not arrive; the servos then hold their last command.

    One packet carries the commands of all servos, so all servos lose it. The lost packets depend only on the seed and
    the number of the tick: all simulations lose the same packets, and more with a higher probability. If the
    probability is above 0 and the signal ``packet`` states which packets arrived, for example in the log of a
    diagnosis, that signal is used.

    Attributes:
        seed: seed of the random numbers.
        signal: the held signal: the current of a current-driven servo, or the goal of a position servo.
    """

    name = "packet_drop"
    foreseeable = False
    stage = Stage.TRANSPORT
    rank = -1
    equation = "u_k = u_{k-1} with probability p"
    source = "checksum errors on a half-duplex bus; range chosen by us"
    parameters = (Parameter("drop_probability", "-", 0.0, 0.1, 0.0, 0.0, "p", per_joint=False, least=0.0, most=1.0),)
    memory = ("held", "number")
    secants = ({"drop_probability": 0.05}, {"drop_probability": 0.2})
    fingerprint = "bursts one period long in all joints at once; more variance, the same mean"
    confounders = ("latency", "current_lag")
    separating_experiment = "gaps in the servos' tick registers, counted in a recording"

    seed: int = 0
    signal: Literal["target_current", "goal"] = "target_current"

    @staticmethod
    def reset(s, p):
        """The first command counts as received."""
        s.packet_drop_held = s.target_current if p.packet_drop_signal == CURRENT else s.goal

    @staticmethod
    def tick(s, p):
        """Hold the last command if this packet is lost."""
        if s.packet == 0.0:
            lost = chance(p.packet_drop_seed, s.packet_drop_number) < p.drop_probability
        else:
            lost = s.packet < 0.0 and p.drop_probability > 0.0
        s.packet_drop_number += 1.0
        sent = s.target_current if p.packet_drop_signal == CURRENT else s.goal
        s.packet_drop_held = s.packet_drop_held if lost else sent
        if p.packet_drop_signal == CURRENT:
            s.target_current = s.packet_drop_held
        else:
            s.goal = s.packet_drop_held
