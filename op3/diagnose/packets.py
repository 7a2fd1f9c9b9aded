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
"""The same for a packet that is taken as lost where others were, and for those among which losses are counted: a window
in which rows of packets got lost counts less, so that few of them reach `TELLING`."""

LIKELY, CLEAR = 0.5, 0.7
"""Share of that by which the squares have to fall for a packet to be taken as lost, and to be clearly lost. Of one that
arrived they rise by all of it, of one that was lost they fall by all of it."""

DOUBTFUL = 0.3
"""Squares that fall by this share, and less than by `CLEAR`, are no losses, but something else that is missing."""

LEAST = 3
"""So many packets must clearly be lost."""

MOST = 0.15
"""Where a larger share seems lost, commands are late."""

PASSES = 5
"""Losses that are looked for in a window at most."""

TOGETHER = 9
"""Packets of a window that are asked in one simulation."""

SUPPOSED = 1 / 30
"""Share of packets that is supposed to be lost where it is asked what logs would tell of losses."""

ARRIVED, LOST = 1.0, -1.0
"""What `op3.servo.Signals.packet` says."""


@dataclass(frozen=True, eq=False)
class LostPackets:
    """What windows tell of packets.

    Attributes:
        packets: `ARRIVED` or `LOST`, of the ticks of every window and those before it, ``[window, tick]``.
        telling: number of packets that could be seen to be lost.
        lost: how many of them were.
        together: how many follow each other without one that arrived, on average: what the chance that the next one
            is lost too says of rows of a geometric length.
    """

    packets: np.ndarray
    telling: int
    lost: int
    together: float = 1.0

    @property
    def share(self) -> float:
        """Of the packets that were lost."""
        return self.lost / self.telling

    def interval(self, level: float = 0.9) -> tuple[float, float]:
        """Of the probability of a loss (Clopper and Pearson, Biometrika 1934).

        Losses that follow each other are not independent: of those that come in rows of a geometric length, the
        variance of a count is larger by twice the mean length less one, so that they count for so many fewer.
        """
        alike = max(1.0, 2.0 * self.together - 1.0)
        tail, lost, arrived = 0.5 * (1 - level), self.lost / alike, (self.telling - self.lost) / alike
        low = special.betaincinv(lost, arrived + 1, tail) if lost else 0.0
        high = special.betaincinv(lost + 1, arrived, 1 - tail) if arrived else 1.0
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
        engine: gives the residuals.
        base: fitted, without the effect.
    """
    model, found = with_losses(base), lost_packets(engine, base)
    if found is None:
        return None
    engine.packets = found.packets
    return LossHypothesis(PacketDrop, None, model, ({PacketDrop.size: found.share},), found)


def supposed_losses(engine: WindowResiduals, base: Fit) -> Hypothesis:
    """Lost packets as a hypothesis on logs that may hold none: every thirtieth is supposed to be lost."""
    engine.packets = engine.packets.copy()
    engine.packets[:, PREROLL :: round(1 / SUPPOSED)] = LOST
    return Hypothesis(PacketDrop, None, with_losses(base), ({PacketDrop.size: SUPPOSED},))


def with_losses(base: Fit) -> RobotModel:
    """The base's model with the effect on, none lost."""
    model = with_point(base.coordinates, base.point)
    return model if PacketDrop.name in model.effect_names else model.with_effect(PacketDrop(), {PacketDrop.size: 0.0})


def without_losses(model: RobotModel) -> RobotModel:
    """The model for a run that is compared with a log tick by tick: packets that it draws itself are lost elsewhere."""
    return model.with_values({PacketDrop.size: 0.0}) if PacketDrop.name in model.effect_names else model


def as_lossy(model: RobotModel, other: RobotModel) -> RobotModel:
    """A model with the lost packets of another one."""
    name = PacketDrop.size
    if PacketDrop.name not in other.effect_names:
        return model
    if PacketDrop.name in model.effect_names:
        return model.with_values({name: other.estimate(name)})
    return model.with_effect(PacketDrop(), {name: other.estimate(name)})


def lost_packets(engine: WindowResiduals, base: Fit) -> LostPackets | None:
    """Ask every packet of every window whether it was lost; None where too few clearly were.

    Losses are looked for one by one in each window, the clearest first, as each changes what another would do. In the
    end those are counted whose loss would show if all others had arrived: which these are does not hang on what was
    lost, while behind a lost packet another one shows at half the speed of the command. What windows share counts once.

    Args:
        engine: prepared; what it knows of packets does not matter, and is left as it is.
        base: fitted, without losses.
    """
    model, windows, ticks = with_losses(base), len(engine.windows), PREROLL + engine.ticks + 1
    values = {**model.tensors(engine.joints), **base.parameters}
    values[PacketDrop.size] = torch.full_like(values[PacketDrop.size], 0.5)

    def asked(packets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What it changes in the squares if a packet is taken otherwise, and by how much they fall, [window, tick]."""
        residual = engine.residuals_with(packets[None], model, values)[0].astype(np.float64)
        changed, gained = np.zeros((2, windows, ticks))
        every = np.arange(PREROLL - 1, ticks - 2)
        for asking in np.array_split(every, -(-len(every) // TOGETHER)):
            otherwise = np.tile(packets, (len(asking), 1, 1))
            otherwise[np.arange(len(asking)), :, asking] *= -1
            for tick, other in zip(asking, engine.residuals_with(otherwise, model, values), strict=True):
                changed[:, tick] = np.square(other - residual).sum(1)
                gained[:, tick] = np.square(residual).sum(1) - np.square(other).sum(1)
        return changed, gained

    packets = np.full((windows, ticks), ARRIVED)
    changed, gained = asked(packets)
    telling, shown = changed > TELLING, changed > SHOWN
    clear, half = telling & (gained > CLEAR * changed), telling & (gained > DOUBTFUL * changed)
    if clear.sum() < max(LEAST, 2 * (half & ~clear).sum()):
        return None
    for number in range(PASSES):
        if number:
            changed, gained = asked(packets)
        likely = np.where((changed > SHOWN) & (gained > LIKELY * changed), gained, 0.0)
        rows, best = np.flatnonzero(likely.any(1)), likely.argmax(1)
        if not len(rows):
            break
        packets[rows, best[rows]] *= -1
    return _counted(engine, packets, shown)


def _counted(engine: WindowResiduals, packets: np.ndarray, telling: Mask) -> LostPackets | None:
    """How many packets tell, and how many of these were lost; those of several windows once."""
    verdicts: dict[tuple[int, int], bool] = {}
    for row, tick in zip(*np.nonzero(telling), strict=True):
        log, first = engine.windows[row]
        verdicts[log, first - PREROLL + int(tick)] = bool(packets[row, tick] == LOST)
    lost = {place for place, was in verdicts.items() if was}
    if not LEAST <= len(lost) <= MOST * len(verdicts):
        return None
    # only where the next packet tells too: what does not would end every row
    followed = [(log, tick + 1) in lost for log, tick in lost if (log, tick + 1) in verdicts]
    again = sum(followed) / (len(followed) + 1)
    return LostPackets(packets, len(verdicts), len(lost), 1.0 / (1.0 - again))
