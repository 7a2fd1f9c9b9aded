"""The backward check of several rounds: is an effect that was named first still needed beside those named later?"""

from collections.abc import Sequence

import numpy as np

from op3.diagnose.coordinates import base_coordinates
from op3.diagnose.fitting import Engine, fit_base, mean_square, with_point
from op3.diagnose.verdict import Finding
from op3.servo import Estimate, RobotModel

NEEDED = 0.025
"""Share of the residual that must come back without an effect for it to be needed: half of what a name takes."""


def with_findings(
    given: RobotModel, findings: Sequence[Finding], like: RobotModel, joints: Sequence[str]
) -> RobotModel:
    """A model with what was found.

    Args:
        given: model without.
        findings: effects and their numbers; amounts to be added where the model has the effect already.
        like: model that holds the effects in the form in which they were found.
        joints: names.
    """
    model = given
    for finding in findings:
        if finding.name not in model.effect_names:
            effect = next(e for e in like.effects if e.name == finding.name)
            neutral = {p.name: p.nominal if p.neutral is None else p.neutral for p in effect.parameters}
            model = model.with_effect(effect, neutral)
        added = finding.name in given.effect_names
        for name, value in finding.parameters.items():
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
        return final.without(finding.name)
    model = final
    for name, value in finding.parameters.items():
        now = model.tensors(joints)[name][0]
        if len(now) == 1:
            model = model.with_values({name: Estimate(float(now[0]) - value)})
            continue
        own = {
            joint: float(old) - (value if finding.shared or joint in finding.joints else 0.0)
            for joint, old in zip(joints, now, strict=True)
        }
        model = model.with_values({name: Estimate(float(now[0]), joints=own)})
    return model


def still_needed(
    engine: Engine, given: RobotModel, findings: Sequence[Finding], final: RobotModel, *, fixed_base: bool
) -> list[float]:
    """Share of the residual that comes back when one finding is left out and everything else refitted, by finding.

    The last finding was weighed beside the others already and is not refitted again: its share is infinite.

    Args:
        engine: gives the residuals.
        given: model that the first round started from.
        findings: of all rounds, in their order.
        final: refitted model with all of them.
        fixed_base: whether the base is held.
    """
    shares = []
    for k in range(len(findings) - 1):
        without = left_out(given, findings[k], final, engine.joints)
        fit = fit_base(engine, base_coordinates(without, engine.joints, fixed_base=fixed_base), rounds=2)
        engine.prepare(final)
        left = [mean_square(engine.residuals(m, {}, 1)[0]) for m in (final, with_point(fit.coordinates, fit.point))]
        shares.append(1.0 - left[0] / left[1])
    return [*shares, np.inf]
