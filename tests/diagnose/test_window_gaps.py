"""The gap in windows, in three stages."""

import pytest

from op3.diagnose import LogSplit
from op3.diagnose.base import gauss_newton
from op3.diagnose.coordinates import base_coordinates, with_chain
from op3.diagnose.reduction import Reduction
from op3.diagnose.window_gaps import WindowGaps, plain_gaps, window_gaps
from op3.motions import leg_suite
from op3.replay.planned import planned_suite
from op3.replay.windows import WindowResiduals
from op3.sim import load_model
from tests.op3_table import LEG_JOINTS


@pytest.fixture(scope="module")
def gaps() -> WindowGaps:
    """Of logs of a leg with more friction than the given model, repeated to the number; the truth is returned."""
    truth = with_chain(load_model("paper")).with_values({"coulomb_friction": 0.2})
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith("multisine")][:1]
    logs = tuple(planned_suite(truth, runs)) * 2
    reduction = Reduction(WindowResiduals(logs, windows=8))
    coordinates = base_coordinates(truth, LEG_JOINTS, reduction.moving)
    base = gauss_newton(reduction, coordinates, coordinates.start, steps=0)
    between = truth.with_values({"coulomb_friction": 0.17})
    found = window_gaps((load_model("paper"), between, truth), base, LogSplit((), logs, ((0, 1),)), logs)
    assert found is not None
    return found


def test_a_better_model_leaves_less_at_every_stage(gaps):
    """In angle, current and torque, over all joints; what the logs were made with leaves a tenth, at most."""
    assert set(gaps.whole) == {"position", "current", "torque"}
    for name in ("position", "torque"):
        one = gaps.whole[name]
        assert one.returned < one.baseline < one.given
        assert one.returned < 0.2 * one.given
    assert gaps.worse == []


def test_errors_grow_with_the_horizon_and_repeats_are_their_floor(gaps):
    """Runs of 2.5 s have horizons up to a second; equal runs differ by nothing."""
    assert list(gaps.horizons) == [0.25, 0.5, 1.0]
    for one in gaps.horizons.values():
        assert one.returned < one.given
        assert one.floor == pytest.approx(0.0, abs=1e-9)


def test_a_verdict_holds_errors_and_their_shares(gaps):
    """In SI units and percent, by joint, over all joints and by horizon."""
    content = plain_gaps(gaps)
    knee = content["joints"]["r_knee"]["position"]
    assert knee["percent"]["given"] == pytest.approx(100 * knee["given"] / knee["signal"])
    assert set(content["horizons"]) == {"250 ms", "500 ms", "1000 ms"}
