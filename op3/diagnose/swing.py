"""Free swings: parts of bench logs in which torque is off, where gear, bearing and arm show without the motor."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from op3.diagnose.diagnosis import Diagnosis
from op3.diagnose.findings import FORM_ERROR, QUANTILE, setup_finding
from op3.diagnose.fitting import with_point
from op3.diagnose.setups import SetupHypothesis, setup_hypotheses
from op3.diagnose.show import show
from op3.diagnose.split import LogSplit
from op3.diagnose.thresholds import SMALLEST_GAIN
from op3.diagnose.verdict import Finding, Verdict
from op3.rollout import Rollout
from op3.servo import RobotModel
from op3.servo.conditions import split_name

SHORTEST = 1.0
"""Torque must be off for so long that a swing tells something [s]."""

LONGEST = 2.0
"""What follows is left out: after so many periods a small error of one of them is a large one of the angle [s]."""

STILL = 0.005
"""A pendulum that has moved less than this since torque went off has not been released yet [rad]."""

FEWEST = 4
"""Swings that a diagnosis takes: one that shows, one that chooses, the others to be fitted."""

DRIVEN = ("position_servo", "minimum_duty", "latency", "voltage_sag", "packet_drop")
"""Effects that act through the motor, which a servo without torque does not show."""


def swings(logs: Sequence[Rollout]) -> list[Rollout]:
    """What follows the release of a held pendulum, of every log that ends with torque off.

    A swing begins with the last row before the pendulum moves, since a command to switch off acts a little later.
    """
    found = []
    for log in logs:
        if log.metadata.mount != "pendulum" or "command/torque_enable" not in log:
            continue
        on = np.flatnonzero(log.array("command/torque_enable")[:, 0] > 0.5)
        time, position = log.array("time")[:, 0], log.array("joint/position")[:, 0]
        off = 0 if not len(on) else int(on[-1]) + 1
        if off >= len(time) or time[-1] - time[off] < SHORTEST:
            continue
        moved = np.abs(position[off:] - position[off]) > STILL
        begin = off + max(0, int(moved.argmax()) - 1)
        if moved.any() and time[-1] - time[begin] >= SHORTEST:
            found.append(log.between(float(time[begin]), float(time[begin]) + LONGEST))
    return found


def split_swings(parts: Sequence[Rollout], seed: int = 0) -> LogSplit:
    """Swings by what they are used for: a fifth shows, a fifth chooses, the others are fitted; at least `FEWEST`."""
    order = np.random.default_rng([seed, 17]).permutation(len(parts))
    share = max(1, len(parts) // 5)
    show, select, fit = order[:share], order[share : 2 * share], order[2 * share :]
    return LogSplit(*(tuple(parts[i] for i in sorted(which.tolist())) for which in (fit, select, show)))


def diagnose_swings(
    model: RobotModel,
    logs: Sequence[Rollout],
    *,
    seed: int = 0,
    rounds: int = 2,
    without: Sequence[str] = (),
    progress: Callable[[str, float], None] | None = None,
) -> Verdict | None:
    """What a model lacks while the servo is switched off; None where there are too few free swings.

    A zero of the arm that differs between set-ups comes first: it shifts where a pendulum comes to rest, and is weighed
    by refitting everything with and without it. Then the catalogue is asked as for other logs.

    Args:
        model: from which the refit starts.
        logs: all of a bench.
        seed: of split and resampling.
        rounds: effects that may be named besides.
        without: names of effects not to consider.
        progress: called with the stage and the share done.
    """
    parts = swings(logs)
    if len(parts) < FEWEST:
        return None
    split = split_swings(parts, seed)
    options = {"seed": seed, "without": (*DRIVEN, *without), "progress": progress}
    diagnosis = Diagnosis(model, split, **options)
    base = diagnosis.refit_base(model)
    single = with_point(base.coordinates, base.point)
    remounted = None if "encoder_offset" in without else _remounted(diagnosis, single)
    start, zero = (single, None) if remounted is None else remounted
    verdict = Diagnosis(start, split, **options).run(rounds)
    if zero is None:
        return verdict
    others = verdict.effects if verdict.verdict == "named" and not verdict.vetoed else ()
    final = verdict.model if others else verdict.base
    shown = show(single, final, split, seed=seed)
    return replace(
        verdict,
        verdict="named",
        effects=(zero, *others),
        reason=f"the zero explains {zero.gain:.0%} of the residual of the choosing swings; {_beyond(verdict)}",
        model=single if shown["vetoed"] else final,
        base=single,
        separate_by="" if others else verdict.separate_by,
        gap=shown["gap"],
        loss=shown["loss"],
        vetoed=bool(shown["vetoed"]),
        weak=False,
        details={**verdict.details, "shown": shown},
    )


def _beyond(verdict: Verdict) -> str:
    """What a verdict says besides the zero, in a clause."""
    names = " and ".join(effect.name for effect in verdict.effects)
    if verdict.verdict == "named" and verdict.vetoed:
        return f"beyond it, {names} would explain some of what is left, but unseen swings are no better with it"
    if verdict.verdict == "named":
        return f"beyond it, {verdict.reason}"
    if verdict.verdict == "ambiguous":
        return f"beyond it, {verdict.found}, which look alike to these swings"
    return f"beyond it nothing is named: {verdict.reason}"


def _remounted(diagnosis: Diagnosis, single: RobotModel) -> tuple[RobotModel, Finding] | None:
    """A model whose arm has a zero of its own in each set-up, and what it is worth; None if it is not needed.

    Args:
        diagnosis: of the swings.
        single: fitted with one zero.
    """
    engine, best = diagnosis.engine, None
    for hypothesis in setup_hypotheses(single, diagnosis.split.logs):
        start = hypothesis.model
        for name in hypothesis.names:
            start = start.with_values({name: start.value(split_name(name)[0])})
        fit = diagnosis.refit_base(start)
        many = with_point(fit.coordinates, fit.point)
        engine.prepare(single)
        before, after = (np.square(engine.residuals(each)[0].astype(np.float64)).sum(1) for each in (single, many))
        gains = [1 - after[where].sum() / before[where].sum() for where in (engine.is_fit, ~engine.is_fit)]
        if min(gains) < SMALLEST_GAIN or (best is not None and sum(gains) < best[0]):
            continue
        values = np.array([many.estimate(name).value for name in hypothesis.names])
        finding = _zero(hypothesis, values, before - after, float(gains[1]), engine.joints)
        best = (sum(gains), many, finding)
    return None if best is None else best[1:]


def _zero(
    hypothesis: SetupHypothesis, values: np.ndarray, gained: np.ndarray, gain: float, joints: Sequence[str]
) -> Finding:
    """Zeros of the arm by set-up: how far they are apart, and how surely they differ."""
    draws = np.random.default_rng(len(gained)).integers(len(gained), size=(1000, len(gained)))
    confidence = float((gained[draws].sum(1) > 0).mean())
    return setup_finding(joints, hypothesis, values, QUANTILE * FORM_ERROR * float(np.ptp(values)), confidence, gain)
