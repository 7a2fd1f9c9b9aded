"""Heat and power by hand."""

import numpy as np
import pytest

from op3.compliance.energy import HOUR, measure_energy, temperature_after
from op3.robot import load_robot, load_servo
from op3.rollout import Metadata, Rollout
from op3.sim import load_model
from tests.op3_table import JOINTS


def test_the_continuous_current_ends_at_the_limit():
    """Without a figure of its own, the continuous current ends at the limit of 80 C; 240 s bring 63 % of the way."""
    servo = load_servo("xm430-w350")
    assert servo.thermal_resistance == 12.9
    limits = servo.limits.model_copy(update={"thermal_resistance": None})
    resistance = servo.model_copy(update={"limits": limits}).thermal_resistance
    loss = np.array([5.3 * 0.45999**2])
    assert temperature_after(loss, resistance, 100 * HOUR) == pytest.approx(80.0)
    assert temperature_after(loss, resistance, 240.0) == pytest.approx(25 + 55 * (1 - np.exp(-1)))


def test_cost_of_transport_by_hand():
    """One motor of 6.5 ohm, 1 A and 2 rad/s: 6.5 W of heat and 0.006 * 353.5 * 2 W of work; 3 kg at 0.2 m/s."""
    rows = 1250
    current, velocity = np.zeros((rows, 20)), np.zeros((rows, 20))
    current[:, 3], velocity[:, 3] = 1.0, 2.0
    arrays = {
        "time": np.arange(rows) / 125, ("joint", "position"): np.zeros((rows, 20)),
        ("joint", "current"): current, ("joint", "velocity"): velocity,
        ("command", "position"): np.zeros((rows, 20)),
    }  # fmt: skip
    known = dict(robot="simulated", mount="floor", rate=125.0, travelled_distance=2.0, episode_duration=10.0)
    log = Rollout.from_arrays(arrays, Metadata(joints=JOINTS, **known))
    found = measure_energy([log, log], load_model("paper"), load_robot("op3"), 3.0, True)
    power = 6.5 + 0.006 * 353.5 * 2
    assert found.power[0] == pytest.approx(power)
    assert found.cost_of_transport is not None
    assert found.cost_of_transport[0] == pytest.approx(power / (3.0 * 9.81 * 0.2))
    assert (found.hottest, found.current[3], found.drift) == (JOINTS[3], pytest.approx(1.0), pytest.approx(0.0))
