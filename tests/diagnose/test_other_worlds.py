"""What a diagnosis says does not hang on how the stand-in is made."""

import pytest
import yaml

from experiments.hidden_bench.score import read_verdict, score_case
from op3.diagnose import Diagnosis, Settings, split_logs
from op3.sim import load_model
from op3.stand_in import draw_case, record_case
from op3.stand_in.world import read_ranges

WORLDS = {
    "quick": {
        "velocity_lag": [0.001, 0.003],
        "current_lag": [0.0002, 0.0004],
        "joint_spread": [0.01, 0.03],
        "timestep": [0.0001, 0.00012],
        "fade_form": ["exponential"],
        "loss_form": ["power"],
        "bristle_form": ["prandtl"],
        "velocity_form": ["lag"],
    },
    "slow": {
        "velocity_lag": [0.015, 0.02],
        "current_lag": [0.001, 0.0015],
        "joint_spread": [0.08, 0.12],
        "timestep": [0.0002, 0.00025],
        "fade_form": ["lorentz"],
        "loss_form": ["near_rest"],
        "bristle_form": ["lugre"],
        "velocity_form": ["two_lags", "difference"],
    },
}
"""Ranges of filters, integrators, laws and the spread of the makes, each as far as it may go either way."""


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize(("kind", "effect"), [("single", "dte"), ("null", None)])
def test_verdicts_are_alike_in_other_worlds(kind, effect, world, tmp_path):
    """A strong loss of all gears is named, a sound leg is not, however the truth is simulated and measured."""
    ranges = tmp_path / "ranges.yaml"
    ranges.write_text(yaml.safe_dump(WORLDS[world]))
    case = draw_case(11, kind, "strong", effect, robot="leg", ranges=read_ranges(ranges))
    split = split_logs(list(record_case(case)))
    verdict = Diagnosis(load_model(case.base), split, settings=Settings(windows=40)).run()
    path = tmp_path / "verdict.yaml"
    path.write_text(yaml.safe_dump(verdict.plain()))
    score = score_case(case.answer(), read_verdict(path, case.joints))
    assert score["exact"] if kind == "single" else not score["named"]
    assert not score["confident_wrong"]
