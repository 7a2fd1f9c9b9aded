"""What an effect does: how much torque it makes, and whether that matters beside a joint's load and the sensors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from op3.diagnose.base import Baseline
from op3.diagnose.judge import Rows
from op3.diagnose.judge_settings import PIECES, Settings
from op3.diagnose.reduction import Reduction
from op3.servo import parameter


@dataclass(frozen=True)
class Relevance:
    """What one effect does, in the joints in which it does most.

    Attributes:
        torque: it makes, root mean square over windows, by joint [N m].
        load: largest share of a joint's torque that this is.
        floor: largest ratio of what it does to a reading (of torque, current or rate) to that reading's noise.
        matters: whether both are enough, and more than the form of a related effect may be off by.
    """

    torque: Mapping[str, float]
    load: float
    floor: float
    matters: bool


def relevance(
    reduction: Reduction, base: Baseline, size: int, rows: Rows, settings: Settings, relatives: Sequence[int] = ()
) -> Relevance:
    """What an effect in a fitted base does.

    Args:
        size: number of its coordinate, whose column says what a unit of it does.
        rows: around the base, whose variance is that of the sensors and of the edge of sticking.
        relatives: numbers of the coordinates of effects in the base that it may look like. No law is quite the
            robot's, and what does less than these may be off by only repairs their form.
    """

    def torques(number: int) -> tuple[np.ndarray, np.ndarray]:
        """What an effect does, ``[joint, window, row]``, and its torque ``[joint]`` [N m]."""
        entry = base.coordinates.entries[number]
        neutral = parameter(entry.parameter).neutral or 0.0 if entry.kind == "value" else 0.0
        does = base.linear.base[number].astype(np.float64) * (base.point[number] - neutral)
        square = np.square(does[..., reduction.kinds == 0]).mean((1, 2))
        return does, np.sqrt(square / PIECES) * reduction.unit

    made, torque = torques(size)
    floors = []
    for kind in (0, 2, 4):  # means of a window: of torque, current, rate
        mine = reduction.kinds == kind
        both = [(did[..., mine], known[..., mine]) for did, known in zip(made, rows.variance, strict=True)]
        read = [(did[seen], known[seen]) for did, known in both if (seen := np.isfinite(known)).any()]
        ratios = [np.sqrt(np.square(did).mean() / np.median(known)) for did, known in read]
        floors.append(float(max(ratios, default=0.0)))
    repaired = settings.form * np.max([torques(number)[1] for number in relatives], axis=0, initial=0.0)
    load = float((torque / np.maximum(reduction.loads, reduction.unit)).max())
    names = reduction.engine.joints
    felt = {names[reduction.judged[k]]: float(torque[k]) for k in np.flatnonzero(torque > 0.1 * torque.max())}
    new = not relatives or bool((torque > repaired).any())
    mechanical = load >= settings.least_load and floors[0] >= settings.least_floor
    return Relevance(felt, load, max(floors), new and (mechanical or max(floors[1:]) >= settings.least_floor))
