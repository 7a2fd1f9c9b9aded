"""Faults of the bus and the robot, at random or at a given time: from `start` to `end` [s].

`device` is an id on the bus.
"""

from __future__ import annotations

from collections.abc import Collection
from math import inf
from typing import Any

from op3.common.settings import Listed, NotNegative, Number, Share, Whole, settings
from op3.deploy.registers import HardwareError


@settings("faults")
class Silent:
    """A device neither sends nor receives, as with an unplugged cable."""

    device: Whole
    start: Number = 0.0
    end: float = inf


@settings("faults")
class FrozenImu:
    """The IMU's registers keep their values."""

    start: Number = 0.0
    end: float = inf


@settings("faults")
class Overheat:
    """A servo's temperature rises at a rate [K/s] in addition to heating by its current."""

    device: Whole
    start: Number = 0.0
    rate: Number = 20.0


@settings("faults")
class BrownOut:
    """The supply drops to a voltage [V].

    Below the servos' lower voltage limit they report an input voltage error; below `RESET_VOLTAGE` they lose their
    memory and restart when the supply returns.
    """

    start: Number
    end: float = inf
    voltage: Number = 9.0


@settings("faults")
class HardwareFault:
    """A servo reports hardware errors, bits of `op3.deploy.registers.HardwareError`."""

    device: Whole
    start: Number
    error: int = HardwareError.OVERLOAD


@settings("faults")
class Unplug:
    """The USB plug is pulled."""

    start: Number


RESET_VOLTAGE = 6.0
"""Supply voltage below which a servo's processor stops [V] (inferred)."""

Scheduled = Silent | FrozenImu | Overheat | BrownOut | HardwareFault | Unplug


@settings("faults")
class Faults:
    """Faults of the bus. Rates are probabilities per packet, drawn independently.

    Loss rates of 0.0002 and 0.0026 have been observed on real robots.

    Attributes:
        lost: share of status packets that never reach the computer.
        corrupt: share of status packets that arrive with one changed byte.
        truncated: share of status packets that arrive without their end.
        late: share of status packets that arrive late and delay all later packets.
        unheard: share of instruction packets that no device receives.
        delay: delay of a late packet [s].
        scheduled: faults at given times.
    """

    lost: Share = 0.0
    corrupt: Share = 0.0
    truncated: Share = 0.0
    late: Share = 0.0
    unheard: Share = 0.0
    delay: NotNegative = 0.04
    scheduled: Listed[Any] = ()

    def __post_init__(self):
        if self.spoiling > 1:
            raise ValueError(
                "faults: lost, corrupt, truncated and late exclude each other, so their sum must be at most 1"
            )
        for fault in self.scheduled:
            if not isinstance(fault, Scheduled):
                kinds = ", ".join(kind.__name__ for kind in Scheduled.__args__)
                raise ValueError(f"faults: a scheduled fault must be one of {kinds}; got {fault!r}")

    @property
    def spoiling(self) -> float:
        """Share of the status packets that are lost or changed."""
        return self.lost + self.corrupt + self.truncated + self.late

    def check_on(self, ids: Collection[int]) -> None:
        """Raise an error for a fault of a device that is not on the bus with these ids."""
        for fault in self.scheduled:
            device = getattr(fault, "device", None)
            if device is not None and device not in ids:
                known = ", ".join(map(str, sorted(ids)))
                raise ValueError(f"faults: device {device} is not on the bus; it has {known}")
