"""What goes wrong on the bus and in the robot, at random or at a given time."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from math import inf, isfinite

from op3.deploy.registers import OPEN_CR_ID, HardwareError


@dataclass(frozen=True)
class Silent:
    """A device says nothing and hears nothing, as with a cable pulled.

    Attributes:
        device: its id.
        start: from when [s].
        end: until when [s].
    """

    device: int
    start: float = 0.0
    end: float = inf


@dataclass(frozen=True)
class FrozenImu:
    """The IMU's registers keep what they hold.

    Attributes:
        start: from when [s].
        end: until when [s].
    """

    start: float = 0.0
    end: float = inf


@dataclass(frozen=True)
class Overheat:
    """A servo's temperature rises beyond what its current explains.

    Attributes:
        device: its id.
        start: from when [s].
        rate: [K/s].
    """

    device: int
    start: float = 0.0
    rate: float = 20.0


@dataclass(frozen=True)
class BrownOut:
    """The supply breaks down.

    Below the servos' lower voltage limit they report an input voltage error; below `RESET_VOLTAGE` they lose their
    memory and start anew once it is back.

    Attributes:
        start: from when [s].
        end: until when [s].
        voltage: of the supply meanwhile [V].
    """

    start: float
    end: float = inf
    voltage: float = 9.0


@dataclass(frozen=True)
class HardwareFault:
    """A servo reports a hardware error.

    Attributes:
        device: its id.
        start: when [s].
        error: bits of `op3.deploy.registers.HardwareError`.
    """

    device: int
    start: float
    error: int = HardwareError.OVERLOAD


@dataclass(frozen=True)
class Unplug:
    """The USB plug is pulled.

    Attributes:
        start: when [s].
    """

    start: float


RESET_VOLTAGE = 6.0
"""Supply voltage below which a servo's processor stops [V] (inferred)."""

Scheduled = Silent | FrozenImu | Overheat | BrownOut | HardwareFault | Unplug

_RATES = ("lost", "corrupt", "truncated", "late", "unheard")


@dataclass(frozen=True)
class Faults:
    """What goes wrong. Rates are shares of the packets, drawn independently.

    Losses of 0.0002 and 0.0026 have been seen in the field.

    Attributes:
        lost: status packets that never reach the computer.
        corrupt: status packets that reach it with one byte changed.
        truncated: status packets that reach it without their end.
        late: status packets that reach it late, and all behind them.
        unheard: instruction packets that no device hears.
        delay: how late a late packet is [s].
        scheduled: what happens at a given time.
    """

    lost: float = 0.0
    corrupt: float = 0.0
    truncated: float = 0.0
    late: float = 0.0
    unheard: float = 0.0
    delay: float = 0.04
    scheduled: tuple[Scheduled, ...] = field(default=())

    def __post_init__(self):
        for name in _RATES:
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"faults: {name} is a share of packets between 0 and 1, got {getattr(self, name)}")
        if self.lost + self.corrupt + self.truncated + self.late > 1:
            raise ValueError(
                "faults: lost, corrupt, truncated and late are shares of the same packets; their sum is above 1"
            )
        if not (isfinite(self.delay) and self.delay >= 0):
            raise ValueError(f"faults: delay must be a time of at least 0 s, got {self.delay}")
        object.__setattr__(self, "scheduled", tuple(self.scheduled))
        for fault in self.scheduled:
            if not isinstance(fault, Scheduled):
                kinds = ", ".join(kind.__name__ for kind in Scheduled.__args__)
                raise ValueError(f"faults: what is scheduled is one of {kinds}; got {fault!r}")
            for item in fields(fault):
                if item.name in ("start", "rate", "voltage") and not isfinite(getattr(fault, item.name)):
                    raise ValueError(f"faults: {item.name} of {fault} must be finite")
            device = getattr(fault, "device", OPEN_CR_ID)
            if not (1 <= device <= 20 or device == OPEN_CR_ID):
                raise ValueError(f"faults: {fault} names device {device}; the bus has 1 to 20 and {OPEN_CR_ID}")
