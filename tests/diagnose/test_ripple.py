"""Ripples of a joint, read off a residual torque whose ripple is known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.diagnose import Diagnosis, WindowResiduals, planned_suite, split_logs
from op3.diagnose.hypotheses import hypotheses
from op3.diagnose.locate import PIECES, Response
from op3.diagnose.motion import PREROLL
from op3.diagnose.ripple import LINES, STEP, ripples, with_ripples
from op3.robot import LEG_JOINTS, leg_suite
from op3.sim import load_model

KNEE = LEG_JOINTS.index("r_knee")


def sweep(windows: int = 80, ticks: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Angle and velocity of windows that go to and fro over 1.5 rad, ``[window, tick]``."""
    phase = np.arange(windows * ticks).reshape(windows, ticks) * 0.008 * 1.7
    return 0.75 * np.sin(phase), 0.75 * 1.7 * np.cos(phase)


def by_piece(values: np.ndarray) -> np.ndarray:
    return np.stack([part.mean(-1) for part in np.array_split(values, PIECES, axis=-1)], -1)


@settings(max_examples=40, deadline=None)
@given(st.floats(8, 50), st.floats(-3, 3), st.floats(-0.1, 0.1), st.integers(0, 100))
def test_periods_and_phase_are_read_off(periods, phase, friction, seed):
    """The highest line is the ripple's, its phase right by an eighth of a turn, beside friction and noise."""
    q, v = sweep()
    torque = by_piece(0.02 * np.sin(periods * q + phase) + friction * np.sign(v) + 0.05 * q + 0.1)
    torque += 0.003 * np.random.default_rng(seed).normal(size=torque.shape)
    found = ripples(q, v, torque)
    assert 1 <= len(found) <= LINES
    best = found[0]
    assert best["cogging_periods"] == pytest.approx(periods, abs=2 * STEP)
    apart = np.angle(np.exp(1j * (best["cogging_phase"] - phase)))
    assert abs(apart) < np.pi / 4


def test_a_joint_at_rest_has_no_lines():
    """What does not move tells nothing about its angle."""
    q, v = sweep()
    assert ripples(0.0 * q, 0.0 * v, by_piece(q)) == ()


def test_the_screen_asks_for_the_lines_of_each_joint():
    """In a leg whose knee lacks a ripple of 29 periods, its hypothesis has that line first; other effects stay."""
    model = load_model("paper")
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:8]
    split = split_logs(planned_suite(model, runs))
    engine = WindowResiduals(split, fit_windows=40, select_windows=16)
    base = Diagnosis(model, split, engine=engine).linearised()
    rows = PREROLL + engine.ticks + 1
    q = engine.motion.position.reshape(len(engine.windows), rows, -1)[:, PREROLL : PREROLL + engine.ticks, KNEE]
    lacking = -Response(engine, base.parameters)((0.03 * np.sin(29.0 * q + 0.5))[..., None], KNEE)[..., 0]
    noise = 0.1 * np.random.default_rng(4).normal(size=lacking.shape)
    base = replace(base, residual=(lacking + noise).astype(np.float32))
    before = hypotheses(model, engine.joints, fixed_base=True)
    after = with_ripples(before, engine, base)
    assert [(h.effect, h.joints) for h in after] == [(h.effect, h.joints) for h in before]
    changed = [new for old, new in zip(before, after, strict=True) if old.secants != new.secants]
    assert {h.effect.name for h in changed} == {"cogging"}
    (knee,) = (h for h in changed if h.joints == (KNEE,))
    assert knee.secants[0]["cogging_periods"] == pytest.approx(29.0, abs=1.0)
    assert knee.secants[0]["cogging_phase"] == pytest.approx(0.5, abs=0.8)
