"""The bus over the unmodified dynamixel-sdk, against the emulated robot's bytes."""

import contextlib

import numpy as np
import pytest
from deploy_rig import make_rig

from op3.deploy.dynamixel_bus import BOARD, NoAnswer, Refused
from op3.deploy.emulator import Faults, Silent
from op3.deploy.protocol import ALERT, encode_fast_status, fast_answers
from op3.deploy.registers import HardwareError
from op3.deploy.robot_state import BLOCKS, CONTENTS, Calibration
from op3.deploy.safety import Safety
from op3.robot import pose
from tests.op3_table import JOINTS, SERVO_IDS


@pytest.fixture
def rig(tmp_path):
    """An emulated robot whose servos have power."""
    return powered(make_rig(tmp_path))


def powered(rig):
    writer = rig.bus.writer()
    writer.write(BOARD, "dynamixel_power", 1)
    rig.robot.clock.sleep(0.5)
    rig.writer = writer
    return rig


def test_read_and_write_by_name(rig):
    """A register written by joint name reads back, sign included."""
    rig.writer.write("r_el", "goal_current", -321)
    assert rig.bus.read("r_el", "goal_current") == -321
    rig.writer.sync_write("goal_current", {"l_knee": -5, "head_pan": 7})
    values = rig.bus.sync_read("goal_current")
    assert (values["l_knee"], values["head_pan"], values["r_el"]) == (-5, 7, -321)


def test_a_refusal_names_the_device(rig):
    """An EEPROM register with torque on is refused, in words."""
    rig.writer.write("l_knee", "torque_enable", 1)
    with pytest.raises(Refused, match=r"l_knee \(id 14\) refused 0 for operating_mode"):
        rig.writer.write("l_knee", "operating_mode", 0)


def test_the_writer_is_given_out_once(rig):
    """A second owner of the write handle is a mistake."""
    with pytest.raises(RuntimeError, match="already has a writer"):
        rig.bus.writer()


def test_indirect_block(rig):
    """The fast block is 14 bytes at indirect data, set up with the addresses of the six registers."""
    block = rig.writer.prepare_block()
    assert (block.length, block.fast, block.indirect) == (14, True, True)
    assert sum(entry.size for entry in CONTENTS.values()) == 14
    pointers = [rig.robot.servos["l_knee"].get(f"indirect_address_{i}") for i in range(1, 15)]
    assert pointers == [126, 127, 128, 129, 130, 131, 132, 133, 134, 135, 70, 146, 144, 145]


@pytest.mark.parametrize("block", BLOCKS, ids=["fast", "plain", "direct"])
def test_state_is_the_same_by_every_block(rig, block):
    """Fast, plain and direct reading give the same SI values: those of the physics, on the registers' grids."""
    rig.writer.prepare_block()
    rig.bus.block = block
    state = rig.bus.read_state()
    assert state.answered.all()
    assert state.imu_answered
    assert np.abs(state.position - pose("stand", "op3")).max() <= np.pi / 4096 + 1e-12
    assert np.allclose(state.voltage, 12.0)
    assert (state.temperature == 30).all()
    assert state.supply_voltage == pytest.approx(12.0)
    assert np.allclose(state.linear_acceleration, [0, 0, 9.81], atol=0.1)


def test_fallbacks(rig, monkeypatch):
    """Without fast reads the plain sync read serves; without indirect addresses too, the plain registers."""
    dispatcher = rig.robot._dispatcher
    monkeypatch.setattr(dispatcher, "_fast", lambda items: [])
    assert (rig.writer.prepare_block().fast, rig.bus.block.indirect) == (False, True)
    for servo in rig.robot.servos.values():
        servo.put("indirect_address_1", 224)
        monkeypatch.setattr(servo, "_write_bytes", lambda targets, data: 7)
    block = rig.writer.prepare_block()
    assert (block.fast, block.indirect, block.address, block.length) == (False, False, 126, 21)
    assert rig.bus.read_state().answered.all()


@pytest.mark.parametrize("seed", range(3))
def test_a_lost_answer_does_not_choose_a_slower_block(tmp_path, seed):
    """With one answer in fifty lost while it is chosen, the fast block of 14 bytes is read all the same."""
    rig = powered(make_rig(tmp_path, seed=seed))
    rig.robot.bus.faults = Faults(lost=0.01)
    assert rig.writer.prepare_block().fast


def test_imu_axes(rig):
    """OpenCR's x and y are minus the trunk's: a trunk rolled by 60 deg reads +60 deg, its raw register -600."""
    rig.physics.tilt_from = 0.0
    rig.robot.clock.sleep(0.05)
    state = rig.bus.read_state()
    assert state.orientation[0] == pytest.approx(np.deg2rad(60), abs=np.deg2rad(0.11))
    assert state.raw["imu"][6] in (-600, -599)


def test_velocity_sign_and_unit(rig):
    """A joint turning at -2 rad/s reads -83 counts of 0.229 rpm, which is -1.99 rad/s."""
    rig.physics.velocity = np.full(20, -2.0)
    rig.physics.load[:] = 0.8
    rig.physics.clamped = False
    rig.writer.prepare_block()
    state = rig.bus.read_state()
    assert (state.raw["velocity"] == -83).all()
    assert np.allclose(state.velocity, -83 * 0.229 * 2 * np.pi / 60)


def test_calibration_shifts_angles(rig):
    """An offset of 0.1 rad is added to the servo's angle."""
    rig.bus.calibration = Calibration(np.full(20, 0.1), robot="op3")
    rig.writer.prepare_block()
    assert np.allclose(rig.bus.read_state().position, pose("stand", "op3") + 0.1, atol=1e-3)


