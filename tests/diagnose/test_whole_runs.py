"""Parameters refitted on whole runs of a bench: an arm that is held and let go."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from op3.diagnose import whole_runs
from op3.diagnose.base import Baseline
from op3.diagnose.coordinates import BENCH, CHAIN, Coordinates, base_coordinates, with_chain, with_setups
from op3.diagnose.linearisation import Linearisation
from op3.replay import Replay
from op3.rollout import Metadata, Rollout
from op3.sim import load_model


@pytest.fixture(scope="module")
def known() -> Coordinates:
    """The base of a bench."""
    model = with_chain(with_setups(load_model("rhoban_m1"), [0.1]))
    return base_coordinates(model, ("servo",), priors={**CHAIN, **BENCH})


@pytest.fixture(scope="module")
def logs(known) -> list[Rollout]:
    """What the start of the base makes of an arm that is held for 0.2 s."""
    time = np.arange(0.0, 1.2, 0.01)
    arrays = {
        "time": time,
        "command/position": np.full((len(time), 1), 1.2),
        "command/torque_enable": (time < 0.2).astype(float)[:, None],
        "command/firmware_gain": np.full((len(time), 1), 16.0),
        "joint/position": np.full((len(time), 1), 1.1),
    }
    metadata = Metadata(("servo",), "rig", "pendulum", 100.0, mass=0.4, length=0.1, battery=6.0)
    replay = Replay([Rollout.from_arrays(arrays, metadata)], settle=0.0, bench_timestep=0.002)
    (said,) = replay.run(known.model, known.values(known.start[None]))
    arrays["joint/position"] = said.channels["joint", "position"][0].numpy()
    return [Rollout.from_arrays(arrays, metadata)]


def base_at(known: Coordinates, **factors: float) -> Baseline:
    """A base as windows would have left it, some numbers multiplied, each known to a twentieth."""
    point = known.start * [factors.get(entry.parameter, 1.0) for entry in known.entries]
    fit: Any = SimpleNamespace(precision=np.diag((20.0 / np.maximum(known.start, 1e-3)) ** 2))
    return Baseline(Linearisation(known, point, (), (), np.zeros(0), np.zeros(0)), fit)


def test_whole_runs_find_what_a_window_hardly_shows(known, logs):
    """A zero that is 12 mrad off comes back to two; how late a velocity is read moves no angle, and stays."""
    base = base_at(known, encoder_offset=1.1, velocity_time_constant=2.0)
    point = whole_runs.on_whole_runs(base, logs)
    assert point is not None
    found = dict(zip([entry.parameter for entry in known.entries], point, strict=True))
    assert found["encoder_offset"] == pytest.approx(0.12, abs=0.002)
    assert found["velocity_time_constant"] == pytest.approx(0.012, rel=0.02)


def test_runs_of_a_robot_are_not_simulated(known, logs):
    """Then the numbers stay as windows say them."""
    held = [
        Rollout.from_arrays({key: log.array(key) for key in log.channels}, log.metadata.replace(mount="stand"))
        for log in logs
    ]
    assert whole_runs.on_whole_runs(base_at(known), held) is None
