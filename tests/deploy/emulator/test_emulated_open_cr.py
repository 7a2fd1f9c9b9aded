"""The OpenCR: it gives the servos power, and tells attitude, rates and voltage in its own axes."""

import numpy as np
from dynamixel_sdk import COMM_RX_TIMEOUT, GroupSyncRead
from wheels import Bench

from op3.deploy.emulator import Faults, FrozenImu

POWER = 24


def imu(bench):
    data, result, error = bench.packets.readTxRx(bench.port, 200, 32, 18)
    assert (result, error) == (0, 0)
    return np.frombuffer(bytes(data), "<i2")


def test_servos_are_silent_until_they_have_power():
    """No servo answers before register 24 is written, nor for the moment it boots; then all twenty do."""
    bench = Bench(power=False)
    assert bench.packets.ping(bench.port, 200) == (29696, 0, 0)
    assert bench.packets.ping(bench.port, 1)[1] == COMM_RX_TIMEOUT
    bench.write(200, POWER, 1, 1)
    assert bench.packets.ping(bench.port, 1)[1] == COMM_RX_TIMEOUT
    bench.clock.sleep(0.1)
    assert sorted(bench.packets.broadcastPing(bench.port)[0]) == [*range(1, 21), 200]


def test_readings_are_in_the_boards_axes():
    """The robot's x and y are minus the board's, z is the same; units are those of the registers."""
    bench = Bench()
    bench.physics.rates[:] = np.deg2rad([100.0, 200.0, 300.0])
    bench.physics.force[:] = 9.80665 * np.array([0.5, -0.25, 1.0])
    bench.physics.tilt[:] = np.deg2rad([10.0, -20.0, 30.0])
    bench.clock.sleep(0.01)
    expected = [-1640, -3280, 4920, -8192, 4096, 16384, -100, 200, 300]
    assert imu(bench).tolist() == expected


def test_a_frozen_imu_repeats_itself():
    """Between start and end of the fault its registers stand still, whatever moves."""
    bench = Bench(faults=Faults(scheduled=(FrozenImu(0.5, 1.0),)))
    readings = []
    for time in (0.4, 0.6, 0.9, 1.1):
        bench.clock.sleep_until(time)
        bench.physics.rates[0] = time
        readings.append(imu(bench).tolist())
    assert readings[0] == readings[1] == readings[2] != readings[3]


def test_the_board_knows_no_fast_reads():
    """A fast sync read that names the board stays without an answer."""
    bench = Bench()
    reader = GroupSyncRead(bench.port, bench.packets, 32, 18)
    reader.addParam(200)
    assert reader.fastSyncRead() == COMM_RX_TIMEOUT