def test_calibration_file_round_trip(tmp_path):
    """What is saved is read back; a joint that does not exist and an offset of a tooth are refused by name."""
    offset = np.linspace(-0.2, 0.2, 20)
    path = Calibration(offset, robot="op3").save(tmp_path / "calibration.yaml")
    assert np.allclose(Calibration.load(path, "op3").offset, offset, atol=1e-6)
    path.write_text("offset_rad: {l_kneee: 0.1}")
    with pytest.raises(ValueError, match="unknown joint 'l_kneee' of op3; the nearest is 'l_knee'"):
        Calibration.load(path, "op3")
    path.write_text("offset_rad: {l_knee: 0.9}")
    with pytest.raises(ValueError, match=r"l_knee is off by 0\.900 rad"):
        Calibration.load(path, "op3")
    path.write_text("")
    with pytest.raises(ValueError, match=f"^{path}: the file is empty"):
        Calibration.load(path, "op3")


def test_the_alert_bit_is_seen(rig):
    """A hardware error raises the alert of that servo alone, and its register tells the cause, by every block."""
    rig.writer.prepare_block()
    rig.robot.servos["r_knee"].fail(HardwareError.OVERLOAD)
    for block in BLOCKS:
        rig.bus.block = block
        state = rig.bus.read_state()
        assert [JOINTS[i] for i in np.flatnonzero(state.alert)] == ["r_knee"]
        assert state.raw["hardware_error"][JOINTS.index("r_knee")] == HardwareError.OVERLOAD


def test_a_silent_servo_hides_the_others_for_one_tick_only(tmp_path):
    """Servos wait for the one before them; the next tick asks the silent one last and hears the other nineteen."""
    rig = powered(make_rig(tmp_path, faults=Faults(scheduled=(Silent(SERVO_IDS["l_knee"], 0.65),))))
    rig.writer.prepare_block()
    whole = rig.bus.read_state()
    rig.robot.clock.sleep_until(0.7)
    first, second = rig.bus.read_state(), rig.bus.read_state()
    index = JOINTS.index("l_knee")
    assert not first.answered[index:].any()
    assert second.answered.sum() == 19
    assert not second.answered[index]
    assert second.position[index] == whole.position[index]


def test_a_locked_port_is_freed(rig):
    """After an interrupted call the SDK sends nothing; `clear` mends that."""
    rig.bus.port.is_using = True
    with pytest.raises(NoAnswer, match="Port is in use"):
        rig.bus.read("l_knee", "id")
    rig.bus.clear()
    assert rig.bus.read("l_knee", "id") == 14


@pytest.mark.parametrize("faults", [Faults(lost=0.3), Faults(corrupt=0.3), Faults(truncated=0.3), Faults(late=0.05)])
def test_spoilt_answers_never_become_values(tmp_path, faults):
    """Whatever is lost, changed, cut or late, every position is that of the physics; what is missing is told."""
    rig = powered(make_rig(tmp_path))
    rig.writer.prepare_block()
    rig.bus.read_state()
    rig.robot.bus.faults = faults
    missing = 0
    for _ in range(60):
        state = rig.bus.read_state()
        missing += int((~state.answered).sum())
        assert np.abs(state.position - pose("stand", "op3")).max() < 1e-3
        rig.robot.clock.sleep(0.004)
    assert missing > 0


@pytest.mark.parametrize("delay", [0.0045, 0.006, 0.0075])
def test_a_late_answer_is_not_taken_for_another_ones(rig, delay):
    """An answer that comes when something else of the device is asked for has another length: it is passed over."""
    rig.writer.prepare_block()

    def spoilt(call):
        rig.robot.bus.faults = Faults(late=1.0, delay=delay)
        with contextlib.suppress(NoAnswer):
            call()
        rig.robot.bus.faults = Faults()

    for _ in range(5):
        for call in (lambda: rig.bus.read(BOARD, "present_voltage"), lambda: rig.writer.write("l_knee", "led", 1)):
            spoilt(call)
            with contextlib.suppress(NoAnswer):
                assert rig.bus.read("l_knee", "goal_current") == 1193
            spoilt(call)
            rig.bus._read_board()
            rig.robot.clock.sleep(0.05)
            assert rig.bus.read_state().linear_acceleration[2] == pytest.approx(9.81, abs=0.1)


def test_a_line_that_never_falls_silent(rig, monkeypatch):
    """A broken cable may bring noise without end: every reading ends all the same, and so does switching off."""
    clock = rig.robot.clock

    def noise(length):
        clock.sleep(1e-4 * length)
        assert clock.now() < 10, "the computer waits for the noise to end"
        return bytes(length)

    monkeypatch.setattr(rig.bus.port, "readPort", noise)
    before = clock.now()
    assert not rig.bus.read_state().answered.any()
    assert clock.now() - before < 0.2
    rig.bus._writer = None
    result = Safety(rig.bus, report=rig.lines.append).release(patience=1.0)
    assert len(result.failed) == 20


def test_parts_of_a_fast_answer_before_a_bad_one_are_good():
    """Of three parts with the second one damaged, the first is used and the third is not."""
    sent = encode_fast_status([(0, 1, b"aa"), (ALERT, 2, b"bb"), (0, 3, b"cc")])
    assert fast_answers(b"".join(sent), [1, 2, 3], 2) == {1: (0, b"aa"), 2: (ALERT, b"bb"), 3: (0, b"cc")}
    sent[1] = sent[1][:2] + b"xx" + sent[1][4:]
    assert fast_answers(b"".join(sent), [1, 2, 3], 2) == {1: (0, b"aa")}
    assert fast_answers(b"", [1], 2) == {}
