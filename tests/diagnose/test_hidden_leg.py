"""The whole workflow on logs of a leg whose physics is not the model's."""

import numpy as np
import pytest

from op3.diagnose import Diagnosis, WindowResiduals, split_logs
from op3.robot import leg_suite
from op3.rollout import LogError, Rollout
from op3.sim import load_model
from op3.stand_in import draw_case, record_case


@pytest.fixture(scope="module")
def lossy_leg() -> list[Rollout]:
    """Logs of a leg with a directional gear, which the model to be diagnosed does not know."""
    case = draw_case(1, "single", "clear", "dte", robot="leg")
    return list(record_case(case, leg_suite(1)))


def test_split_uses_no_log_twice(lossy_leg):
    """Fit, select and show share no run; the repeated commands show, in two groups of four."""
    split = split_logs(lossy_leg)
    names = [log.metadata.recording for log in split.logs]
    assert len(set(names)) == len(names) == len(lossy_leg)
    assert [len(group) for group in split.repeats] == [4, 4]
    again = split_logs(lossy_leg)
    assert [log.metadata.recording for log in again.logs] == names


def test_initial_states_are_taken_out(lossy_leg):
    """What a small error of the initial state does to a window is hardly left in its whitened residual."""
    engine = WindowResiduals(split_logs(lossy_leg), fit_windows=6, select_windows=3)
    model = load_model("paper_without_dte")
    engine.prepare(model)
    error = engine.errors(model)
    bare = error / engine.scale
    assert np.square(engine.whiten(error)).sum() < 0.9 * np.square(bare).sum()


def test_free_base_is_refused(lossy_leg):
    """Windows need a held base, and say so."""
    floor = [Rollout(log.data, log.metadata.replace(mount="floor")) for log in lossy_leg[:6]]
    with pytest.raises(LogError, match="stand"):
        WindowResiduals(split_logs(floor))


@pytest.mark.slow
def test_directional_gear_is_named(lossy_leg):
    """The missing effect is `dte` in all joints, its size is right, and the gap on unseen runs shrinks."""
    verdict = Diagnosis(load_model("paper_without_dte"), split_logs(lossy_leg)).run()
    assert verdict.verdict == "named"
    (effect,) = verdict.effects
    assert (effect.name, effect.shared) == ("dte", True)
    assert effect.size == pytest.approx(1 / 1.257, abs=0.03)
    assert verdict.gap["joint/position"]["after"] < 0.9 * verdict.gap["joint/position"]["before"]
    assert "dte" in verdict.model.effect_names


@pytest.mark.slow
def test_nothing_is_named_where_nothing_is_hidden():
    """A leg without a hidden effect, whose gear and friction obey other laws than the model's, gives no name."""
    case = draw_case(2, "null", robot="leg")
    verdict = Diagnosis(load_model(case.base), split_logs(list(record_case(case, leg_suite(2))))).run()
    assert verdict.verdict == "nothing_missing"


@pytest.mark.slow
def test_two_effects_that_look_alike_are_both_found():
    """A late command and a slow filter of velocity: the first round cannot tell them apart, the second finds the other.

    The size of the first is told as it is beside the second.
    """
    case = draw_case(5302, "pair", "clear", robot="leg")
    hidden = {one.name: one.size for one in case.truth.hidden}
    assert set(hidden) == {"latency", "velocity_filter"}
    verdict = Diagnosis(load_model(case.base), split_logs(list(record_case(case, leg_suite(5302))))).run(2)
    assert verdict.verdict == "named"
    found = {effect.name: effect for effect in verdict.effects}
    assert set(found) == set(hidden)
    for name, effect in found.items():
        assert effect.size == pytest.approx(hidden[name], rel=0.3)
        assert effect.interval[0] < hidden[name] < effect.interval[1]
    assert verdict.gap["joint/position"]["after"] < 0.5 * verdict.gap["joint/position"]["before"]


@pytest.mark.slow
def test_a_creeping_spring_is_not_called_a_spring():
    """A cable explains three quarters of a slowly yielding element; the joint stands out afterwards: unknown."""
    case = draw_case(5089, "outsider", "strong", "creep", robot="leg")
    verdict = Diagnosis(load_model(case.base), split_logs(list(record_case(case, leg_suite(5089))))).run()
    assert verdict.verdict == "unknown"
