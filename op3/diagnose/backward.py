"""Models with findings, and without one of them."""

from collections.abc import Sequence

import numpy as np

from op3.diagnose.verdict import Finding
from op3.servo import Estimate, RobotModel
from op3.servo.effect import parameter


def with_findings(
    given: RobotModel,
    findings: Sequence[Finding],
    like: RobotModel,
    joints: Sequence[str],
    start: RobotModel | None = None,
) -> RobotModel:
    """A model with what was found.

    Args:
        given: model that a diagnosis started from; numbers of effects that it has are amounts to be added.
        findings: effects and their numbers; none that differs by a field of the metadata.
        like: model that holds the effects in the form in which they were found.
        joints: names.
        start: model that gets them; the given one by default.
    """
    model = given if start is None else start
    for finding in findings:
        if finding.name not in model.effect_names:
            effect = next(e for e in like.effects if e.name == finding.name)
            neutral = {p.name: p.nominal if p.neutral is None else p.neutral for p in effect.parameters}
            model = model.with_effect(effect, neutral)
        for name, value in finding.parameters.items():
            added = finding.name in given.effect_names and parameter(name).neutral is not None
            now = model.tensors(joints)[name][0]
            if finding.shared or len(now) == 1:
                model = model.with_values({name: Estimate(float(now[0]) + value if added else value)})
                continue
            own = {
                joint: (float(old) + value if added else value) if joint in finding.joints else float(old)
                for joint, old in zip(joints, now, strict=True)
            }
            model = model.with_values({name: Estimate(float(now[0]), joints=own)})
    return model


def left_out(given: RobotModel, finding: Finding, final: RobotModel, joints: Sequence[str]) -> RobotModel:
    """The final model without one finding; everything else keeps its fitted value, from which a refit starts.

    Args:
        given: model before any finding.
        finding: that is taken out.
        final: with all findings.
        joints: names.
    """
    if finding.name not in given.effect_names:
        size = parameter(final.effect(finding.name).size)
        own = dict(zip(joints, final.tensors(joints)[size.name][0].tolist(), strict=False)) if size.per_joint else {}
        if finding.shared or all(own[joint] == size.neutral for joint in own if joint not in finding.joints):
            return final.without(finding.name)
        neutral = 0.0 if size.neutral is None else size.neutral
        return final.with_values(
            {size.name: Estimate(neutral, joints={**own, **dict.fromkeys(finding.joints, neutral)})}
        )
    model = final
    for name, value in finding.parameters.items():
        known, now = parameter(name), model.tensors(joints)[name][0].numpy()
        if known.neutral is None:
            continue
        less = np.clip(now - value, known.least, known.most)
        if len(now) == 1:
            model = model.with_values({name: Estimate(float(less[0]))})
            continue
        here = np.array([finding.shared or joint in finding.joints for joint in joints])
        if (~here).sum() > 1:  # a fault: without it the joint is as the others
            less[:] = np.median(now[~here])
        own = dict(zip(joints, np.where(here, less, now).tolist(), strict=True))
        model = model.with_values({name: Estimate(float(now[0]), joints=own)})
    return model
