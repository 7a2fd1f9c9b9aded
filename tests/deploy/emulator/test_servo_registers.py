"""The rules of a servo's registers, one by one, through dynamixel-sdk."""

import pytest
from dynamixel_sdk import COMM_RX_TIMEOUT, GroupBulkRead, GroupSyncRead
from wheels import Bench

from op3.deploy.emulator import Faults, HardwareFault, Overheat
from op3.deploy.protocol import Error
from op3.deploy.registers import CURRENT_MODE, HardwareError

ID = 14


@pytest.fixture
def bench():
    return Bench()


@pytest.mark.parametrize(
    ("address", "size", "value", "error"),
    [
        pytest.param(11, 1, 2, Error.DATA_RANGE, id="no such mode"),
        pytest.param(84, 2, 20_000, Error.DATA_RANGE, id="gain too high"),
        pytest.param(168, 2, 7, Error.DATA_RANGE, id="indirect address into the EEPROM"),
        pytest.param(132, 4, 0, Error.ACCESS, id="present position"),
        pytest.param(0, 2, 7, Error.ACCESS, id="model number"),
        pytest.param(66, 1, 1, Error.ACCESS, id="between registers"),
        pytest.param(102, 1, 5, Error.DATA_LENGTH, id="half a register"),
        pytest.param(38, 2, 500, 0, id="EEPROM with torque off"),
    ],
)
def test_what_may_be_written(bench, address, size, value, error):
    """What is refused is told by its error; the EEPROM is locked while torque is on."""
    assert bench.write(ID, address, size, value) == (0, error)
    bench.energise(ID)
    assert bench.write(ID, 38, 2, 600) == (0, Error.ACCESS)


def test_a_new_mode_sets_the_goal_current_to_the_limit(bench):
    """The energise hazard: torque on right after a change of mode drives the joint with the current limit."""
    bench.write(ID, 102, 2, 0)
    assert bench.write(ID, 11, 1, CURRENT_MODE) == (0, 0)
    assert bench.read(ID, 102, 2) == 1193
    bench.write(ID, 64, 1, 1)
    bench.clock.sleep(0.05)
    index = bench.robot.servos["l_knee"].index
    assert bench.physics.current[index] == pytest.approx(1193 * 0.00269)
    assert bench.physics.velocity[index] > 5


def test_a_goal_beyond_the_current_limit_is_refused(bench):
    """The goal current may not exceed the limit, and what is refused is not stored."""
    bench.write(ID, 38, 2, 400)
    bench.energise(ID, 300)
    assert bench.write(ID, 102, 2, 401) == (0, Error.DATA_LIMIT)
    assert bench.write(ID, 102, 2, -401) == (0, Error.DATA_LIMIT)
    assert bench.read(ID, 102, 2) == 300
    assert bench.write(ID, 102, 2, -400) == (0, 0)


def test_indirect_data_reads_and_writes_where_it_points(bench):
    """Scattered registers become a block, and a goal written there acts."""
    for number, target in enumerate((70, 146, 144, 145, 102, 103)):
        assert bench.write(ID, 168 + 2 * number, 2, target) == (0, 0)
    bench.energise(ID)
    assert bench.write(ID, 228, 2, -50) == (0, 0)
    assert bench.read(ID, 102, 2, signed=True) == -50
    data, _, _ = bench.packets.readTxRx(bench.port, ID, 224, 6)
    assert data == [0, 30, 120, 0, 0xCE, 0xFF]


def test_a_reboot_forgets_ram_and_keeps_eeprom(bench):
    """Indirect addresses and goals are gone, the current limit stays; the servo is deaf while it boots."""
    bench.write(ID, 38, 2, 500)
    bench.write(ID, 168, 2, 146)
    bench.write(ID, 102, 2, 5)
    assert bench.packets.reboot(bench.port, ID) == (0, 0)
    assert bench.packets.ping(bench.port, ID)[1] == COMM_RX_TIMEOUT
    bench.clock.sleep(0.1)
    assert bench.read(ID, 168, 2) == 224
    assert bench.read(ID, 38, 2) == 500
    assert bench.read(ID, 102, 2) == 500  # the limit, as after a change of mode
    assert bench.read(ID, 64, 1) == 0


def test_status_return_level_silences_answers(bench):
    """Level 1 answers reads and no writes, level 0 pings alone."""
    assert bench.write(ID, 68, 1, 1) == (0, 0)
    assert bench.write(ID, 65, 1, 1)[0] == COMM_RX_TIMEOUT
    assert bench.read(ID, 65, 1) == 1
    bench.write(ID, 68, 1, 0)
    assert bench.packets.readTxRx(bench.port, ID, 65, 1)[1] == COMM_RX_TIMEOUT
    assert bench.packets.ping(bench.port, ID)[1] == 0


