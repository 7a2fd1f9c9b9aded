"""What sensors make of the true motion."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from op3.robot import quaternion
from op3.robot.kinematics import roll_pitch_yaw
from op3.robot.register_units import ACCELERATION_UNIT, GYRO_UNIT
from op3.stand_in import HiddenWorld
from op3.stand_in.sensors import Imu

QUIET = HiddenWorld(gyro_noise=0.0, gyro_bias=0.0, accelerometer_noise=0.0)
LEVEL = np.array([1.0, 0, 0, 0])
GRAVITY = np.array([0, 0, 9.81])


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_orientation_convention(roll, pitch, yaw):
    """Roll, pitch and yaw are those of R = Rz(yaw) Ry(pitch) Rx(roll)."""
    assert roll_pitch_yaw(quaternion(roll, pitch, yaw)) == pytest.approx([roll, pitch, yaw], abs=1e-7)


def test_gyro_bandwidth():
    """A sine at the corner frequency comes through with about 1 / sqrt(2) of its amplitude."""
    imu = Imu(QUIET)
    imu.reset(LEVEL, GRAVITY)
    rng = np.random.default_rng(0)
    seen = []
    for step in range(4000):
        rate = np.array([np.sin(2 * np.pi * 45 * step * 0.001), 0, 0])
        imu.step(LEVEL, rate, GRAVITY, rng)
        seen.append(imu.rates_and_force[0])
    assert np.max(np.abs(seen[1000:])) == pytest.approx(2**-0.5, abs=0.05)


def test_registers_follow_at_200_hz():
    """The registers change every 5 ms and stay in between."""
    imu = Imu(QUIET)
    imu.reset(LEVEL, GRAVITY)
    rng = np.random.default_rng(0)
    seen = []
    for step in range(100):
        imu.step(quaternion(0.01 * step, 0.0), np.zeros(3), GRAVITY, rng)
        seen.append(imu.orientation[0])
    changes = np.flatnonzero(np.diff(seen)) + 1
    assert (np.diff(changes) == 5).all()
    assert len(changes) >= 18


def test_grids_and_clipping():
    """Rates and forces are whole counts; the accelerometer clips at 2 g."""
    imu = Imu(HiddenWorld())
    rng = np.random.default_rng(0)
    imu.reset(LEVEL, np.array([0.1, 30.0, -30.0]))
    for _ in range(20):
        imu.step(LEVEL, np.array([0.1, 0.2, 0.3]), np.array([0.1, 30.0, -30.0]), rng)
    gyro, force = imu.rates_and_force[:3] / GYRO_UNIT, imu.rates_and_force[3:] / ACCELERATION_UNIT
    assert gyro == pytest.approx(np.round(gyro), abs=1e-6)
    assert force == pytest.approx(np.round(force), abs=1e-6)
    assert force[1:].tolist() == [32767, -32768]
