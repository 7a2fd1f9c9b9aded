"""Which hypotheses are refitted, by what the screen credits them with."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from op3.diagnose.coordinates import CHAIN, CHAIN_FAULTS
from op3.diagnose.screen import Screened, foreseen
from op3.diagnose.thresholds import LOOK_ALIKE
from op3.servo import effect_class
from op3.servo.conditions import split_name
from op3.servo.effect import parameter

SHORTLIST = 6
"""Hypotheses that are refitted, by what the screen credits them with."""

SHARED = 2
"""Hypotheses of all joints alike that are refitted besides: a base may have absorbed them."""

SCORED = 4
"""Hypotheses that are refitted besides by their score alone: what an effect would explain is foreseen badly where a
base has given way to it far. A strong false mass of a link had the highest score of all, and a gain below zero; a
centre of mass that was off by 21 mm was credited with 0.005 and explained 0.07."""

FITTED, LEAST_FITTED = 3, 0.01
"""Faults of single joints that are refitted besides by what they explain of the fitted runs alone, along the secant
that explains most of these: what is foreseen of other runs is wrong where a base has given way. Centres of mass that
were off by 9 and 11 mm were foreseen to explain 0.037 and 0.029 of the fitted runs and -0.04 and -0.06 of the others
along their axis, next to nothing along other axes, and explained 0.13 and 0.04 of both when they were refitted. What
explains less than the least there is not worth it."""

PARTNERS = 2
"""Look-alikes of the leader that are refitted besides, if the screen credits them with half of what it has."""

SHAPED, SHAPES = 0.4, 4
"""Share of the best secant's credit with which further ones of an effect of all joints are refitted too, where they
differ in a number that says not how much but where, and how many: between the speeds over which static friction fades
no refit finds its way."""

CONFUSABLE = 5
"""Effects that the catalogue takes for confounders of the leader, in its place, that are refitted besides."""

HOME, HOME_SHARE = 4, 0.4
"""Hypotheses of a joint that are refitted besides, by what they explain of the fitted runs alone, where the joint holds
this share of the loss: a secant is far too short there, and what it explains of other runs is foreseen badly. A strong
spring was credited with 0.23 of the fitted runs and less than nothing of the others, and a refit explained 0.64."""

PROMISE, FAINT, SURE = 0.2, 0.02, 9.0
"""Share of what a leader leaves that a secant has to be foreseen to explain for another round, and the share that will
do at this score. Second effects that a second round named in development pairs had 0.09 and more at scores of 11."""

KNOWN_PROMISE = 0.12
"""The same of what the base has in all joints already: such secants show what the base has not quite reached, up to
0.09 where nothing further was hidden."""

FURTHER_CREDIT, KNOWN_CREDIT = 0.06, 0.12
"""Mean share of the residual that the screen around a model with what was found has to foresee for its refits to be
worth their simulations, and that of what the base has in all joints already; half of it in fitted and choosing runs
each. Behind the one effect that was hidden in eleven legs it foresaw at most 0.03, and 0.08 of the velocity filter;
of second effects that refits then named 0.08 to 0.22."""

EXCHANGED = {"current_lag": "command_latency"}
"""Effects that a parameter of the base stands for where they are not in the model: they are refitted in any case, and
from where a part of it has become theirs. Lags of the current loop of 5 and 7 ms were taken for latency, and explained
1 and 2 % of the residual beside it, 57 and 72 % from behind the ridge."""

SWALLOWED = (*EXCHANGED, "latency", "voltage_sag")
"""What is refitted in any case: these, a latency where the base has none, and a sag of the supply, of which a base
leaves little to see once it has settled on other resistances and torque constants. Of a strong one that was hidden no
screen foresaw anything; refitted, it explained 0.18."""


def shortlist(
    screened: Sequence[Screened], suspects: Sequence[tuple[str, int, float]] = (), home: int | None = None
) -> list[Screened]:
    """What is refitted.

    The best secants of the best hypotheses, look-alikes of the leader, the best in all joints, the highest scores, the
    best of single joints by the fitted runs, faults of single joints that the spread of the base's servos hides, and
    those that its chain of measurement hides with what looks alike; and where one joint holds much of the loss more of
    its own.

    Args:
        screened: every secant of every hypothesis.
        suspects: see `op3.diagnose.coordinates.Coordinates.suspects`.
    """
    best: dict[int, Screened] = {}
    for s in sorted(screened, key=credit, reverse=True):
        best.setdefault(id(s.hypothesis), s)
    ordered = [s for s in best.values() if s.strength > 0 and s.visibility > 0.02]
    picked = ordered[:SHORTLIST]
    partners = [
        s
        for s in ordered[SHORTLIST:]
        if credit(s) > 0.5 * credit(picked[0]) and abs(float(s.direction @ picked[0].direction)) > LOOK_ALIKE
    ]
    picked = picked + partners[:PARTNERS]
    shared = [s for s in ordered if s.hypothesis.joints is None and s not in picked]
    picked = picked + shared[:SHARED]
    picked += _otherwise(screened, picked)
    scored = sorted((s for s in ordered if s not in picked), key=lambda s: -s.statistic)
    picked = picked + scored[:SCORED]
    picked += _fitted(screened, picked)
    picked += [s for s in ordered if s.hypothesis.effect.name in SWALLOWED and s not in picked]
    for name, joint, apart in suspects:
        alike = effect_class(name).alias_class if name in CHAIN_FAULTS.values() else None
        for s in best.values():
            if s.hypothesis.joints != (joint,) or s in picked:
                continue
            if s.hypothesis.effect.name == name:
                picked.append(replace(s, share=float(np.sign(apart)) * max(1.0, abs(s.share))))
            elif s.hypothesis.effect.alias_class == alike:
                picked.append(s)
    return picked + _at_home(screened, picked, home)


def _fitted(screened: Sequence[Screened], picked: Sequence[Screened]) -> list[Screened]:
    """The best faults of single joints by the fitted runs, along secants that are not picked yet, see `FITTED`."""
    best: dict[int, Screened] = {}
    for s in sorted(screened, key=lambda s: -s.fit_gain):
        if s.hypothesis.joints is not None and s.strength > 0 and s.visibility > 0.02:
            best.setdefault(id(s.hypothesis), s)
    return [s for s in best.values() if s not in picked and s.fit_gain > LEAST_FITTED][:FITTED]


def _otherwise(screened: Sequence[Screened], picked: Sequence[Screened]) -> list[Screened]:
    """Further secants of what is picked in all joints, see `SHAPED`."""
    chosen = {id(s.hypothesis): s for s in picked if s.hypothesis.joints is None and _shape(s)}
    further = [
        s
        for s in screened
        if id(s.hypothesis) in chosen
        and s.strength > 0
        and s.visibility > 0.02
        and _shape(s) != _shape(chosen[id(s.hypothesis)])
        and credit(s) >= max(FAINT, SHAPED * credit(chosen[id(s.hypothesis)]))
    ]
    return sorted(further, key=credit, reverse=True)[:SHAPES]


def _shape(s: Screened) -> dict[str, float]:
    """What a secant says that is no amount."""
    secant = s.hypothesis.secants[s.secant]
    return {name: value for name, value in secant.items() if parameter(split_name(name)[0]).neutral is None}


def stands_alone(squares: np.ndarray) -> int | None:
    """The joint that holds `HOME_SHARE` of the loss, and twice what one of so many joints would; None if none does.

    Args:
        squares: of the residuals, ``[window, joint]``.
    """
    by_joint = squares.sum(0)
    worst = int(by_joint.argmax())
    return worst if by_joint[worst] > max(HOME_SHARE, 2.0 / len(by_joint)) * by_joint.sum() else None


def _at_home(screened: Sequence[Screened], picked: Sequence[Screened], home: int | None) -> list[Screened]:
    """The best of a joint by the fitted runs alone, of effects that are not picked there yet."""
    if home is None:
        return []
    best: dict[str, Screened] = {}
    for s in sorted(screened, key=lambda s: -s.fit_gain):
        if s.hypothesis.joints == (home,) and s.strength > 0 and s.visibility > 0.02:
            best.setdefault(s.hypothesis.effect.name, s)
    known = {s.hypothesis.effect.name for s in picked if s.hypothesis.joints == (home,)}
    return [s for name, s in best.items() if name not in known][:HOME]


def worth_a_round(screened: Sequence[Screened], residual: np.ndarray, blocks: np.ndarray) -> bool:
    """Whether the screen foresees that something explains a part of what a leader leaves.

    Args:
        screened: every secant of every hypothesis, around the base.
        residual: of the fitted windows, that the leader leaves, ``[window, residual]``.
        blocks: of each window, ``[window]``.
    """
    for s, (share, score) in zip(screened, foreseen(screened, residual, blocks), strict=True):
        if s.visibility < 0.02:
            continue
        known = _known(s)
        if share > (KNOWN_PROMISE if known else PROMISE) or (not known and share > FAINT and score > SURE):
            return True
    return False


def promising(screened: Sequence[Screened]) -> bool:
    """Whether a screen around a model with what was found shows that something else is missing."""
    for s in screened:
        least = KNOWN_CREDIT if _known(s) else FURTHER_CREDIT
        if s.visibility >= 0.02 and credit(s) >= least and min(s.gain, s.fit_gain) >= 0.5 * least:
            return True
    return False


def hides_another(effect: str) -> bool:
    """Whether an effect may stand for one of `EXCHANGED`, of which no screen around it foresees anything."""
    return any(p.name in EXCHANGED.values() for p in effect_class(effect).parameters)


def _known(s: Screened) -> bool:
    """Whether it is a secant of what the base has in all joints already."""
    return s.hypothesis.joints is None and bool(set(s.hypothesis.secants[s.secant]) & set(CHAIN))


def confusable(leader: Screened, screened: Sequence[Screened], picked: Sequence[Screened]) -> list[Screened]:
    """What the catalogue says is taken for the leader of a shortlist, in the same place, and is not on the list yet.

    A screen tells such effects apart badly: to leave one out because it had a little less credit decides between them.
    So what it foresees of the fitted runs alone says which come first and along which secant: of an axis along which a
    centre of mass was off, and of the phase of an encoder's error, it foresaw less than nothing of the other runs.

    Args:
        leader: of the refits.
        screened: every secant of every hypothesis.
        picked: the shortlist.
    """
    effect, joints = leader.hypothesis.effect, leader.hypothesis.joints
    known = {id(s.hypothesis) for s in picked}
    best: dict[int, Screened] = {}
    for s in sorted(screened, key=lambda s: -s.fit_gain):
        other = s.hypothesis.effect
        alike = other.name in effect.confounders or effect.name in other.confounders
        alike |= other.alias_class == effect.alias_class
        if alike and s.hypothesis.joints == joints and id(s.hypothesis) not in known and s.strength > 0:
            best.setdefault(id(s.hypothesis), s)
    return list(best.values())[:CONFUSABLE]


def credit(s: Screened) -> float:
    """Mean share of the residual that a hypothesis is foreseen to explain, of fitted and choosing runs."""
    return 0.5 * (s.gain + s.fit_gain)
