"""The line: how long things take, what goes wrong, and that equal seeds give equal bytes."""

import numpy as np
import pytest
from dynamixel_sdk import COMM_RX_CORRUPT, COMM_RX_TIMEOUT, GroupSyncRead, GroupSyncWrite
from hypothesis import given, settings
from hypothesis import strategies as st
from wheels import Bench

from op3.deploy.emulator import (
    BrownOut,
    Faults,
    HardwareFault,
    LineTiming,
    Silent,
    SimPhysics,
    StandInPhysics,
    read_frames,
)
from op3.deploy.protocol import Parser, encode
from op3.deploy.registers import HardwareError
from op3.scenes import build_scene
from op3.sim import load_model
from op3.stand_in import HiddenWorld


def tick(bench, address=126, length=10):
    """Duration of a sync read, an IMU read and a sync write."""
    reader, writer = (
        GroupSyncRead(bench.port, bench.packets, address, length),
        GroupSyncWrite(bench.port, bench.packets, 102, 2),
    )
    for number in range(1, 21):
        reader.addParam(number)
        writer.addParam(number, [0, 0])
    start = bench.clock.now()
    assert reader.txRxPacket() == 0
    assert bench.packets.readTxRx(bench.port, 200, 32, 18)[1] == 0
    assert writer.txPacket() == 0
    return max(bench.clock.now(), bench.robot.bus._host_ends) - start


@pytest.mark.parametrize(
    ("options", "low", "high"),
    [
        # 571 bytes take 2.9 ms on the wire; with turnaround and USB about 5 ms
        ({}, 0.0045, 0.0062),
        # 500 us before each of 21 answers
        ({"settings": {"baud_rate": 4, "return_delay_time": 250}}, 0.014, 0.020),
        # 16 ms until the adapter sends the last bytes of each read
        ({"timing": LineTiming(latency_timer=0.016)}, 0.012, 0.040),
    ],
    ids=["robot", "factory return delay", "latency timer of Linux"],
)
def test_a_tick_takes_what_was_computed(options, low, high):
    """A cycle has 8 ms: enough at 2 Mbit/s, and not with what servos and adapters come with."""
    assert low < tick(Bench(**options)) < high


@pytest.mark.parametrize(
    ("kind", "rate"), [("lost", 0.0026), ("corrupt", 0.05), ("truncated", 0.05), ("late", 0.02), ("unheard", 0.05)]
)
def test_faults_hit_as_often_as_asked(kind, rate):
    """Of many reads the asked share fails, and none returns a wrong value."""
    bench = Bench(faults=Faults(**{kind: rate}), seed=3)
    bench.clock.sleep(0.1)
    count = 4000 if kind == "lost" else 800
    failed = 0
    for _ in range(count):
        data, result, _ = bench.packets.readTxRx(bench.port, 7, 132, 4)
        assert result in (0, COMM_RX_TIMEOUT, COMM_RX_CORRUPT)
        assert result or data == [0, 8, 0, 0]
        failed += result != 0
        if result:
            bench.clock.sleep(0.05)
    assert abs(failed - rate * count) < 4 * np.sqrt(rate * count) + 1


def test_a_silent_servo_hears_nothing_and_breaks_the_chain():
    """In a sync read nobody answers behind it; with torque on its own watchdog frees it."""
    bench = Bench(faults=Faults(scheduled=(Silent(3, 0.5, 1.5),)))
    bench.energise(3, 10)
    bench.write(3, 98, 1, 5)
    bench.clock.sleep_until(0.4)
    bench.packets.ping(bench.port, 1)
    while bench.clock.now() < 0.7:
        bench.packets.ping(bench.port, 1)
    assert not bench.physics.current.any()
    bench.port.clearPort()
    bench.port.writePort(encode(254, 0x82, bytes([132, 0, 4, 0, 1, 2, 3, 4, 5])))
    bench.clock.sleep(0.05)
    assert [packet.device for packet in Parser().feed(bench.port.readPort(500))] == [1, 2]
    bench.clock.sleep_until(1.6)
    assert bench.read(3, 98, 1, signed=True) == -1


