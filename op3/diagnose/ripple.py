"""Ripples of a joint: which periods a turn its residual torque has, so that the screen asks for those.

A ripple of 28 periods a turn is out of step with one of 24 after a quarter of a turn, and explains nothing of it: a
screen with a few fixed periods is blind to the others. Residual torque is cheap to look through for all of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from op3.diagnose.fitting import Fit
from op3.diagnose.hypotheses import Hypothesis
from op3.diagnose.locate import PIECES, REST, residual_torque
from op3.diagnose.windows import WindowResiduals
from op3.servo.effects import Cogging

LINES = 3
"""Highest lines of a joint's spectrum that are screened."""

STEP = 0.5
"""Between periods a turn that are tried; over a range of 2 rad they are 1 rad out of step."""

FEWEST = 12
"""Pieces in which a joint has to move."""


def with_ripples(candidates: Sequence[Hypothesis], engine: WindowResiduals, base: Fit) -> list[Hypothesis]:
    """Hypotheses, those of a ripple with the periods and phases that the residual torque of their joint has.

    Args:
        candidates: hypotheses.
        engine: whose windows; the fitted ones are looked at.
        base: with its residual.
    """
    if not any(h.effect is Cogging for h in candidates):
        return list(candidates)
    fitted = engine.is_fit

    def ticks(values: np.ndarray) -> np.ndarray:
        return engine.by_window(values)[fitted]

    torque = residual_torque(engine, base.parameters, base.residual)[fitted]  # [window, piece, joint]
    position, velocity = ticks(engine.motion.position), ticks(engine.motion.velocity)
    result = []
    for h in candidates:
        where = range(len(engine.joints)) if h.joints is None else h.joints
        if h.effect is Cogging and len(where) == 1:
            (j,) = where
            lines = ripples(position[..., j], velocity[..., j], torque[..., j])
            h = replace(h, secants=lines or h.secants)
        result.append(h)
    return result


def ripples(position: np.ndarray, velocity: np.ndarray, torque: np.ndarray) -> tuple[Mapping[str, float], ...]:
    """Secants of `Cogging` at the highest lines of a torque's spectrum over the angle, the highest first.

    What is level, grows with the angle, or goes with the direction of motion is taken out of the torque before.

    Args:
        position: angle of a joint [rad], ``[window, tick]``.
        velocity: its velocity [rad/s], ``[window, tick]``.
        torque: mean torque that lacks in pieces of the windows [N m], ``[window, piece]``.

    Returns:
        Nothing where the joint hardly moves.
    """

    def pieces(values: np.ndarray) -> np.ndarray:
        return np.stack([part.mean(-1) for part in np.array_split(values, PIECES, axis=-1)], -1)

    moves = pieces((np.abs(velocity) > REST).astype(float)) > 0.5
    if moves.sum() < FEWEST:
        return ()
    known = {p.name: p for p in Cogging.parameters}
    periods = np.arange(known["cogging_periods"].low, known["cogging_periods"].high + STEP / 2, STEP)
    plain = np.stack([pieces(x)[moves] for x in (np.ones_like(position), position, np.sign(velocity))], -1)
    waves = np.stack([pieces(wave(n * position))[moves] for n in periods for wave in (np.sin, np.cos)], -1)
    left = np.column_stack([torque[moves], waves])
    left = left - plain @ np.linalg.lstsq(plain, left, rcond=None)[0]
    found = []
    for k, n in enumerate(periods):
        amounts, rest, *_ = np.linalg.lstsq(left[:, 1 + 2 * k : 3 + 2 * k], left[:, 0], rcond=None)
        explained = float(left[:, 0] @ left[:, 0] - rest.sum()) if rest.size else 0.0
        found.append((explained, float(n), float(np.arctan2(amounts[1], amounts[0]))))
    height = np.array([-np.inf, *(one[0] for one in found), -np.inf])
    peaks = [one for k, one in enumerate(found, 1) if height[k] >= height[k - 1] and height[k] > height[k + 1]]
    amplitude = Cogging.secants[0]["cogging_amplitude"]
    return tuple(
        {"cogging_amplitude": amplitude, "cogging_phase": phase, "cogging_periods": n}
        for _, n, phase in sorted(peaks, reverse=True)[:LINES]
    )
