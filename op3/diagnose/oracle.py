"""What could have been reached: the gap under a model to which the hidden effects were told."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from op3.diagnose.diagnosis import Diagnosis
from op3.diagnose.findings import with_finding
from op3.diagnose.fitting import with_point
from op3.diagnose.hypotheses import Hypothesis, hypotheses
from op3.diagnose.packets import loss_hypothesis, without_losses
from op3.diagnose.ripple import with_ripples
from op3.diagnose.screen import screen
from op3.diagnose.show import show
from op3.diagnose.windows import WindowResiduals
from op3.servo import RobotModel
from op3.servo.effects import PacketDrop

SECANTS = 2
"""Secants of a told effect from which its refit starts."""


def oracle(diagnosis: Diagnosis, told: Sequence[tuple[str, Sequence[str]]]) -> dict[str, Any]:
    """The gap on the runs that show under the base and under a model that knows which effects are there, and where.

    Their sizes are fitted, together with the base, to the same runs that a diagnosis fits. What no effect of the
    catalogue is, and where nothing is hidden, the oracle is the base.

    Args:
        diagnosis: of the logs; not run, or run before.
        told: names of effects, and their joints; none or all of the logs' for all joints alike.

    Returns:
        ``effects``, those that the catalogue has; ``gap`` as of a verdict, ``after`` under the oracle.
    """
    joints = diagnosis.engine.joints
    base = diagnosis.refit_base(diagnosis.given)
    before = model = with_point(base.coordinates, base.point)
    known = []
    for name, where in told:
        columns = None if not where or set(where) >= set(joints) else tuple(sorted(joints.index(j) for j in where))
        better = _with(diagnosis, model if known else diagnosis.given, name, columns)
        if better is not None:
            model = better
            known.append({"name": name, "joints": list(where)})
    shown = show(without_losses(before), without_losses(model), diagnosis.split)
    return {"effects": known, "gap": shown["gap"], "loss": shown["loss"]}


def _with(diagnosis: Diagnosis, model: RobotModel, name: str, columns: tuple[int, ...] | None) -> RobotModel | None:
    """The model with one effect switched on in some joints and everything refitted; None if the catalogue lacks it."""
    base = diagnosis.refit_base(model)
    fitted = with_point(base.coordinates, base.point)
    engine = diagnosis.engine
    mine: list[Hypothesis]
    if name == PacketDrop.name and isinstance(engine, WindowResiduals):
        lost = loss_hypothesis(engine, base)
        mine = [] if lost is None else [lost]
    else:
        every = hypotheses(fitted, engine.joints, fixed_base=diagnosis.fixed_base)
        mine = [h for h in every if h.effect.name == name and h.joints == columns]
        if isinstance(engine, WindowResiduals):
            mine = with_ripples(mine, engine, base)
    if not mine:
        return None
    refitted = diagnosis.refit_of(base, screen(engine, base, mine)[:SECANTS])
    best = min(refitted, key=lambda r: float(np.sum(r.contender.losses)))
    return with_finding(best, diagnosis.finding_of(best, base, 1.0), engine.joints)
