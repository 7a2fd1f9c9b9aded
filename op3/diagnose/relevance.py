"""What an effect does: how much torque it makes, and whether that matters beside a joint's load and the sensors."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from op3.diagnose.base import Base
from op3.diagnose.judge import Rows
from op3.diagnose.reduction import PIECES, Reduction
from op3.diagnose.settings import Settings


@dataclass(frozen=True)
class Relevance:
    """What one effect does, in the joints in which it does most.

    Attributes:
        torque: it makes, root mean square over windows, by joint [N m].
        load: largest share of a joint's torque that this is.
        floor: largest ratio of what it does to a reading (of torque, current or rate) to that reading's noise.
        matters: whether both are enough.
    """

    torque: Mapping[str, float]
    load: float
    floor: float
    matters: bool


def relevance(reduction: Reduction, base: Base, size: int, rows: Rows, settings: Settings) -> Relevance:
    """What an effect in a fitted base does.

    Args:
        size: number of its coordinate, whose column says what a unit of it does.
        rows: around the base, whose variance is that of the sensors and of the edge of sticking.
    """
    made = base.linear.base[size].astype(np.float64) * base.point[size]  # [joint, window, row]
    floors = []
    for kind in (0, 2, 4):  # means of a window: of torque, current, rate
        mine = reduction.kinds == kind
        both = [(did[..., mine], known[..., mine]) for did, known in zip(made, rows.variance, strict=True)]
        read = [(did[seen], known[seen]) for did, known in both if (seen := np.isfinite(known)).any()]
        ratios = [np.sqrt(np.square(did).mean() / np.median(known)) for did, known in read]
        floors.append(float(max(ratios, default=0.0)))
    torque = np.sqrt(np.square(made[..., reduction.kinds == 0]).mean((1, 2))) / np.sqrt(PIECES) * reduction.unit
    load = float((torque / np.maximum(reduction.loads, reduction.unit)).max())
    names = reduction.engine.joints
    felt = {names[reduction.judged[k]]: float(torque[k]) for k in np.flatnonzero(torque > 0.1 * torque.max())}
    mechanical = load >= settings.least_load and floors[0] >= settings.least_floor
    return Relevance(felt, load, max(floors), mechanical or max(floors[1:]) >= settings.least_floor)
