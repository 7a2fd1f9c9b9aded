"""What several rounds have found, taken together.

An effect that was named first is asked for again beside those named later: whether it is still needed, and whether one
of those it could not be told from does better now. Two effects that each look like half of the other, such as a late
command and a slow filter, are both found in this way, one after the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from op3.diagnose.backward import left_out, with_findings
from op3.diagnose.coordinates import base_coordinates
from op3.diagnose.decide import Contender, weigh
from op3.diagnose.fitting import Engine, fit_base, with_point
from op3.diagnose.verdict import Finding
from op3.servo import RobotModel

NEEDED = 0.025
"""Share of the residual that must come back without an effect for it to be needed: half of what a name takes."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A finding of one round.

    Attributes:
        finding: what was found.
        contender: its numbers.
        model: refitted with it.
    """

    finding: Finding
    contender: Contender
    model: RobotModel

    @property
    def place(self) -> tuple[Any, ...]:
        """Which effect, and where."""
        return self.finding.name, tuple(self.finding.joints), self.finding.by


@dataclass(frozen=True, eq=False)
class Settled:
    """What is left of several rounds.

    Attributes:
        effects: in the order of the rounds; behind each what the logs do not tell from it.
        model: with the effects, refitted.
        superfluous: names of effects that later ones have made so.
    """

    effects: tuple[Finding, ...]
    model: RobotModel
    superfluous: tuple[str, ...]


def settle(
    engine: Engine,
    given: RobotModel,
    rounds: Sequence[Sequence[Candidate]],
    rng: np.random.Generator,
    *,
    fixed_base: bool,
) -> Settled:
    """Weigh what was found in earlier rounds again, beside all that was found later.

    Args:
        engine: gives the residuals.
        given: model that the first round started from.
        rounds: the candidates of each round, the one that the next round went on from first.
        rng: of the resampling.
        fixed_base: whether the base is held.
    """
    rounds = merged(given, rounds)
    final = rounds[-1][0].model
    places = {candidates[0].place for candidates in rounds}
    leaders: list[Candidate | None] = [candidates[0] for candidates in rounds]
    rivals = [[one for one in candidates[1:] if one.place not in places] for candidates in rounds]

    def refitted(model: RobotModel) -> RobotModel:
        coordinates = base_coordinates(model, engine.joints, fixed_base=fixed_base)
        fit = fit_base(engine, coordinates, rounds=2, start=coordinates.start)
        return with_point(fit.coordinates, fit.point)

    for k, leader in enumerate(leaders[:-1]):
        assert leader is not None
        without = left_out(given, leader.finding, final, engine.joints)
        models = [with_findings(without, [one.finding], one.model, engine.joints) for one in rivals[k]]
        control, *others = [refitted(model) for model in (without, *models)]
        if others:  # what they are compared with gets the same effort
            final = refitted(final)
        losses = _losses(engine, final, (final, control, *others))
        standing, own = [leader, *rivals[k]], losses[[0, *range(2, len(losses))]]
        weighed = [replace(one.contender, losses=loss) for one, loss in zip(standing, own, strict=True)]
        best, alike = weigh(weighed, losses[1], rng)
        needed = bool(1.0 - own[best].sum() / losses[1].sum() >= NEEDED)
        leaders[k], rivals[k] = (standing[best], [standing[i] for i in alike]) if needed else (None, [])
        final = (final, *others)[best] if needed else control
    effects: list[Finding] = []
    for leader, open_ in zip(leaders, rivals, strict=True):
        if leader is not None:
            effects.append(as_in(given, final, leader.finding, engine.joints))
            effects += [replace(one.finding, instead_of=leader.finding.name) for one in open_]
    gone = [candidates[0].finding.name for candidates, leader in zip(rounds, leaders, strict=True) if leader is None]
    return Settled(tuple(effects), final, tuple(gone))


def _losses(engine: Engine, reference: RobotModel, models: Sequence[RobotModel]) -> np.ndarray:
    """Squares summed by block of a second, ``[model, block]``, all whitened as under the reference."""
    engine.prepare(reference)
    index = np.unique(engine.blocks, return_inverse=True)[1]
    squares = [np.square(engine.residuals(model, {}, 1)[0].astype(np.float64)).sum(1) for model in models]
    return np.stack([np.bincount(index, square) for square in squares])


def merged(given: RobotModel, rounds: Sequence[Sequence[Candidate]]) -> list[list[Candidate]]:
    """Each leader once in its place: a later round tells the whole of it, and adds to what a model had before."""
    result: dict[tuple[Any, ...], list[Candidate]] = {}
    for leader, *others in rounds:
        earlier = result.pop(leader.place, None)
        if earlier is not None:
            before, effect = earlier[0].finding, leader.finding
            if effect.name in given.effect_names:
                more = {name: value + before.parameters.get(name, 0.0) for name, value in effect.parameters.items()}
                effect = replace(effect, parameters=more)
            surest = max(effect.confidence, before.confidence)
            effect = replace(effect, gain=max(effect.gain, before.gain), confidence=surest)
            leader = replace(leader, finding=effect)
        result[leader.place] = [leader, *others]
    return list(result.values())


def as_in(given: RobotModel, final: RobotModel, finding: Finding, joints: Sequence[str]) -> Finding:
    """A finding with its numbers in a model in which others were found besides; its interval moves with it.

    What is told as more of an effect that the given model has stays as it was found.
    """
    if finding.by or finding.name in given.effect_names:
        return finding
    column = 0 if finding.shared else list(joints).index(finding.joints[0])
    known, values = final.parameters(), dict(finding.parameters)
    for name in values:
        row = final.tensors(joints)[name][0]
        values[name] = float(row[column if len(row) > 1 else 0])
    if finding.parameter not in values:
        return replace(finding, parameters=values)
    size, limits = values[finding.parameter], known[finding.parameter]
    moved = size - finding.size
    low, high = (min(max(end + moved, limits.least), limits.most) for end in finding.interval)
    return replace(finding, parameters=values, size=size, interval=(low, high))
