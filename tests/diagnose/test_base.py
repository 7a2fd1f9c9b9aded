"""The base that findings are held against."""

import numpy as np
import pytest

from op3.diagnose import WindowResiduals
from op3.diagnose.coordinates import with_chain
from op3.diagnose.reduction import Reduction
from op3.diagnose.starts import fit_base
from op3.motions import leg_suite
from op3.replay.planned import planned_suite
from op3.sim import load_model


@pytest.mark.slow
@pytest.mark.parametrize(
    "times",
    [
        {"command_latency": 0.0055, "current_time_constant": 0.007},
        {"command_latency": 0.0081, "current_time_constant": 0.0008},
    ],
)
def test_a_base_tells_what_is_late_and_how_velocity_is_estimated(times):
    """Commands, their currents and the velocity's estimate, a difference of angles, each from the others."""
    times = times | {"velocity_time_constant": 0.012, "velocity_filter_shape": 1 / 3}
    runs = [run for run in leg_suite(3, 2.5) if run.motion.name.startswith("multisine")][:2]
    logs = planned_suite(with_chain(load_model("paper")).with_values(times), runs)
    base = fit_base(Reduction(WindowResiduals(logs, windows=36)), load_model("paper"), np.random.default_rng(0))
    found = {entry.parameter: value for entry, value in zip(base.coordinates.entries, base.point, strict=True)}
    for name, value in times.items():
        assert found[name] == pytest.approx(value, abs=0.0005 if value < 0.1 else 0.05)
