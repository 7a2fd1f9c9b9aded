"""Which command packets did not arrive, read off windows: would what follows be as measured if this one had been lost?

A lost packet leaves all servos with their last command for a period. Where the command changes much, that moves
currents and angles far beyond what noise does, so each packet can be asked by itself. Which ones were lost is chance: a
simulation that draws its own cannot be compared with a log tick by tick.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import special
from torch import Tensor

from op3.diagnose.fitting import Fit, with_point
from op3.diagnose.hypotheses import Hypothesis
from op3.diagnose.motion import PREROLL
from op3.diagnose.windows import WindowResiduals
from op3.servo import RobotModel
from op3.servo.effects import PacketDrop

Mask = NDArray[np.bool_]

TELLING = 160.0
"""What the loss of a packet has to add to the squares of a window's whitened residual for it to tell whether it was
lost. In a leg that lost none 0 of 821 such packets seemed lost, in two that lost every fortieth 12 of 693 and 22 of 699
did."""

SHOWN = 40.0
"""The same for a packet that is taken as lost where others were."""

LIKELY, CLEAR = 0.5, 0.7
"""Share of that by which the squares have to fall for a packet to be taken as lost, and to be clearly lost. Of one that
arrived they rise by all of it, of one that was lost they fall by all of it."""

DOUBTFUL = 0.3
"""Squares that fall by this share, and less than by `CLEAR`, are no losses, but something else that is missing."""

LEAST = 3
"""So many packets must clearly be lost."""

MOST = 0.15
"""Where a larger share seems lost, commands are late."""

PASSES = 3
"""Losses that are looked for in a window: each changes what another would do."""

ARRIVED, LOST = 1.0, -1.0
"""What `op3.servo.Signals.packet` says."""


@dataclass(frozen=True, eq=False)
class LostPackets:
    """What windows tell of packets.

    Attributes:
        packets: `ARRIVED` or `LOST`, of the ticks of every window and those before it, ``[window, tick]``.
        telling: number of packets that could be seen to be lost.
        lost: how many of them were.
    """

    packets: np.ndarray
    telling: int
    lost: int

    @property
    def share(self) -> float:
        """Of the packets that were lost."""
        return self.lost / self.telling

    def interval(self, level: float = 0.9) -> tuple[float, float]:
        """Of the probability of a loss (Clopper and Pearson, Biometrika 1934)."""
        tail, arrived = 0.5 * (1 - level), self.telling - self.lost
        low = special.betaincinv(self.lost, arrived + 1, tail) if self.lost else 0.0
        high = special.betaincinv(self.lost + 1, arrived, 1 - tail) if arrived else 1.0
        return float(low), float(high)


@dataclass(frozen=True, eq=False)
class LossHypothesis(Hypothesis):
    """Lost packets, those that the windows tell; how many is counted, not fitted.

    Attributes:
        found: what windows tell.
    """

    found: LostPackets | None = None

    def counted(self, fit: Fit) -> Fit:
        """A refit beside the base's coordinates with the share that was counted: to windows any share is the same."""
        assert self.found is not None
        return replace(fit, point=np.append(fit.point[:-1], self.found.share))


def loss_hypothesis(engine: WindowResiduals, base: Fit) -> LossHypothesis | None:
    """Lost packets as a hypothesis, if the windows show any; they are then told to the engine.

    Args:
        engine: what it knew of packets is forgotten.
        base: fitted, without the effect.
    """
    name = PacketDrop.size
    model = with_point(base.coordinates, base.point).with_effect(PacketDrop(), {name: 0.0})
    values = {**model.tensors(engine.joints), **base.parameters}
    values[name] = torch.full_like(values[name], 0.5)
    found = lost_packets(engine, model, values)
    engine.packets = None if found is None else found.packets
    if found is None:
        return None
    return LossHypothesis(PacketDrop, None, model, ({name: found.share},), found)


def without_losses(model: RobotModel) -> RobotModel:
    """The model for a run that is compared with a log tick by tick: packets that it draws itself are lost elsewhere."""
    name = PacketDrop.size
    return model.with_values({name: 0.0}) if PacketDrop.name in model.effect_names else model


def lost_packets(engine: WindowResiduals, model: RobotModel, values: dict[str, Tensor]) -> LostPackets | None:
    """Ask every packet of every window whether it was lost; None where too few clearly were.

    Args:
        engine: prepared.
        model: with `packet_drop` on.
        values: its parameters, ``[1, joint]``.
    """
    windows, ticks = len(engine.windows), PREROLL + engine.ticks + 1

    def simulated(packets: np.ndarray) -> np.ndarray:
        engine.packets = packets
        return engine.residuals(model, values, 1, coarse=True)[0].astype(np.float64)

    packets = np.full((windows, ticks), ARRIVED)
    residual = simulated(packets)
    asked = range(PREROLL - 1, ticks - 2)
    telling = lost = 0
    for number in range(PASSES):
        added, gained = np.zeros((2, windows, ticks))
        for tick in asked:
            without = packets.copy()
            without[:, tick] = LOST
            other = simulated(without)
            added[:, tick] = np.square(other - residual).sum(1)
            gained[:, tick] = np.square(residual).sum(1) - np.square(other).sum(1)
        clear = (added > TELLING) & (gained > CLEAR * added)
        if number == 0:
            telling = int((added > TELLING).sum())
            doubtful = int(((added > TELLING) & (gained > DOUBTFUL * added) & ~clear).sum())
            if clear.sum() < max(LEAST, 2 * doubtful):
                return None
        likely = np.where((added > SHOWN) & (gained > LIKELY * added), gained, 0.0)
        rows, best = np.flatnonzero(likely.any(1)), likely.argmax(1)
        if not len(rows):
            break
        lost += int((added[rows, best[rows]] > TELLING).sum())
        packets[rows, best[rows]] = LOST
        residual = simulated(packets)
    return LostPackets(packets, telling, lost) if LEAST <= lost <= MOST * telling else None
