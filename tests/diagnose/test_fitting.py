"""Fits of a base on logs that a known model gives."""

import numpy as np
import pytest

from op3.diagnose import Diagnosis, WindowResiduals, planned_suite, split_logs
from op3.diagnose.coordinates import other_forms
from op3.diagnose.fitting import LOSSLESS, fit_base
from op3.robot import leg_suite
from op3.servo import RobotModel
from op3.sim import load_model


def forms(model: RobotModel) -> dict[str, str]:
    return {e.name: getattr(e, "form", getattr(e, "fade", "")) for e in model.effects if e.name in ("dte", "stribeck")}


@pytest.fixture(scope="module")
def truth() -> RobotModel:
    """Neither law is in the form that `paper` has, and both matter."""
    paper = load_model("paper")
    (other,) = (m for m in other_forms(paper) if all(forms(m)[name] != form for name, form in forms(paper).items()))
    return other.with_values({"backward_efficiency": 0.7, "static_friction_excess": 0.2, "stribeck_velocity": 0.15})


@pytest.fixture(scope="module")
def diagnosis(truth) -> Diagnosis:
    """Windows of runs that the truth itself gives."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:8]
    split = split_logs(planned_suite(truth, runs))
    engine = WindowResiduals(split, fit_windows=30, select_windows=12)
    return Diagnosis(load_model("paper"), split, engine=engine)


def test_the_forms_of_the_laws_are_found(diagnosis, truth):
    """A base that starts with both laws in other forms ends with those that the logs were made with."""
    fit = diagnosis.refit_base(diagnosis.given)
    assert forms(fit.coordinates.model) == forms(truth)
    at = [entry.name for entry in fit.coordinates.entries].index("backward_efficiency")
    assert fit.point[at] == pytest.approx(0.7, abs=0.1)


def test_losses_that_vanished_in_one_form_are_looked_for_in_the_other(diagnosis, truth):
    """From a point without losses, where all forms are the same, a later refit still asks for the other form's."""
    given = diagnosis.linearised().coordinates
    at = [entry.name for entry in given.entries].index("backward_efficiency")
    start = np.where(np.arange(len(given)) == at, 1.0, given.start)
    assert forms(given.model) != forms(truth)
    fit = fit_base(diagnosis.engine, given, rounds=1, start=start, alternatives=other_forms(given.model))
    assert fit.point[at] < LOSSLESS
    assert forms(fit.coordinates.model)["dte"] == forms(truth)["dte"]