def test_a_new_id_and_speed_act_at_once(bench):
    """After its id changes a servo answers under the new one; after its baud rate changes, at the new one."""
    bench.write(ID, 7, 1, 33)
    assert bench.packets.ping(bench.port, 33)[:2] == (1020, 0)
    assert bench.packets.ping(bench.port, ID)[1] == COMM_RX_TIMEOUT
    bench.write(33, 8, 1, 3)
    assert bench.packets.ping(bench.port, 33)[1] == COMM_RX_TIMEOUT
    bench.port.setBaudRate(1_000_000)
    assert bench.packets.ping(bench.port, 33)[1] == 0


def test_a_shutdown_latches_until_a_reboot():
    """Overload: torque goes off, every answer carries the alert, torque cannot be switched on; a reboot mends it."""
    bench = Bench(faults=Faults(scheduled=(HardwareFault(ID, 0.5),)))
    bench.energise(ID, 20)
    bench.clock.sleep_until(0.6)
    assert bench.read(ID, 64, 1) == 0
    assert bench.read(ID, 70, 1) == HardwareError.OVERLOAD
    assert bench.error(ID) == 0x80
    assert bench.packets.ping(bench.port, ID)[2] == 0x80
    assert bench.write(ID, 64, 1, 1)[1] & 0x80
    assert bench.read(ID, 64, 1) == 0
    bench.packets.reboot(bench.port, ID)
    bench.clock.sleep(0.1)
    assert bench.error(ID) == 0
    bench.energise(ID)


def test_a_servo_that_gets_too_hot_shuts_down():
    """Beyond the temperature limit, with its name in the status."""
    bench = Bench(faults=Faults(scheduled=(Overheat(ID, 0.5, 50.0),)))
    bench.energise(ID)
    bench.clock.sleep_until(1.4)
    assert bench.read(ID, 64, 1) == 1  # 30 C and 45 K
    bench.clock.sleep_until(1.6)
    assert bench.read(ID, 146, 1) > 80
    assert (bench.read(ID, 64, 1), bench.read(ID, 70, 1)) == (0, HardwareError.OVERHEATING)


def test_the_watchdog_frees_the_robot_within_120_ms(bench):
    """100 ms after the last packet the motor is free, goals are read-only, and 0 clears it."""
    bench.energise(ID, 10)
    assert bench.write(ID, 98, 1, 5) == (0, 0)
    last = bench.clock.now()
    index = bench.robot.servos["l_knee"].index
    bench.clock.sleep_until(last + 0.095)
    assert bench.physics.current[index] > 0
    bench.clock.sleep_until(last + 0.120)
    assert bench.physics.current[index] == 0
    assert bench.read(ID, 98, 1, signed=True) == -1
    assert bench.read(ID, 64, 1) == 1
    assert bench.write(ID, 102, 2, 0) == (0, Error.DATA_RANGE)
    assert bench.write(ID, 98, 1, 0) == (0, 0)
    assert bench.write(ID, 102, 2, 0) == (0, 0)


def test_a_group_reads_all_servos_at_one_instant(bench):
    """Sync and bulk reads return what single reads return."""
    bench.physics.position[:] = range(20)
    bench.physics.position[:] *= 0.1
    sync, bulk = GroupSyncRead(bench.port, bench.packets, 132, 4), GroupBulkRead(bench.port, bench.packets)
    for number in range(1, 21):
        sync.addParam(number)
        bulk.addParam(number, 132, 4)
    bulk.addParam(200, 32, 18)
    bench.clock.sleep(0.01)
    assert sync.txRxPacket() == bulk.txRxPacket() == 0
    for number in range(1, 21):
        value = bench.read(number, 132, 4)
        assert sync.getData(number, 132, 4) == bulk.getData(number, 132, 4) == value
    assert bulk.getData(200, 42, 2) == 16384  # 1 g


def test_fast_reads_return_the_same(bench):
    """Fast sync and bulk reads, in which all servos build one packet."""
    sync, bulk = GroupSyncRead(bench.port, bench.packets, 126, 10), GroupBulkRead(bench.port, bench.packets)
    bench.physics.position[:] = 1.0
    bench.clock.sleep(0.01)
    # dynamixel-sdk 4.1.0 looks an id up among all bytes of its request: id 4 is taken for the length 4
    numbers = [number for number in range(1, 21) if number != 4]
    for number in numbers:
        sync.addParam(number)
        bulk.addParam(number, 132, 4)
    assert sync.fastSyncRead() == bulk.fastBulkRead() == 0
    for number in numbers:
        assert sync.getData(number, 132, 4) == bulk.getData(number, 132, 4) == 2048 + 652
