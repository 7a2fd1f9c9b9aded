"""What is lost on the servos' bus."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from op3.servo.effect import Clock, Effect, Parameter, Prepared, Scope, Signals, Stage, register

TABLE_LENGTH = 4096
"""Random numbers drawn; a recording with more ticks sees them again."""


@register
@dataclass(frozen=True)
class PacketDrop(Effect):
    """Some command packets do not arrive; the servos then hold their last command.

    One packet carries the commands of all servos, so all lose it. Which packets are lost follows from the seed and the
    number of the tick alone: all simulations lose the same ones, and more where the probability is higher. Where
    `Signals.packet` tells whether one arrived, as a diagnosis reads it off a log, that counts if the probability is
    above 0.

    Attributes:
        seed: of the random numbers.
        signal: what is held: the current of a current-driven servo, or the goal of a position servo.
    """

    name: ClassVar[str] = "packet_drop"
    stage: ClassVar[Stage] = Stage.TRANSPORT
    rank: ClassVar[int] = -1
    equation: ClassVar[str] = "u_k = u_{k-1} with probability p"
    source: ClassVar[str] = "half-duplex bus, checksum errors: 0 to 3 % of packets"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("drop_probability", "-", 0.0, 0.1, 0.0, 0.0, "p", per_joint=False, least=0.0, most=1.0),
    )
    size: ClassVar[str] = "drop_probability"
    smallest: ClassVar[float] = 0.01
    secants: ClassVar[tuple[Mapping[str, float], ...]] = ({"drop_probability": 0.05}, {"drop_probability": 0.2})
    fingerprint: ClassVar[str] = "bursts one period long in all joints at once; more variance, the same mean"
    confounders: ClassVar[tuple[str, ...]] = ("latency", "current_lag")
    separating_experiment: ClassVar[str] = "count gaps in the servos' own tick registers"
    alias_class: ClassVar[str] = "timing"
    scopes: ClassVar[tuple[Scope, ...]] = ("robot",)

    seed: int = 0
    signal: Literal["target_current", "goal"] = "target_current"

    def prepare(self, values: Mapping[str, Tensor], clock: Clock) -> Prepared:
        """Random numbers of the ticks."""
        probability = values["drop_probability"]
        generator = torch.Generator().manual_seed(self.seed)
        chance = torch.rand(TABLE_LENGTH, generator=generator, dtype=torch.float64).to(probability.device)
        return {"probability": probability, "chance": chance}

    def reset(self, signals: Signals, prepared: Prepared) -> None:
        """The first command has arrived."""
        signals.state[self.name] = getattr(signals, self.signal).clone()
        signals.state["packet_number"] = torch.zeros((), dtype=torch.int64)

    def tick(self, signals: Signals, prepared: Prepared) -> None:
        """Hold the last command where this packet is lost."""
        number = int(signals.state["packet_number"])
        signals.state["packet_number"] = signals.state["packet_number"] + 1
        drawn = prepared["chance"][number % TABLE_LENGTH] < prepared["probability"]
        known = (signals.packet < 0) & (prepared["probability"] > 0)
        lost = torch.where(signals.packet == 0, drawn, known)
        arrived = torch.where(lost, signals.state[self.name], getattr(signals, self.signal))
        signals.state[self.name] = arrived
        setattr(signals, self.signal, arrived)
