"""What logs themselves say of the sensors and of the supply, against a leg whose numbers are known."""

from dataclasses import replace

import numpy as np
import pytest

from op3.motions import leg_suite
from op3.replay.smoothing import VELOCITY_LAG, VELOCITY_NOISE, SmoothLog, smooth, smooth_all, velocity_sensing
from op3.replay.supply import open_voltages
from op3.robot.register_units import POSITION_UNIT, VELOCITY_UNIT, VOLTAGE_UNIT
from op3.rollout import Rollout
from op3.stand_in import HiddenWorld, draw_case, record_case


@pytest.fixture(scope="module")
def world() -> HiddenWorld:
    return HiddenWorld.random(4).replace(velocity_lag=0.004, bus_resistance=0.3, bus_voltage=11.6)


@pytest.fixture(scope="module")
def logs(world) -> list[Rollout]:
    kinds = ("multisine_high", "steps", "squats")
    case = replace(draw_case(3, "null", robot="leg"), world=world)
    return list(record_case(case, [run for run in leg_suite(3, 4.0) if run.motion.name.startswith(kinds)]))


def test_velocity_readings_tell_how_late_they_are(logs):
    """A filter of 4 ms, once per millisecond, is 3.5 ms late; readings are up to a millisecond old besides."""
    sensing = velocity_sensing([smooth(log) for log in logs])
    np.testing.assert_allclose(sensing.lag, 0.0038, atol=0.0004)
    assert (sensing.noise < 0.03).all()


def with_velocities(logs: list[Rollout], change) -> list[SmoothLog]:
    """The logs smoothed, with other velocity readings."""
    grids = [smooth(log) for log in logs]
    return [
        replace(g, readings={**g.readings, ("joint", "velocity"): change(g.readings["joint", "velocity"])})
        for g in grids
    ]


def test_noisy_velocity_readings_are_trusted_less(logs):
    """Noise of 0.1 rad/s is seen, and as much as the usual noise is assumed at least."""
    rng = np.random.default_rng(0)
    noisy = velocity_sensing(with_velocities(logs, lambda v: v + 0.1 * rng.standard_normal(v.shape)))
    assert (noisy.noise == VELOCITY_NOISE).all()


def test_a_joint_that_hardly_accelerates_tells_no_lag(logs):
    """Readings of a joint that creeps say nothing of how late they are: the usual lag."""
    slow = velocity_sensing(with_velocities(logs, lambda v: np.round(0.001 * v / VELOCITY_UNIT) * VELOCITY_UNIT))
    np.testing.assert_array_equal(slow.lag, VELOCITY_LAG)


def test_late_readings_sharpen_velocities(logs):
    """Of joints that swing, read 6 ms late: half the error of velocities that are smoothed with the usual lag."""
    time = np.arange(600) * 0.008
    amplitude, rate = np.linspace(0.2, 0.3, 6), 2 * np.pi * np.linspace(1.5, 2.5, 6)

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
    """Rounded to 0.1 V and falling by several tenths: resistance to a tenth, voltage to a quarter of a volt.

    The battery gives the motors' power, of which the sum of currents is a measure.
    """
    resistance, voltages = open_voltages([smooth(log) for log in logs])
    assert resistance == pytest.approx(0.3, rel=0.1)
    assert max(np.abs(voltage - 11.6).max() for voltage in voltages) < 0.25


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
