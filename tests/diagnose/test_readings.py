"""What logs themselves say of the sensors and of the supply, against a leg whose numbers are known."""

from dataclasses import replace

import numpy as np
import pytest

from op3.diagnose.motion import smooth, smooth_all, velocity_sensing
from op3.diagnose.supply import open_voltages
from op3.robot import leg_suite
from op3.robot.units import POSITION_UNIT, VELOCITY_UNIT, VOLTAGE_UNIT
from op3.rollout import Rollout
from op3.stand_in import LegTruth, World, record_leg


@pytest.fixture(scope="module")
def world() -> World:
    return World.random(4).replace(velocity_lag=0.004, bus_resistance=0.3, bus_voltage=11.6)


@pytest.fixture(scope="module")
def logs(world) -> list[Rollout]:
    kinds = ("multisine_high", "steps", "squats")
    return record_leg(LegTruth(world), [run for run in leg_suite(3, 4.0) if run.motion.name.startswith(kinds)], 3)


def test_velocity_readings_tell_how_late_they_are(logs):
    """A filter of 4 ms, once per millisecond, is 3.5 ms late; readings are up to a millisecond old besides."""
    sensing = velocity_sensing([smooth(log) for log in logs])
    np.testing.assert_allclose(sensing.lag, 0.0038, atol=0.0004)
    assert (sensing.noise < 0.02).all()


def test_late_readings_sharpen_velocities(logs):
    """Of joints that swing, read 6 ms late: half the error of velocities that are smoothed with the usual lag."""
    time = np.arange(600) * 0.008
    amplitude, rate = np.linspace(0.1, 0.2, 6), 2 * np.pi * np.linspace(1.0, 2.0, 6)

    def speed(t: np.ndarray) -> np.ndarray:
        return amplitude * rate * np.cos(rate * t[:, None])

    position = amplitude * np.sin(rate * time[:, None])
    arrays = {
        "time": time[:, None],
        ("joint", "position"): np.round(position / POSITION_UNIT) * POSITION_UNIT,
        ("joint", "velocity"): np.round(speed(time - 0.006) / VELOCITY_UNIT) * VELOCITY_UNIT,
        ("command", "position"): position,
    }
    log = Rollout.from_arrays(arrays, logs[0].metadata)
    usual, known = (np.abs(grid.velocity - speed(time))[10:-10].mean() for grid in (smooth(log), smooth_all([log])[0]))
    assert known < 0.5 * usual


def test_the_supply_is_told_from_its_readings(logs):
    """Rounded to a tenth of a volt and falling by several tenths: resistance to a twentieth, voltage to 30 mV."""
    resistance, voltages = open_voltages([smooth(log) for log in logs])
    assert resistance == pytest.approx(0.3, rel=0.05)
    assert max(np.abs(voltage - 11.6).max() for voltage in voltages) < 0.03


@pytest.mark.parametrize("case", ["steady", "another load"])
def test_voltages_that_are_not_those_of_the_currents_stay_as_they_are(logs, case):
    """A voltage that never changes, or changes by what is not in the logs, is replayed as measured."""
    grids = []
    for log in logs:
        grid = smooth(log)
        voltage = np.full_like(grid.inputs["bus_voltage"], 11.1)
        if case == "another load":
            voltage -= np.where(np.sin(40.0 * grid.time) > 0, 0.6, 0.0)[:, None]
        inputs = {**grid.inputs, "bus_voltage": np.round(voltage / VOLTAGE_UNIT) * VOLTAGE_UNIT}
        grids.append(replace(grid, inputs=inputs))
    resistance, voltages = open_voltages(grids)
    assert resistance == 0.0
    for grid, voltage in zip(grids, voltages, strict=True):
        np.testing.assert_array_equal(voltage, grid.inputs["bus_voltage"])