def test_a_brown_out_is_reported_and_a_deep_one_resets():
    """9 V: input voltage error, torque stays. 5 V: servos restart without torque."""
    bench = Bench(faults=Faults(scheduled=(BrownOut(0.5, 0.6, 9.0), BrownOut(1.0, 1.1, 5.0))))
    bench.energise(4, 0)
    bench.clock.sleep_until(0.58)
    assert bench.read(4, 144, 2) == 90
    assert (bench.read(4, 70, 1), bench.read(4, 64, 1)) == (HardwareError.INPUT_VOLTAGE, 1)
    bench.clock.sleep_until(1.05)
    assert bench.packets.ping(bench.port, 4)[1] == COMM_RX_TIMEOUT
    bench.clock.sleep_until(1.3)
    assert (bench.read(4, 70, 1), bench.read(4, 64, 1)) == (0, 0)


def test_two_speakers_at_once_are_not_understood():
    """An instruction sent into an answer is lost, and so is the rest of the answer."""
    bench = Bench()
    bench.port.writePort(encode(1, 2, bytes([0, 0, 100, 0])))
    bench.clock.sleep(0.0003)
    bench.port.writePort(encode(2, 3, bytes([65, 0, 1])))
    bench.clock.sleep(0.05)
    assert bench.robot.servos["l_sho_pitch"].get("led") == 0
    assert Parser().feed(bench.port.readPort(500)) == []
    assert bench.packets.ping(bench.port, 2)[1] == 0


def sim():
    return SimPhysics(load_model("paper"), build_scene("floor", "op3"), seed=3)


def stand_in():
    return StandInPhysics(HiddenWorld(), build_scene("floor", "op3"), seed=3)


def session(path, seed=1, physics=None):
    bench = Bench(
        physics,
        seed=seed,
        faults=Faults(lost=0.02, corrupt=0.02, late=0.01, scheduled=(HardwareFault(9, 0.4),)),
        record=path,
    )
    reader = GroupSyncRead(bench.port, bench.packets, 126, 10)
    for number in range(1, 21):
        reader.addParam(number)
    bench.write(6, 11, 1, 0)
    bench.write(6, 102, 2, 30)
    bench.write(6, 64, 1, 1)
    for number in range(60):
        reader.txRxPacket()
        bench.packets.readTxRx(bench.port, 200, 32, 18)
        bench.clock.sleep_until(0.3 + 0.008 * number)
    bench.robot.close()
    return path.read_bytes(), bench.physics.position.copy()


@pytest.mark.parametrize("make", [sim, stand_in])
def test_equal_seeds_give_equal_bytes(tmp_path, make):
    """Two sessions agree in every byte on the wire and every bit of the physics; another seed does not."""
    first, second, other = (session(tmp_path / name, seed, make()) for name, seed in (("a", 1), ("b", 1), ("c", 2)))
    assert first[0] == second[0]
    assert (first[1] == second[1]).all()
    assert first[0] != other[0]


def test_frames_are_recorded_with_their_times(tmp_path):
    """The file holds what was said, in order, in both directions."""
    session(tmp_path / "frames.txt")
    frames = read_frames(tmp_path / "frames.txt")
    assert {frame.direction for frame in frames} == {"<", ">"}
    times = [frame.time for frame in frames]
    assert times == sorted(times)
    assert frames[0].data == encode(200, 3, bytes([24, 0, 1]))
    (tmp_path / "frames.txt").write_text("0.1 ? 00\n")
    with pytest.raises(ValueError, match="line 1"):
        read_frames(tmp_path / "frames.txt")


SHARED = Bench()


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 254), st.integers(0, 255), st.binary(max_size=60))
def test_no_instruction_breaks_the_robot(device, instruction, parameters):
    """Any instruction with any parameters is survived; afterwards the board still answers."""
    bench = SHARED
    if device in (0xFD, 200) or (device == 254 and instruction in (3, 4, 6, 0x83, 0x93)):
        device = 14  # ids and speeds of all devices at once would end the session
    bench.port.writePort(encode(device, instruction, parameters))
    bench.clock.sleep(1.0)
    bench.port.clearPort()
    assert bench.packets.ping(bench.port, 200)[:2] == (29696, 0)


@pytest.mark.parametrize("wrong", [{"lost": 1.5}, {"lost": 0.6, "late": 0.6}, {"scheduled": (Silent(77),)}])
def test_impossible_faults_are_refused(wrong):
    """Rates are shares, and devices are on the bus."""
    with pytest.raises(ValueError, match="faults"):
        Bench(faults=Faults(**wrong))
