"""What several rounds have found, taken together.

An effect that was named first is asked for again beside those named later: whether it is still needed, and whether one
of those it could not be told from does better now. Two effects that each look like half of the other, such as a late
command and a slow filter, are both found in this way, one after the other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from op3.diagnose.backward import left_out, with_findings
from op3.diagnose.coordinates import FAULTS, Coordinates
from op3.diagnose.decide import BEATEN, weigh
from op3.diagnose.evidence import Contender
from op3.diagnose.fitting import Engine, fit_base, with_point
from op3.diagnose.thresholds import LATER_GAIN, OWN_GAIN, SMALLEST_GAIN, SMALLEST_SIZE, UNDECIDED
from op3.diagnose.verdict import Finding
from op3.servo import RobotModel
from op3.servo.effect import parameter

NEEDED = (0.5 * SMALLEST_GAIN, 0.5 * LATER_GAIN)
"""Share of the residual that must come back without the first effect, and without a further one, for it to be needed:
half of what its name took. Half of `OWN_GAIN` will do in the joint of an effect of one joint."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A finding of one round.

    Attributes:
        finding: what was found.
        contender: its numbers.
        model: refitted with it.
        sure: whether windows alone leave no doubt of it.
    """

    finding: Finding
    contender: Contender
    model: RobotModel
    sure: bool = False

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
    coordinates: Callable[[RobotModel, Sequence[Finding]], Coordinates],
) -> Settled:
    """Weigh what was found in earlier rounds again, beside all that was found later.

    Args:
        engine: gives the residuals.
        given: model that the first round started from.
        rounds: the candidates of each round, the one that the next round went on from first.
        rng: of the resampling.
        coordinates: what a base refits of a model: of what sits in one joint, that joint's own value only if it is
            among these findings.
    """
    rounds = merged(given, rounds)
    final = rounds[-1][0].model
    leaders: list[Candidate | None] = [candidates[0] for candidates in rounds]
    rivals = [list(candidates[1:]) for candidates in rounds]

    def refitted(model: RobotModel, *found: Candidate | None) -> RobotModel:
        moved = coordinates(model, [one.finding for one in found if one is not None])
        fit = fit_base(engine, moved, rounds=2, start=moved.start)
        return with_point(fit.coordinates, fit.point)

    for k, leader in enumerate(leaders[:-1]):
        assert leader is not None
        if leader.finding.by:
            continue  # zeros of set-ups are beside everything else, and stay
        named = {one.place for one in leaders if one is not None}
        rivals[k] = [one for one in rivals[k] if one.place not in named and not one.finding.by]
        without = left_out(given, leader.finding, final, engine.joints)
        exchanged = [with_findings(given, [one.finding], one.model, engine.joints, without) for one in rivals[k]]
        others = [one for one in leaders if one is not leader]
        models = [refitted(final, *leaders), refitted(without, *others)]
        models += [refitted(model, rival, *others) for model, rival in zip(exchanged, rivals[k], strict=True)]
        squares = _squares(engine, models[0], models)
        losses = squares.sum(2)
        standing, own = [leader, *rivals[k]], losses[[0, *range(2, len(losses))]]
        beside = [models[0], *models[2:]]
        own[[_vain(one, model, models[1], engine.joints) for one, model in zip(standing, beside, strict=True)]] = BEATEN
        weighed = [replace(one.contender, losses=loss) for one, loss in zip(standing, own, strict=True)]
        best, alike = weigh(weighed, losses[1], rng)
        needed = bool(1.0 - own[best].sum() / losses[1].sum() >= NEEDED[min(k, 1)])
        needed |= _at_home(squares[0 if best == 0 else 1 + best], squares[1], standing[best].contender.joints)
        leaders[k], rivals[k] = (standing[best], [standing[i] for i in alike]) if needed else (None, [])
        final = models[0 if best == 0 else 1 + best] if needed else models[1]
    named = {one.place for one in leaders if one is not None}
    # what has taken the place of one that it could not be told from is no surer than it was beside that
    dropped = [candidates for candidates, leader in zip(rounds, leaders, strict=True) if leader is None]
    unsure = {one.place for candidates in dropped for one in candidates[1:]}
    effects: list[Finding] = []
    for leader, others in zip(leaders, rivals, strict=True):
        if leader is not None:
            told = as_in(given, final, leader.finding, engine.joints)
            sure = min(told.confidence, UNDECIDED) if leader.place in unsure else told.confidence
            effects.append(replace(told, instead_of="", confidence=sure))
            left = [one.finding for one in others if one.place not in named]
            effects += [replace(one, instead_of=leader.finding.name) for one in left]
    gone = [candidates[0].finding.name for candidates, leader in zip(rounds, leaders, strict=True) if leader is None]
    return Settled(tuple(effects), final, tuple(gone))


def _vain(one: Candidate, model: RobotModel, without: RobotModel, joints: Sequence[str]) -> bool:
    """Whether an effect has next to no size where it was refitted: then it is the base that explains beside it.

    Args:
        one: which.
        model: refitted with it.
        without: refitted without it. That has it as far as it is the base's, such as a filter that every robot has, or
            a friction that other joints have too.
        joints: names.
    """
    column, amounts = 0 if one.finding.shared else list(joints).index(one.finding.joints[0]), 0
    for name in one.finding.parameters:
        known = parameter(name)
        if known.neutral is None or name not in model.parameters():
            continue  # says where, not how much; or is no number of the models, as packets that were counted
        amounts += 1
        values = [m.tensors(joints)[name][0] if name in m.parameters() else None for m in (model, without)]
        now, before = (known.neutral if v is None else float(v[column if len(v) > 1 else 0]) for v in values)
        least = one.contender.smallest if name == one.finding.parameter else 0.1 * (known.high - known.low)
        if abs(now - before) >= SMALLEST_SIZE * least:
            return False
    return amounts > 0


def _squares(engine: Engine, reference: RobotModel, models: Sequence[RobotModel]) -> np.ndarray:
    """Squares summed by block of a second, ``[model, block, joint]``, all whitened as under the reference."""
    engine.prepare(reference)
    index = np.unique(engine.blocks, return_inverse=True)[1]
    result = np.zeros((len(models), index.max() + 1, len(engine.joints)))
    for model, squares in zip(models, result, strict=True):
        np.add.at(squares, index, engine.squares_by_joint(engine.residuals(model, {}, 1)[0]))
    return result


def _at_home(own: np.ndarray, without: np.ndarray, joints: Sequence[int] | None) -> bool:
    """Whether enough comes back in the joint of an effect of one joint; squares are ``[block, joint]``."""
    if joints is None or len(joints) != 1:
        return False
    (joint,) = joints
    return bool(1.0 - own[:, joint].sum() / without[:, joint].sum() >= 0.5 * OWN_GAIN)


def merged(given: RobotModel, rounds: Sequence[Sequence[Candidate]]) -> list[list[Candidate]]:
    """Each leader once in its place: a later round tells the whole of it, and adds to what a model had before."""
    result: dict[tuple[Any, ...], list[Candidate]] = {}
    for leader, *others in rounds:
        earlier = result.pop(leader.place, None)
        if earlier is not None:
            others += [one for one in earlier[1:] if one.place not in {other.place for other in others}]
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

    What is told as more of an effect that the given model has, or against other joints, stays as it was found.
    """
    against = finding.name in FAULTS.values() and not finding.shared
    if finding.by or against or finding.name in given.effect_names:
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
