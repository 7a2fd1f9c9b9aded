"""Relevance of an effect: its torque relative to a joint's load, and its change of readings relative to noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from op3.diagnose.base import Baseline
from op3.diagnose.coordinates import Coordinate
from op3.diagnose.judge import Rows
from op3.diagnose.judge_settings import PIECES
from op3.diagnose.reduction import Reduction
from op3.diagnose.starts import GEAR
from op3.servo import Effect, parameter


@dataclass(frozen=True)
class Relevance:
    """Influence of one effect in its most affected joints.

    Attributes:
        torque: RMS torque over windows, by joint [N m].
        load: largest ratio of this torque to a joint's RMS torque.
        floor: largest ratio of the change in a window's mean torque, current or rate to the noise of that reading.
        matters: whether both are large enough, and the torque is larger than the error of a related effect's law.
    """

    torque: Mapping[str, float]
    load: float
    floor: float
    matters: bool


def relevance(reduction: Reduction, base: Baseline, index: int, rows: Rows, relatives: Sequence[int] = ()) -> Relevance:
    """Relevance of one effect of a fitted model.

    Args:
        reduction: windows of the fitted runs.
        base: the fitted model.
        index: index of the coordinate that is the effect's size.
        rows: rows of the model, with the variance of the sensors and of windows on the edge of sticking.
        relatives: indices of the coordinates of related effects. No law is exact, so an effect smaller than the error
            of their laws only corrects their form.
    """
    s = reduction.settings

    def change(number: int) -> tuple[np.ndarray, np.ndarray]:
        """Change of the rows caused by an effect, ``[joint, window, row]``, and its RMS torque ``[joint]`` [N m]."""
        entry = base.coordinates.entries[number]
        neutral = parameter(entry.parameter).neutral or 0.0 if entry.kind == "value" else entry.zero
        rows_change = base.linear.jacobian[number].astype(np.float64) * (base.point[number] - neutral)
        square = np.square(rows_change[..., reduction.kinds == 0]).mean((1, 2))
        return rows_change, np.sqrt(square / PIECES) * reduction.torque_unit

    rows_change, torque = change(index)
    floors = []
    for kind in (0, 2, 4):  # window means of torque, current and rate
        pairs = [
            (c[..., reduction.kinds == kind], v[..., reduction.kinds == kind])
            for c, v in zip(rows_change, rows.variance, strict=True)
        ]
        ratios = [
            np.sqrt(np.square(c[valid]).mean() / np.median(v[valid]))
            for c, v in pairs
            if (valid := np.isfinite(v)).any()
        ]
        floors.append(float(max(ratios, default=0.0)))
    law_error = s.form_error * np.max([change(number)[1] for number in relatives], axis=0, initial=0.0)
    load = float((torque / np.maximum(reduction.loads, reduction.torque_unit)).max())
    names = reduction.engine.joints
    largest = np.flatnonzero(torque > 0.1 * torque.max())
    by_joint = {names[reduction.joint_indices[k]]: float(torque[k]) for k in largest}
    distinct = not relatives or bool((torque > law_error).any())
    mechanical = load >= s.min_load and floors[0] >= s.min_floor
    return Relevance(by_joint, load, max(floors), distinct and (mechanical or max(floors[1:]) >= s.min_floor))


def gear_coordinates(effect: type[Effect], base: Baseline) -> list[Coordinate]:
    """The baseline's shared coordinates of gear losses if the effect is also a gear law; otherwise none."""
    if effect.stage not in GEAR:
        return []
    laws = [law for law in base.coordinates.model.effects if law.stage in GEAR and effect.related({law.name})]
    names = {p.name for law in laws for p in law.parameters if p.neutral is not None}
    shared = [entry for entry in base.coordinates.entries if entry.joints is None and entry.kind != "add"]
    return [entry for entry in shared if entry.parameter in names]
