"""What a plan could tell, before anything is recorded."""

import pytest

from op3.diagnose import Diagnosis, Settings, aliasing, split_logs
from op3.diagnose.aliasing import SIMILAR, VISIBLE
from op3.motions import leg_suite
from op3.replay.planned import planned_suite
from op3.servo import effect_class
from op3.sim import load_model


@pytest.fixture(scope="module")
def told():
    """Of two motions of a leg, simulated by the model itself."""
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith(("multisine", "squats"))][:3]
    split = split_logs(planned_suite(load_model("paper"), runs))
    return aliasing(Diagnosis(load_model("paper"), split, settings=Settings(windows=6)), most=10, planned=True)


def test_what_a_plan_does_not_show_is_told_with_what_would(told):
    """Every hypothesis has a share between nothing and all; what is hidden has an experiment that shows it."""
    visibility = told["visibility"]
    assert all(0.0 <= share <= 1.001 for share in visibility.values())
    assert told["hidden"] == sorted(label for label, share in visibility.items() if share < VISIBLE)
    assert told["hidden"]
    assert set(told["show_by"]) == set(told["hidden"])
    for label, experiment in told["show_by"].items():
        assert experiment == effect_class(label.partition("@")[0]).separating_experiment


def test_pairs_that_look_alike_come_with_what_separates_them(told):
    """The most alike first, none below the limit, and the experiments of both effects."""
    pairs = told["alike"]
    sizes = [abs(pair["cosine"]) for pair in pairs]
    assert 0 < len(pairs) <= 10
    assert sizes == sorted(sizes, reverse=True)
    assert min(sizes) >= SIMILAR - 1e-3
    for pair in pairs:
        for label in pair["effects"]:
            assert effect_class(label.partition("@")[0]).separating_experiment in pair["separate_by"]


def test_what_would_be_named_is_told_by_its_size(told):
    """Every effect has a size from which on it would be named, or none that is plausible."""
    smallest = told["smallest"]
    assert smallest.keys() == told["visibility"].keys()
    sizes = [one["size"] for one in smallest.values() if one is not None]
    assert sizes
    assert min(sizes) > 0
